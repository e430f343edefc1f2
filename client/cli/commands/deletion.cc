#include "client/cli/commands/deletion.h"

#include <unistd.h>

#include <iostream>
#include <memory>

#include "absl/strings/str_cat.h"
#include "client/answers/names.h"
#include "client/cli/commands/shared_flags.h"
#include "client/revisit/printable_text.h"
#include "nlohmann/json.hpp"

namespace revisit::client {
namespace {

// OK if the id is the answer.
absl::Status MakeSure(const Client& client, const DeletedKind& kind,
                      const std::string& name, const Ask& ask) {
  const auto content = kind.content(client, name);
  if (absl::IsNotFound(content.status())) return content.status();
  // Whoever may delete something may not be allowed to read it.
  const std::string id = IdOf(name);
  const auto answer =
      ask(absl::StrCat("Deletes ", name, content.value_or(""),
                       ", which cannot be undone. Type ", id, " to go on: "));
  if (answer == id) return absl::OkStatus();
  return LocalError(absl::CancelledError(
      absl::StrCat(name, " is not deleted: got \"", answer.value_or(""),
                   "\" instead of its id")));
}

// Asks whoever sits at the terminal.
std::optional<std::string> AskAtTerminal(const std::string& question) {
  std::cerr << question << std::flush;
  std::string line;
  if (!std::getline(std::cin, line)) return std::nullopt;
  return line;
}

}  // namespace

absl::Status RunDeletion(const Client& client, const DeletedKind& kind,
                         const std::vector<std::string>& ids, const Ask& ask,
                         const Terminal& terminal,
                         std::uint64_t expected_revision) {
  nlohmann::ordered_json deleted = nlohmann::ordered_json::array();
  for (const std::string& id : ids) {
    const std::string name = kind.name(id);
    if (ask != nullptr) {
      if (absl::Status sure = MakeSure(client, kind, name, ask); !sure.ok()) {
        return sure;
      }
    }
    const absl::Status removed = kind.remove(client, name, expected_revision);
    if (!removed.ok()) return removed;
    deleted.push_back(name);
    if (terminal.json()) continue;
    terminal.out << (terminal.names() ? "" : "deleted ") << Printable(name)
                 << '\n';
  }
  if (terminal.json()) {
    terminal.out << JsonText({{"deleted", deleted}}, true) << '\n';
  }
  return absl::OkStatus();
}

void AddDeletion(const Command& parent, const CommandHelp& help,
                 const DeletedKind& kind) {
  const Command command = parent.AddCommand(help);
  const auto ids = std::make_shared<std::vector<std::string>>();
  const auto yes = std::make_shared<bool>(false);
  command.AddTexts("ID", "TEXT", ids.get(), "").Required();
  command.AddSwitch("--yes", yes.get(), "Delete without a question");
  const auto revision = std::make_shared<std::uint64_t>(0);
  if (kind.has_revisions) AddExpectedRevision(command, revision.get());
  const Check check = [yes, ids, revision]() -> std::string {
    if (*revision != 0 && ids->size() > 1) {
      return "--expected-revision is that of one group: delete one at a time";
    }
    return *yes || (isatty(STDIN_FILENO) == 1 && isatty(STDERR_FILENO) == 1)
               ? ""
               : "--yes is required where nobody can be asked: a deletion "
                 "cannot be undone";
  };
  const Run run = [ids, yes, revision, kind](const Connection& server,
                                             const Terminal& terminal) {
    return RunDeletion(server.client, kind, *ids, *yes ? Ask() : &AskAtTerminal,
                       terminal, *revision);
  };
  command.AlsoPrints({OutputFormat::kName});
  command.Runs(run, check);
}

}  // namespace revisit::client
