// revisit confirm, revisit reject
#ifndef REVISIT_CLIENT_CLI_COMMANDS_VERIFY_COMMAND_H_
#define REVISIT_CLIENT_CLI_COMMANDS_VERIFY_COMMAND_H_

#include <cstdint>
#include <optional>
#include <string>
#include <vector>

#include "absl/status/status.h"
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

// The verifier's measurement; empty where it measured nothing.
struct VerifiedMeasurement {
  // The query pose as seen from the matched one: x, y, heading, or x, y, z,
  // heading, as in v1::LoopClosureMeasurement.
  std::vector<double> relative;
  // 6, 10 or 36 numbers, as the forms of v1::Covariance have.
  std::vector<double> covariance;
  std::string note;
  std::optional<double> score;
};

// Says what is wrong with the measurement's numbers; empty if nothing is.
std::string CheckMeasurement(const VerifiedMeasurement& measurement);

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
