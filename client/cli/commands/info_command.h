// revisit info
#ifndef REVISIT_CLIENT_CLI_COMMANDS_INFO_COMMAND_H_
#define REVISIT_CLIENT_CLI_COMMANDS_INFO_COMMAND_H_

#include <string>

#include "absl/status/status.h"
#include "client/cli/flags.h"
#include "client/revisit/client.h"
#include "client/terminal/terminal.h"

namespace revisit::client {

void AddInfoCommand(const Command& program);

// Prints the version and the limits of the server at `address`. As JSON, the
// response.
absl::Status RunInfo(const Client& client, const std::string& address,
                     const Terminal& terminal);

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_CLI_COMMANDS_INFO_COMMAND_H_
