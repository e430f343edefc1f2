#include "core/base/command_words.h"

#include <algorithm>

#include "CLI/CLI.hpp"
#include "absl/strings/str_cat.h"
#include "core/base/suggestion.h"

namespace revisit {
namespace {

constexpr char kOnlyArguments[] = "--";

bool IsFlag(const std::string& word) {
  return word.size() > 1 && word.front() == '-';
}

std::string NameIn(const std::string& word) {
  return word.substr(0, word.find('='));
}

// The option of the command, or of one above it, that has this name; null if
// none has.
const CLI::Option* OptionOf(const CLI::App* command, const std::string& name) {
  for (; command != nullptr; command = command->get_parent()) {
    const CLI::Option* const option = command->get_option_no_throw(name);
    if (option != nullptr) return option;
  }
  return nullptr;
}

// The command right below with this name; null if there is none.
const CLI::App* CommandBelow(const CLI::App& command, const std::string& name) {
  const auto below = command.get_subcommands(
      [&name](const CLI::App* one) { return one->get_name() == name; });
  return below.empty() ? nullptr : below.front();
}

}  // namespace

CommandWords SeparatedValues(const CLI::App& app,
                             const std::vector<std::string>& words) {
  CommandWords separated{{}, "", &app};
  for (auto word = words.begin(); word != words.end(); ++word) {
    if (*word == kOnlyArguments) {
      separated.words.insert(separated.words.end(), word, words.end());
      break;
    }
    const std::string name = NameIn(*word);
    const bool has_value = name.size() < word->size();
    const CLI::Option* const option =
        IsFlag(name) ? OptionOf(separated.command, name) : nullptr;
    if (option == nullptr) {
      const CLI::App* const below = CommandBelow(*separated.command, *word);
      if (below != nullptr) separated.command = below;
      separated.words.push_back(*word);
    } else if (option->get_items_expected_max() == 0) {
      if (has_value) {
        separated.problem =
            absl::StrCat(name, ": got \"", word->substr(name.size() + 1),
                         "\"; allowed is no value");
        break;
      }
      separated.words.push_back(*word);
    } else if (name.size() + 1 == word->size()) {
      separated.words.insert(separated.words.end(), {name, ""});
    } else {
      separated.words.push_back(*word);
      // The next word is its value, whatever it looks like.
      if (!has_value && word + 1 != words.end()) {
        separated.words.push_back(*++word);
      }
    }
  }
  return separated;
}

const CLI::App* ChosenOf(const CLI::App* app) {
  while (!app->get_subcommands().empty()) app = app->get_subcommands().front();
  return app;
}

std::string PathOf(const CLI::App* app) {
  const CLI::App* const above = app->get_parent();
  return above == nullptr ? app->get_name()
                          : absl::StrCat(PathOf(above), " ", app->get_name());
}

std::vector<std::string> NamesOf(const CLI::Option* option) {
  std::vector<std::string> names;
  for (const std::string& name : option->get_snames()) {
    names.push_back("-" + name);
  }
  for (const std::string& name : option->get_lnames()) {
    names.push_back("--" + name);
  }
  return names;
}

std::string MistypedFlag(const std::vector<std::string>& words,
                         const CLI::App* chosen) {
  const auto found = std::find_if(words.begin(), words.end(), IsFlag);
  if (found == words.end()) return "";
  std::vector<std::string> known;
  for (const CLI::App* app = chosen; app != nullptr; app = app->get_parent()) {
    for (const CLI::Option* option : app->get_options()) {
      const std::vector<std::string> names = NamesOf(option);
      known.insert(known.end(), names.begin(), names.end());
    }
  }
  const std::string flag = NameIn(*found);
  const std::string meant = Suggestion(flag, known);
  if (meant == flag) {
    return absl::StrCat("got \"", flag,
                        "\" before the command; it stands behind ",
                        PathOf(chosen));
  }
  return absl::StrCat("got \"", flag, "\", which is no flag of ",
                      PathOf(chosen),
                      meant.empty() ? "" : "; did you mean " + meant + "?");
}

}  // namespace revisit
