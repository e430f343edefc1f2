#include "client/cli/usage/man_page.h"

#include "absl/strings/ascii.h"
#include "absl/strings/str_cat.h"
#include "absl/strings/str_replace.h"
#include "absl/strings/str_split.h"
#include "client/cli/usage/help_text.h"
#include "client/cli/usage/text_blocks.h"

namespace revisit::client {
namespace {

// Text that means nothing to the formatter.
std::string Escaped(const std::string& text) {
  std::string escaped = absl::StrReplaceAll(text, {{"\\", "\\e"},
                                                   {"-", "\\-"},
                                                   {"'", "\\(aq"},
                                                   {"^", "\\(ha"},
                                                   {"~", "\\(ti"},
                                                   {"`", "\\(ga"}});
  if (!escaped.empty() && escaped.front() == '.') escaped.insert(0, "\\&");
  return escaped;
}

std::string PageName(const CommandUsage& command) {
  return absl::StrReplaceAll(command.path, {{" ", "-"}});
}

// Below a heading.
void AddBlocks(const std::string& text, std::string* page) {
  const char* paragraph = "";
  for (const TextBlock& block : ParseText(text)) {
    if (block.term.empty()) {
      absl::StrAppend(page, paragraph, Escaped(block.text), "\n");
    } else {
      absl::StrAppend(page, ".TP\n", Escaped(block.term), "\n",
                      block.text.empty() ? "\\&" : Escaped(block.text), "\n");
    }
    paragraph = ".PP\n";
  }
}

void AddFlags(const CommandUsage& command, std::string* page) {
  std::string heading;
  for (const FlagUsage& flag : command.flags) {
    if (flag.heading != heading) {
      absl::StrAppend(page, ".SS \"", Escaped(flag.heading), "\"\n");
      heading = flag.heading;
    }
    absl::StrAppend(page, ".TP\n.B ", Escaped(FlagTitle(flag)), "\n",
                    flag.help.empty() ? "\\&" : Escaped(FlagHelp(flag)), "\n");
  }
}

void AddEnvironment(const CommandUsage& command, std::string* page) {
  std::string text;
  for (const FlagUsage& flag : command.flags) {
    if (flag.environment.empty()) continue;
    absl::StrAppend(&text, ".TP\n.B ", flag.environment, "\nCounts where ",
                    Escaped(flag.names.back()), " is not given.\n");
  }
  if (!text.empty()) absl::StrAppend(page, ".SH ENVIRONMENT\n", text);
}

void AddSeeAlso(const CommandUsage& command, const CommandUsage* above,
                std::string* page) {
  std::string pages;
  const auto add = [&pages](const CommandUsage& other) {
    absl::StrAppend(&pages, pages.empty() ? "" : ",\n", ".BR ",
                    Escaped(PageName(other)), " (1)");
  };
  if (above != nullptr) add(*above);
  for (const CommandUsage& below : command.commands) {
    if (!below.hidden) add(below);
  }
  if (pages.empty()) return;
  absl::StrAppend(page, ".SH SEE ALSO\n", pages, "\n");
}

std::string Page(const CommandUsage& command, const CommandUsage* above,
                 const ManPageFoot& foot) {
  const std::string name = PageName(command);
  std::string summary = command.summary;
  if (!summary.empty() && summary.back() == '.') summary.pop_back();
  std::string page = absl::StrCat(
      ".TH ", absl::AsciiStrToUpper(Escaped(name)), " 1 \"", foot.date, "\" \"",
      foot.version, "\" \"User Commands\"\n.SH NAME\n", Escaped(name), " \\- ",
      Escaped(summary), "\n.SH SYNOPSIS\n.B ", Escaped(Synopsis(command)),
      "\n");
  page += ".SH DESCRIPTION\n";
  AddBlocks(command.summary + "\n\n" + command.details, &page);
  if (!command.commands.empty()) page += ".SH COMMANDS\n";
  for (const CommandUsage& below : command.commands) {
    if (below.hidden) continue;
    absl::StrAppend(&page, ".TP\n.B ", Escaped(below.name), "\n",
                    Escaped(below.summary), "\n");
  }
  page += ".SH OPTIONS\n";
  AddFlags(command, &page);
  AddEnvironment(command, &page);
  if (!command.examples.empty()) {
    absl::StrAppend(&page, ".SH EXAMPLES\n.nf\n");
    for (const auto& line : absl::StrSplit(command.examples, '\n')) {
      absl::StrAppend(&page, Escaped(std::string(line)), "\n");
    }
    page += ".fi\n";
  }
  if (!command.notes.empty()) {
    page += ".SH NOTES\n";
    AddBlocks(command.notes, &page);
  }
  AddSeeAlso(command, above, &page);
  return page;
}

void AddPages(const CommandUsage& command, const CommandUsage* above,
              const ManPageFoot& foot, std::vector<ManPage>* pages) {
  pages->push_back({PageName(command) + ".1", Page(command, above, foot)});
  for (const CommandUsage& below : command.commands) {
    if (!below.hidden) AddPages(below, &command, foot, pages);
  }
}

}  // namespace

std::vector<ManPage> ManPages(const CommandUsage& program,
                              const ManPageFoot& foot) {
  std::vector<ManPage> pages;
  AddPages(program, nullptr, foot, &pages);
  return pages;
}

}  // namespace revisit::client
