// revisit poses list
#ifndef REVISIT_CLIENT_CLI_COMMANDS_POSES_COMMAND_H_
#define REVISIT_CLIENT_CLI_COMMANDS_POSES_COMMAND_H_

#include <cstdint>
#include <limits>
#include <string>

#include "absl/status/status.h"
#include "client/cli/flags.h"
#include "client/revisit/client.h"
#include "client/terminal/terminal.h"
#include "revisit/v1/pose_graph_service.pb.h"

namespace revisit::client {

void AddPosesCommand(const Command& program);

struct PosesListOptions {
  // Id, or name.
  std::string vehicle;
  // Both are listed.
  std::uint64_t from = 1;
  std::uint64_t to = std::numeric_limits<std::int64_t>::max();
  v1::PoseView view = v1::POSE_VIEW_CURRENT;
};

// Lists stored poses page by page, in memory that does not grow with them. As
// JSON: {"poses": [...]} with one pose on each line.
absl::Status RunPosesList(const Client& client, const PosesListOptions& options,
                          const Terminal& terminal);

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_CLI_COMMANDS_POSES_COMMAND_H_
