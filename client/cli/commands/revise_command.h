// revisit revise
#ifndef REVISIT_CLIENT_CLI_COMMANDS_REVISE_COMMAND_H_
#define REVISIT_CLIENT_CLI_COMMANDS_REVISE_COMMAND_H_

#include <cstdint>
#include <string>

#include "absl/status/status.h"
#include "client/cli/flags.h"
#include "client/revisit/client.h"
#include "client/terminal/terminal.h"
#include "client/trajectory/optimised_file.h"

namespace revisit::client {

void AddReviseCommand(const Command& program);

struct ReviseOptions {
  std::string vehicle;
  std::string file;
  OptimisedFormat format = OptimisedFormat::kTum;
  // The revision that the optimiser started from; 0 for the present one.
  std::uint64_t expected_revision = 0;
  // Whether poses may be missing from the file.
  bool partial = false;
  // Whether all poses of the file are in one frame, that of the first one's
  // recording: from then on the vehicle has a single recording. Not together
  // with `partial`.
  bool common_frame = false;
};

// Replaces the estimates of all poses that the file names, or of none.
absl::Status RunRevise(const Client& client, const ReviseOptions& options,
                       const Terminal& terminal);

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_CLI_COMMANDS_REVISE_COMMAND_H_
