// revisit group create|get|list|update|delete, those of its members
// (member_commands.h) and of their frames (group_frames_command.h)
#ifndef REVISIT_CLIENT_CLI_COMMANDS_GROUP_COMMAND_H_
#define REVISIT_CLIENT_CLI_COMMANDS_GROUP_COMMAND_H_

#include <cstdint>
#include <optional>
#include <string>
#include <vector>

#include "absl/status/status.h"
#include "client/cli/commands/deletion.h"
#include "client/cli/flags.h"
#include "client/revisit/client.h"
#include "client/terminal/terminal.h"

namespace revisit::client {

// Adds `group` with all its commands.
void AddGroupCommand(const Command& program);

// The flags that describe a group.
struct GroupDescription {
  // Empty to remove the name.
  std::optional<std::string> display_name;
  // Latitude and longitude in degrees, height in metres; empty if not given.
  std::vector<double> geodetic_origin;
  std::optional<double> fix_bias_meters;
};

struct GroupChanges {
  GroupDescription to;
  bool removes_origin = false;
  // Any if 0.
  std::uint64_t expected_revision = 0;
};

// Say what is wrong with what is given; empty if nothing is.
std::string CheckGroup(const GroupDescription& description);
std::string CheckGroup(const GroupChanges& changes);

// Each prints the group that results. `id` may be a name.
// REQUIRES: CheckGroup().
absl::Status RunGroupCreate(const Client& client, const std::string& id,
                            const GroupDescription& description,
                            const Terminal& terminal);
absl::Status RunGroupGet(const Client& client, const std::string& id,
                         const Terminal& terminal);
absl::Status RunGroupUpdate(const Client& client, const std::string& id,
                            const GroupChanges& changes,
                            const Terminal& terminal);
// Lists the groups of all pages. As JSON: {"groups": [...]}.
absl::Status RunGroupList(const Client& client, const Terminal& terminal);
// Deletes groups, as RunDeletion() does.
absl::Status RunGroupDelete(const Client& client,
                            const std::vector<std::string>& ids, const Ask& ask,
                            const Terminal& terminal);

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_CLI_COMMANDS_GROUP_COMMAND_H_
