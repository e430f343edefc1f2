// revisit show
#ifndef REVISIT_CLIENT_CLI_COMMANDS_SHOW_COMMAND_H_
#define REVISIT_CLIENT_CLI_COMMANDS_SHOW_COMMAND_H_

#include <string>

#include "absl/status/status.h"
#include "client/cli/flags.h"
#include "client/revisit/client.h"
#include "client/terminal/terminal.h"

namespace revisit::client {

void AddShowCommand(const Command& program);

// Prints a summary of the pose graph: counts, extent and how sure the newest
// node is. With --json it prints {"vehicle", "nodeCount",
// "consecutiveEdgeCount", "loopClosureEdgeCount", "minXMeters", "maxXMeters",
// "minYMeters", "maxYMeters", "lastNode", "positionSigmaMeters",
// "headingSigmaRadians"}; fields that a graph without nodes does not have are
// left out.
absl::Status RunShow(const Client& client, const std::string& id,
                     const Terminal& terminal);

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_CLI_COMMANDS_SHOW_COMMAND_H_
