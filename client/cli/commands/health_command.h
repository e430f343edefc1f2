// revisit health
#ifndef REVISIT_CLIENT_CLI_COMMANDS_HEALTH_COMMAND_H_
#define REVISIT_CLIENT_CLI_COMMANDS_HEALTH_COMMAND_H_

#include "client/cli/flags.h"

namespace revisit::client {

// Asks the standard health service, for probes of containers and scripts.
void AddHealthCommand(const Command& program);

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_CLI_COMMANDS_HEALTH_COMMAND_H_
