// revisit recordings list
#ifndef REVISIT_CLIENT_CLI_COMMANDS_RECORDINGS_COMMAND_H_
#define REVISIT_CLIENT_CLI_COMMANDS_RECORDINGS_COMMAND_H_

#include <string>

#include "absl/status/status.h"
#include "client/cli/flags.h"
#include "client/revisit/client.h"
#include "client/terminal/terminal.h"

namespace revisit::client {

void AddRecordingsCommand(const Command& program);

// Prints the recordings of a vehicle, the oldest first: as a table, as names,
// or as a revisit.v1.ListRecordingsResponse that holds all pages. `vehicle` is
// an id or a name.
absl::Status RunRecordingsList(const Client& client, const std::string& vehicle,
                               const Terminal& terminal);

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_CLI_COMMANDS_RECORDINGS_COMMAND_H_
