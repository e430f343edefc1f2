// revisit group frames
#ifndef REVISIT_CLIENT_CLI_COMMANDS_GROUP_FRAMES_COMMAND_H_
#define REVISIT_CLIENT_CLI_COMMANDS_GROUP_FRAMES_COMMAND_H_

#include "absl/status/status.h"
#include "client/cli/flags.h"
#include "client/revisit/client.h"
#include "client/terminal/terminal.h"
#include "revisit/v1/pose_graph_service.pb.h"

namespace revisit::client {

// Adds it below `revisit group`.
void AddGroupFramesCommand(const Command& group);

// Prints where the recordings of a group's members lie in the frame of another
// member's last one: as a table, as names of the recordings, or as a
// revisit.v1.ListFrameTransformsResponse that holds all pages. ABORTED where
// the group changed from page to page. Vehicles and group may be ids.
absl::Status RunGroupFrames(const Client& client,
                            v1::ListFrameTransformsRequest request,
                            const Terminal& terminal);

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_CLI_COMMANDS_GROUP_FRAMES_COMMAND_H_
