#include "client/cli/usage/completion.h"

#include <set>
#include <vector>

#include "absl/strings/str_cat.h"
#include "absl/strings/str_join.h"
#include "absl/strings/str_replace.h"

namespace revisit::client {
namespace {

// The things that may stand for a value or a word.
enum class Kind { kNothing, kWords, kFile, kDirectory, kContext };

Kind KindOf(const FlagUsage& flag) {
  if (!flag.choices.empty()) return Kind::kWords;
  for (const std::string& name : {flag.word, flag.value}) {
    if (name.rfind("FILE", 0) == 0) return Kind::kFile;
    if (name == "DIR") return Kind::kDirectory;
    if (name == "CONTEXT") return Kind::kContext;
  }
  return Kind::kNothing;
}

bool TakesValue(const FlagUsage& flag) {
  return !flag.names.empty() && !flag.value.empty();
}

// The program, then every command that is shown, each before those below it.
void Collect(const CommandUsage& command,
             std::vector<const CommandUsage*>* commands) {
  commands->push_back(&command);
  for (const CommandUsage& below : command.commands) {
    if (!below.hidden) Collect(below, commands);
  }
}

std::vector<const CommandUsage*> CommandsOf(const CommandUsage& program) {
  std::vector<const CommandUsage*> commands;
  Collect(program, &commands);
  return commands;
}

std::string SingleQuoted(const std::string& text) {
  return absl::StrCat("'", absl::StrReplaceAll(text, {{"'", "'\\''"}}), "'");
}

// Flags are the command's own and the program's, which every command takes.
std::vector<const FlagUsage*> FlagsOf(const CommandUsage& command,
                                      const CommandUsage& program) {
  std::vector<const FlagUsage*> flags;
  std::set<std::string> seen;
  for (const CommandUsage* owner : {&command, &program}) {
    for (const FlagUsage& flag : owner->flags) {
      if (flag.names.empty() || !seen.insert(flag.names.back()).second) {
        continue;
      }
      // Only the program itself prints its version.
      if (&command != &program && flag.names.back() == "--version") continue;
      flags.push_back(&flag);
    }
  }
  return flags;
}

// Branches that follow the words of the line from command to command.
std::string PathBranches(const std::vector<const CommandUsage*>& commands) {
  std::string branches;
  for (const CommandUsage* command : commands) {
    if (command == commands.front()) continue;
    absl::StrAppend(&branches, "      \"", command->path, "\") command=\"",
                    command->path, "\" ;;\n");
  }
  return branches;
}

// Branches for the value of the flag before the cursor. `offer` says what the
// shell does to offer values of a kind, `words` what to offer choices.
template <typename Offer, typename Words>
std::string ValueBranches(const std::vector<const CommandUsage*>& commands,
                          const Offer& offer, const Words& words) {
  std::string branches;
  for (const CommandUsage* command : commands) {
    const bool everywhere = command == commands.front();
    for (const FlagUsage& flag : command->flags) {
      if (!TakesValue(flag)) continue;
      std::vector<std::string> patterns;
      for (const std::string& name : flag.names) {
        patterns.push_back(
            everywhere ? absl::StrCat("*:", name)
                       : absl::StrCat("\"", command->path, ":", name, "\""));
      }
      const Kind kind = KindOf(flag);
      absl::StrAppend(
          &branches, "    ", absl::StrJoin(patterns, "|"), ") ",
          kind == Kind::kWords ? words(flag.choices) : std::string(offer(kind)),
          "; return ;;\n");
    }
  }
  return branches;
}

// The words that a command takes in their places: commands and choices, and
// whether it takes names of files or of contexts.
struct PlainWords {
  std::vector<std::string> words;
  bool files = false;
  bool contexts = false;
};

PlainWords PlainWordsOf(const CommandUsage& command,
                        const CommandUsage& program) {
  PlainWords plain;
  for (const CommandUsage& below : command.commands) {
    if (!below.hidden) plain.words.push_back(below.name);
  }
  for (const FlagUsage& flag : command.flags) {
    if (flag.word.empty()) continue;
    plain.words.insert(plain.words.end(), flag.choices.begin(),
                       flag.choices.end());
    if (KindOf(flag) == Kind::kFile) plain.files = true;
    if (KindOf(flag) == Kind::kContext) plain.contexts = true;
    if (flag.word != "COMMAND") continue;
    for (const CommandUsage& other : program.commands) {
      if (!other.hidden) plain.words.push_back(other.name);
    }
  }
  return plain;
}

// The names of contexts, which the program itself reads from their file.
constexpr char kContextNames[] = "revisit context list -o name 2>/dev/null";

std::string BashOffer(Kind kind) {
  switch (kind) {
    case Kind::kFile:
      return "_revisit_files -f";
    case Kind::kDirectory:
      return "_revisit_files -d";
    case Kind::kContext:
      return absl::StrCat("_revisit_offer -W \"$(", kContextNames, ")\"");
    default:
      return ":";
  }
}

std::string BashScript(const CommandUsage& program) {
  const auto commands = CommandsOf(program);
  const auto offer = [](const std::vector<std::string>& words) {
    return absl::StrCat("_revisit_offer -W \"", absl::StrJoin(words, " "),
                        "\"");
  };
  std::string script = absl::StrCat(
      R"(# Completion of revisit for bash, made by: revisit completion bash

# Offers what compgen makes of its arguments for the word at the cursor.
_revisit_offer() {
  local line
  COMPREPLY=()
  while IFS= read -r line; do
    COMPREPLY+=("$line")
  done < <(compgen "$@" -- "$cur")
}

_revisit_files() {
  compopt -o filenames 2>/dev/null
  _revisit_offer "$@"
}

_revisit() {
  local cur=${COMP_WORDS[COMP_CWORD]} command=revisit previous=() i
  COMPREPLY=()
  for ((i = 1; i < COMP_CWORD; ++i)); do
    case "$command ${COMP_WORDS[i]}" in
)",
      PathBranches(commands), R"(    esac
  done
  # bash cuts --flag=value at the equals sign.
  i=$((COMP_CWORD - 1))
  if [[ $cur == = ]]; then
    cur=
  elif [[ $i -gt 0 && ${COMP_WORDS[i]} == = ]]; then
    i=$((i - 1))
  fi
  case "$command:${COMP_WORDS[i]}" in
)",
      ValueBranches(commands, &BashOffer, offer),
      R"(  esac
  case "$command" in
)");
  for (const CommandUsage* command : commands) {
    std::vector<std::string> names;
    for (const FlagUsage* flag : FlagsOf(*command, program)) {
      names.insert(names.end(), flag->names.begin(), flag->names.end());
    }
    const PlainWords plain = PlainWordsOf(*command, program);
    absl::StrAppend(&script, "    \"", command->path,
                    "\")\n      if [[ $cur == -* ]]; then\n        ",
                    offer(names), "\n");
    if (plain.files || plain.contexts || !plain.words.empty()) {
      absl::StrAppend(&script, "      else\n        ",
                      plain.files      ? BashOffer(Kind::kFile)
                      : plain.contexts ? BashOffer(Kind::kContext)
                                       : offer(plain.words),
                      "\n");
    }
    script += "      fi ;;\n";
  }
  return script + "  esac\n}\n\ncomplete -F _revisit revisit\n";
}

std::string ZshEntries(
    const std::vector<std::pair<std::string, std::string>>& entries) {
  std::string text;
  for (const auto& [name, help] : entries) {
    absl::StrAppend(&text, "\n        ",
                    SingleQuoted(absl::StrCat(name, ":", help)));
  }
  return text;
}

std::string ZshOffer(Kind kind) {
  switch (kind) {
    case Kind::kFile:
      return "_files";
    case Kind::kDirectory:
      return "_files -/";
    case Kind::kContext:
      return absl::StrCat("compadd -- ${(f)\"$(", kContextNames, ")\"}");
    default:
      return ":";
  }
}

std::string ZshScript(const CommandUsage& program) {
  const auto commands = CommandsOf(program);
  const auto offer = [](const std::vector<std::string>& words) {
    return absl::StrCat("compadd -- ", absl::StrJoin(words, " "));
  };
  std::string script = absl::StrCat(
      R"(#compdef revisit
# Completion of revisit for zsh, made by: revisit completion zsh

_revisit() {
  local command=revisit flag=${words[CURRENT-1]} i
  local -a flags commands
  for ((i = 2; i < CURRENT; ++i)); do
    case "$command ${words[i]}" in
)",
      PathBranches(commands), R"(    esac
  done
  if [[ $PREFIX == --*=* ]]; then
    flag=${PREFIX%%=*}
    compset -P '*='
  fi
  case "$command:$flag" in
)",
      ValueBranches(commands, &ZshOffer, offer), R"(  esac
  case "$command" in
)");
  for (const CommandUsage* command : commands) {
    std::vector<std::pair<std::string, std::string>> flags;
    for (const FlagUsage* flag : FlagsOf(*command, program)) {
      for (const std::string& name : flag->names) {
        flags.emplace_back(name, flag->help);
      }
    }
    std::vector<std::pair<std::string, std::string>> below;
    for (const CommandUsage& other : command->commands) {
      if (!other.hidden) below.emplace_back(other.name, other.summary);
    }
    const PlainWords plain = PlainWordsOf(*command, program);
    absl::StrAppend(&script, "    \"", command->path, "\")\n      flags=(",
                    ZshEntries(flags), ")\n");
    if (!below.empty()) {
      absl::StrAppend(&script, "      commands=(", ZshEntries(below), ")\n");
    } else if (plain.files || plain.contexts) {
      absl::StrAppend(&script, "      [[ $PREFIX == -* ]] || { ",
                      ZshOffer(plain.files ? Kind::kFile : Kind::kContext),
                      "; return; }\n");
    } else if (!plain.words.empty()) {
      absl::StrAppend(&script, "      [[ $PREFIX == -* ]] || { ",
                      offer(plain.words), "; return; }\n");
    }
    script += "      ;;\n";
  }
  return script + R"(  esac
  if [[ $PREFIX == -* ]]; then
    _describe -o flag flags
  elif (( $#commands )); then
    _describe command commands
  fi
}

if [[ ${funcstack[1]} == _revisit ]]; then
  _revisit "$@"
else
  compdef _revisit revisit
fi
)";
}

// The path below the program.
std::string FishPath(const CommandUsage& command) {
  const std::size_t blank = command.path.find(' ');
  return blank == std::string::npos ? "" : command.path.substr(blank + 1);
}

std::string FishFlag(const FlagUsage& flag, const std::string& condition) {
  std::string line = absl::StrCat("complete -c revisit", condition);
  for (const std::string& name : flag.names) {
    absl::StrAppend(&line, name.rfind("--", 0) == 0 ? " -l " : " -s ",
                    name.substr(name.find_first_not_of('-')));
  }
  if (TakesValue(flag)) {
    switch (KindOf(flag)) {
      case Kind::kWords:
        absl::StrAppend(&line, " -x -a ",
                        SingleQuoted(absl::StrJoin(flag.choices, " ")));
        break;
      case Kind::kFile:
        line += " -r -F";
        break;
      case Kind::kDirectory:
        line += " -x -a '(__fish_complete_directories)'";
        break;
      case Kind::kContext:
        absl::StrAppend(&line, " -x -a '(", kContextNames, ")'");
        break;
      case Kind::kNothing:
        line += " -x";
        break;
    }
  }
  return absl::StrCat(line, " -d ", SingleQuoted(flag.help), "\n");
}

std::string FishScript(const CommandUsage& program) {
  const auto commands = CommandsOf(program);
  std::vector<std::string> paths;
  for (const CommandUsage* command : commands) {
    if (command != &program) paths.push_back(SingleQuoted(FishPath(*command)));
  }
  std::string script = absl::StrCat(
      R"(# Completion of revisit for fish, made by: revisit completion fish

# Whether the line has come to this command.
function __revisit_at
    set -l command ''
    for word in (commandline -opc)[2..-1]
        set -l longer (string trim -- "$command $word")
        if contains -- $longer )",
      absl::StrJoin(paths, " "), R"(
            set command $longer
        end
    end
    test "$command" = "$argv[1]"
end

complete -c revisit -f
)");
  for (const CommandUsage* command : commands) {
    const std::string at =
        absl::StrCat(" -n ", SingleQuoted(absl::StrCat(
                                 "__revisit_at \"", FishPath(*command), "\"")));
    for (const CommandUsage& below : command->commands) {
      if (below.hidden) continue;
      absl::StrAppend(&script, "complete -c revisit", at, " -a ", below.name,
                      " -d ", SingleQuoted(below.summary), "\n");
    }
    for (const FlagUsage& flag : command->flags) {
      if (!flag.names.empty()) {
        const bool everywhere =
            command == &program && flag.names.back() != "--version";
        script += FishFlag(flag, everywhere ? "" : at);
      }
    }
    if (!command->commands.empty()) continue;
    const PlainWords plain = PlainWordsOf(*command, program);
    if (plain.files) {
      absl::StrAppend(&script, "complete -c revisit", at, " -F\n");
    } else if (plain.contexts) {
      absl::StrAppend(&script, "complete -c revisit", at, " -a '(",
                      kContextNames, ")'\n");
    } else if (!plain.words.empty()) {
      absl::StrAppend(&script, "complete -c revisit", at, " -a ",
                      SingleQuoted(absl::StrJoin(plain.words, " ")), "\n");
    }
  }
  return script;
}

}  // namespace

std::string CompletionScript(Shell shell, const CommandUsage& program) {
  switch (shell) {
    case Shell::kBash:
      return BashScript(program);
    case Shell::kZsh:
      return ZshScript(program);
    case Shell::kFish:
      return FishScript(program);
  }
  return "";
}

}  // namespace revisit::client
