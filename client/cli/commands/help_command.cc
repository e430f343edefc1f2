#include "client/cli/commands/help_command.h"

#include <cerrno>
#include <fstream>
#include <memory>
#include <vector>

#include "absl/strings/str_cat.h"
#include "client/cli/usage/completion.h"
#include "client/cli/usage/help_text.h"
#include "client/terminal/file_error.h"
#include "core/base/suggestion.h"

namespace revisit::client {
namespace {

// The command that the words name below the program, and otherwise the problem.
const CommandUsage* Find(const CommandUsage& program,
                         const std::vector<std::string>& words,
                         std::string* problem) {
  const CommandUsage* command = &program;
  for (const std::string& word : words) {
    const CommandUsage* const below = command->Find(word);
    if (below != nullptr) {
      command = below;
      continue;
    }
    std::vector<std::string> known;
    for (const CommandUsage& other : command->commands) {
      if (!other.hidden) known.push_back(other.name);
    }
    *problem = MistypedWord(word, known);
    return nullptr;
  }
  return command;
}

absl::Status WritePages(const std::string& directory,
                        const std::vector<ManPage>& pages) {
  for (const ManPage& page : pages) {
    const std::string path = absl::StrCat(directory, "/", page.file);
    std::ofstream file(path, std::ios::binary);
    file << page.text;
    file.close();
    if (!file) return FileError(path, errno);
  }
  return absl::OkStatus();
}

}  // namespace

void AddHelpCommand(const Command& program, const UsageSource& usage) {
  const Command command =
      program.AddCommand({"help", "Prints the help of a command.", "",
                          "  revisit help\n"
                          "  revisit help vehicle create"});
  const auto words = std::make_shared<std::vector<std::string>>();
  command.AddTexts("COMMAND", "TEXT", words.get(), "The words of the command");
  const RunAlone run = [words, usage](const Terminal& terminal) {
    std::string problem;
    const CommandUsage all = usage();
    terminal.out << HelpText(*Find(all, *words, &problem),
                             HelpWidth(terminal.width));
    return absl::OkStatus();
  };
  command.RunsAlone(run, [words, usage] {
    std::string problem;
    Find(usage(), *words, &problem);
    return problem;
  });
}

void AddCompletionCommand(const Command& program, const UsageSource& usage) {
  const Command command = program.AddCommand(
      {"completion", "Prints a script by which a shell completes commands.",
       "An installation has these scripts where the shells look for them.",
       "  source <(revisit completion bash)\n"
       "  revisit completion zsh > ~/.zfunc/_revisit\n"
       "  revisit completion fish > ~/.config/fish/completions/revisit.fish"});
  const Words shells = {{"bash", static_cast<int>(Shell::kBash)},
                        {"fish", static_cast<int>(Shell::kFish)},
                        {"zsh", static_cast<int>(Shell::kZsh)}};
  const auto shell = std::make_shared<Shell>(Shell::kBash);
  command.AddChoice("SHELL", shells, shell.get(), "Which shell").Required();
  command.RunsAlone([shell, usage](const Terminal& terminal) {
    terminal.out << CompletionScript(*shell, usage());
    return absl::OkStatus();
  });
}

void AddManPagesCommand(const Command& program, const UsageSource& usage,
                        const ManPageFoot& foot) {
  CommandHelp help = {"man-pages", "Writes the manual pages.", "",
                      "  revisit man-pages share/man/man1"};
  help.hidden = true;
  const Command command = program.AddCommand(help);
  const auto directory = std::make_shared<std::string>();
  command.AddText("DIR", "TEXT", directory.get(), "Where to write them")
      .Required();
  command.RunsAlone([directory, usage, foot](const Terminal&) {
    return WritePages(*directory, ManPages(usage(), foot));
  });
}

}  // namespace revisit::client
