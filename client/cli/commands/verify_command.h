// revisit confirm, revisit reject
#ifndef REVISIT_CLIENT_CLI_COMMANDS_VERIFY_COMMAND_H_
#define REVISIT_CLIENT_CLI_COMMANDS_VERIFY_COMMAND_H_

#include <cstdint>
#include <string>

#include "absl/status/status.h"
#include "client/cli/commands/verified_measurement.h"
#include "client/cli/flags.h"
#include "client/revisit/client.h"
#include "client/terminal/terminal.h"

namespace revisit::client {

void AddConfirmCommand(const Command& program);
void AddRejectCommand(const Command& program);

// Two poses of a candidate that somebody has looked at.
struct VerifiedPair {
  // Id or name.
  std::string vehicle;
  std::uint64_t query_sequence = 0;
  std::uint64_t matched_sequence = 0;
  // Name of the stored candidate that this answers; empty if there is none.
  std::string candidate = "";
};

// Adds a loop closure, since the two poses are one place. Prints its name and
// the revision, and how well a measurement agrees with the graph; as JSON, the
// response. REQUIRES: CheckMeasurement().
absl::Status RunConfirm(const Client& client, const VerifiedPair& pair,
                        const VerifiedMeasurement& measurement,
                        const Terminal& terminal);
// Rejects the candidate, since the two poses are not one place; the note is
// for people and may be empty. Prints and fails likewise.
absl::Status RunReject(const Client& client, const VerifiedPair& pair,
                       const std::string& note, const Terminal& terminal);

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_CLI_COMMANDS_VERIFY_COMMAND_H_
