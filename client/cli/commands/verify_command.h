// revisit confirm, revisit reject
#ifndef REVISIT_CLIENT_CLI_COMMANDS_VERIFY_COMMAND_H_
#define REVISIT_CLIENT_CLI_COMMANDS_VERIFY_COMMAND_H_

#include <cstdint>
#include <string>

#include "absl/status/status.h"
#include "client/cli/console.h"
#include "client/cli/flags.h"
#include "client/revisit/client.h"

namespace revisit::client {

void AddConfirmCommand(const Command& program);
void AddRejectCommand(const Command& program);

// Two poses of a candidate that somebody has looked at.
struct VerifiedPair {
  // Id or name.
  std::string vehicle;
  std::uint64_t query_sequence = 0;
  std::uint64_t matched_sequence = 0;
};

// Adds a loop closure, since the two poses are one place. Prints its name and
// the revision; as JSON, the response. FAILED_PRECONDITION if they are
// rejected.
absl::Status RunConfirm(const Client& client, const VerifiedPair& pair,
                        const Console& console);
// Rejects the candidate, since the two poses are not one place. Prints and
// fails likewise.
absl::Status RunReject(const Client& client, const VerifiedPair& pair,
                       const Console& console);

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_CLI_COMMANDS_VERIFY_COMMAND_H_
