// revisit show
#ifndef REVISIT_CLIENT_CLI_COMMANDS_SHOW_COMMAND_H_
#define REVISIT_CLIENT_CLI_COMMANDS_SHOW_COMMAND_H_

#include <string>

#include "absl/status/status.h"
#include "client/cli/console.h"
#include "client/revisit/client.h"

namespace revisit::client {

// A summary of the pose graph: counts, extent and how sure the newest node is.
// As JSON: {"vehicle", "nodeCount", "consecutiveEdgeCount",
// "loopClosureEdgeCount", "minXMeters", "maxXMeters", "minYMeters",
// "maxYMeters", "lastNode", "positionSigmaMeters", "headingSigmaRadians"}; what
// a graph without nodes does not have is left out.
absl::Status RunShow(const Client& client, const std::string& id,
                     const Console& console);

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_CLI_COMMANDS_SHOW_COMMAND_H_
