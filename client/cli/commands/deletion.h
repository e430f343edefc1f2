// Commands that delete what cannot be had again, which ask first.
#ifndef REVISIT_CLIENT_CLI_COMMANDS_DELETION_H_
#define REVISIT_CLIENT_CLI_COMMANDS_DELETION_H_

#include <cstdint>
#include <functional>
#include <optional>
#include <string>
#include <vector>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "client/cli/flags.h"
#include "client/revisit/client.h"
#include "client/terminal/terminal.h"

namespace revisit::client {

// Answers a question: the line that was typed, or nothing at the end of input.
using Ask =
    std::function<std::optional<std::string>(const std::string& question)>;

// A kind of resources that are deleted by their ids.
struct DeletedKind {
  std::string (*name)(const std::string& id);
  // Says in the question what else is lost, such as " with its 3 poses".
  absl::StatusOr<std::string> (*content)(const Client& client,
                                         const std::string& name);
  // `expected_revision`: 0 for any, as it is for a kind without revisions.
  absl::Status (*remove)(const Client& client, const std::string& name,
                         std::uint64_t expected_revision);
  // Whether one may be deleted only at a revision.
  bool has_revisions = false;
};

// Deletes each one whose id is typed as the answer of `ask`; without `ask`, all
// of them. Stops at the first one that is not there, cannot be deleted or whose
// id was not typed. Prints their names; as JSON: {"deleted": ["vehicles/..."]}.
absl::Status RunDeletion(const Client& client, const DeletedKind& kind,
                         const std::vector<std::string>& ids, const Ask& ask,
                         const Terminal& terminal,
                         std::uint64_t expected_revision = 0);

// Adds such a command, with the flag --yes and, for a kind with revisions,
// --expected-revision, which goes with one id. It asks at the terminal.
void AddDeletion(const Command& parent, const CommandHelp& help,
                 const DeletedKind& kind);

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_CLI_COMMANDS_DELETION_H_
