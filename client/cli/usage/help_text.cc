#include "client/cli/usage/help_text.h"

#include <algorithm>
#include <utility>
#include <vector>

#include "absl/strings/str_cat.h"
#include "absl/strings/str_join.h"
#include "absl/strings/str_replace.h"
#include "client/cli/usage/text_blocks.h"

namespace revisit::client {
namespace {

using Rows = std::vector<std::pair<std::string, std::string>>;

constexpr std::size_t kLeastWidth = 40;
// A longer title has a line of its own.
constexpr std::size_t kMostTitle = 26;

// Titles with their texts beside them.
std::string Listed(const std::string& heading, const Rows& rows,
                   std::size_t width) {
  if (rows.empty()) return "";
  std::size_t titles = 0;
  for (const auto& [title, text] : rows) {
    if (title.size() <= kMostTitle) titles = std::max(titles, title.size());
  }
  const std::size_t column = titles + 4;
  std::string listed = absl::StrCat("\n", heading, ":\n");
  for (const auto& [title, text] : rows) {
    std::string first = "  " + title;
    if (first.size() > width) {
      // The words that a flag takes, on several lines.
      listed +=
          Wrapped(absl::StrReplaceAll(title, {{"|", " | "}}), width, "  ", 6);
      first.clear();
    } else if (first.size() + 2 > column) {
      listed += first + '\n';
      first.clear();
    }
    first.append(column - first.size(), ' ');
    listed += Wrapped(text, width, first, column);
  }
  return listed;
}

// Headings in the order in which they first appear.
std::vector<std::string> Headings(const CommandUsage& command) {
  std::vector<std::string> headings;
  for (const FlagUsage& flag : command.flags) {
    if (!flag.word.empty()) continue;
    if (std::find(headings.begin(), headings.end(), flag.heading) ==
        headings.end()) {
      headings.push_back(flag.heading);
    }
  }
  return headings;
}

}  // namespace

std::string Synopsis(const CommandUsage& command) {
  std::string synopsis = command.path + " [OPTIONS]";
  for (const FlagUsage& flag : command.flags) {
    if (!flag.word.empty()) {
      const std::string word = flag.word + (flag.repeated ? "..." : "");
      absl::StrAppend(&synopsis, " ",
                      flag.required ? word : absl::StrCat("[", word, "]"));
    } else if (flag.required) {
      absl::StrAppend(&synopsis, " ", flag.names.front(), " ", flag.value);
    }
  }
  if (!command.commands.empty()) synopsis += " COMMAND";
  return synopsis;
}

std::string FlagTitle(const FlagUsage& flag) {
  std::vector<std::string> titles;
  if (!flag.word.empty()) titles.push_back(flag.word);
  titles.insert(titles.end(), flag.names.begin(), flag.names.end());
  std::string title = absl::StrJoin(titles, ", ");
  if (!flag.names.empty() && !flag.value.empty()) {
    absl::StrAppend(&title, " ", flag.value, flag.repeated ? "..." : "");
  } else if (!flag.choices.empty()) {
    absl::StrAppend(&title, ": ", flag.value);
  }
  return title;
}

std::string FlagHelp(const FlagUsage& flag) {
  std::vector<std::string> remarks;
  if (!flag.default_value.empty()) remarks.push_back(flag.default_value);
  if (!flag.environment.empty()) remarks.push_back("env " + flag.environment);
  if (remarks.empty()) return flag.help;
  return absl::StrCat(flag.help, " (", absl::StrJoin(remarks, "; "), ")");
}

std::size_t HelpWidth(std::size_t terminal_width) {
  constexpr std::size_t kElsewhere = 80;
  constexpr std::size_t kMost = 100;
  return terminal_width == 0 ? kElsewhere : std::min(terminal_width, kMost);
}

std::string HelpText(const CommandUsage& command, std::size_t width) {
  width = std::max(width, kLeastWidth);
  std::string text = Wrapped(command.summary, width, "", 0);
  text += '\n' + Wrapped(Synopsis(command), width, "Usage: ", 11);
  if (!command.details.empty()) {
    text += '\n' + LaidOut(ParseText(command.details), width);
  }
  Rows commands;
  for (const CommandUsage& below : command.commands) {
    if (!below.hidden) commands.emplace_back(below.name, below.summary);
  }
  text += Listed("Commands", commands, width);
  Rows words;
  for (const FlagUsage& flag : command.flags) {
    if (!flag.word.empty()) words.emplace_back(FlagTitle(flag), FlagHelp(flag));
  }
  text += Listed("Arguments", words, width);
  for (const std::string& heading : Headings(command)) {
    Rows flags;
    for (const FlagUsage& flag : command.flags) {
      if (!flag.word.empty() || flag.heading != heading) continue;
      flags.emplace_back(FlagTitle(flag), FlagHelp(flag));
    }
    text += Listed(heading, flags, width);
  }
  if (!command.examples.empty()) {
    text += "\nExamples:\n" + LaidOutExamples(command.examples, width);
  }
  const std::size_t program_end = command.path.find(' ');
  if (program_end != std::string::npos) {
    text += '\n' + Wrapped(absl::StrCat("It also takes the flags of ",
                                        command.path.substr(0, program_end),
                                        " --help, which every command takes."),
                           width, "", 0);
  }
  if (!command.notes.empty()) {
    text += '\n' + LaidOut(ParseText(command.notes), width);
  }
  return text;
}

}  // namespace revisit::client
