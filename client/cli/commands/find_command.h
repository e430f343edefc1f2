// revisit find
#ifndef REVISIT_CLIENT_CLI_COMMANDS_FIND_COMMAND_H_
#define REVISIT_CLIENT_CLI_COMMANDS_FIND_COMMAND_H_

#include "absl/status/status.h"
#include "client/cli/flags.h"
#include "client/revisit/client.h"
#include "client/terminal/terminal.h"

namespace revisit::client {

void AddFindCommand(const Command& program);

// Prints the candidates at one pose. `request.vehicle` may be an id.
absl::Status RunFind(const Client& client, v1::FindCandidatesRequest request,
                     const Terminal& terminal);

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_CLI_COMMANDS_FIND_COMMAND_H_
