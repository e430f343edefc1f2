// revisit context list|use|set|show|delete
#ifndef REVISIT_CLIENT_CLI_COMMANDS_CONTEXT_COMMAND_H_
#define REVISIT_CLIENT_CLI_COMMANDS_CONTEXT_COMMAND_H_

#include "client/cli/connection_flags.h"
#include "client/cli/flags.h"

namespace revisit::client {

// Adds the commands about named servers, which ask none. `connection` has what
// the program's flags were given and must outlive the commands.
void AddContextCommand(const Command& program,
                       const ConnectionFlags* connection);

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_CLI_COMMANDS_CONTEXT_COMMAND_H_
