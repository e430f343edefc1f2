// revisit closures list|delete, revisit rejections list|delete
#ifndef REVISIT_CLIENT_CLI_COMMANDS_FINDINGS_COMMAND_H_
#define REVISIT_CLIENT_CLI_COMMANDS_FINDINGS_COMMAND_H_

#include <string>
#include <vector>

#include "absl/status/status.h"
#include "client/cli/flags.h"
#include "client/revisit/client.h"
#include "client/terminal/terminal.h"

namespace revisit::client {

void AddClosuresCommand(const Command& program);
void AddRejectionsCommand(const Command& program);

// A loop closure or a rejection.
struct FindingReference {
  // Id, or name.
  std::string vehicle;
  // Either its id or resource name, or the sequences of its later and of its
  // earlier pose.
  std::vector<std::string> words;
};

// Lists those of all pages. As JSON: {"loopClosures": [...]} or
// {"rejectedCandidates": [...]}.
absl::Status RunClosuresList(const Client& client, const std::string& vehicle,
                             const Terminal& terminal);
absl::Status RunRejectionsList(const Client& client, const std::string& vehicle,
                               const Terminal& terminal);

// Deletes one. NOT_FOUND if there is none of these sequences,
// FAILED_PRECONDITION if there are several, which only differ by their ids.
// Prints the name and the revision; as JSON, {"name", "revision"}.
absl::Status RunClosuresDelete(const Client& client,
                               const FindingReference& finding,
                               const Terminal& terminal);
absl::Status RunRejectionsDelete(const Client& client,
                                 const FindingReference& finding,
                                 const Terminal& terminal);

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_CLI_COMMANDS_FINDINGS_COMMAND_H_
