// revisit demo
#ifndef REVISIT_CLIENT_CLI_COMMANDS_DEMO_COMMAND_H_
#define REVISIT_CLIENT_CLI_COMMANDS_DEMO_COMMAND_H_

#include "client/cli/flags.h"

namespace revisit::client {

// Evaluates the shipped drive on a private server, draws its map, and searches
// with its days as two vehicles of one group.
void AddDemoCommand(const Command& program);

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_CLI_COMMANDS_DEMO_COMMAND_H_
