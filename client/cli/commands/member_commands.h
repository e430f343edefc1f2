// revisit group add|set-datum|remove|members
#ifndef REVISIT_CLIENT_CLI_COMMANDS_MEMBER_COMMANDS_H_
#define REVISIT_CLIENT_CLI_COMMANDS_MEMBER_COMMANDS_H_

#include <cstdint>
#include <optional>
#include <string>
#include <vector>

#include "absl/status/status.h"
#include "client/cli/flags.h"
#include "client/revisit/client.h"
#include "client/terminal/terminal.h"
#include "client/trajectory/recording_starts.h"

namespace revisit::client {

// Adds them below `revisit group`.
void AddMemberCommands(const Command& group);

// A vehicle in a group; both are ids or names.
struct MemberReference {
  std::string group;
  std::string vehicle;
};

// Where the frame of a vehicle's first recording lies in that of the group.
struct GivenDatum {
  // x, y, heading of a planar vehicle, or x, y, z, heading of a spatial one;
  // empty where there is no datum.
  std::vector<double> pose;
  std::optional<RecordingChoice::Size> size;
  std::string id;
};

// Says what is wrong with the numbers; empty if nothing is.
std::string CheckDatum(const GivenDatum& datum);

// These three print the name of the member and the group's revision; as JSON,
// the response or, of what is removed, {"name", "revision"}.
// REQUIRES: CheckDatum().
absl::Status RunMemberAdd(const Client& client, const MemberReference& member,
                          const GivenDatum& datum, const Terminal& terminal);
// Replaces the datum, or removes it where none is given.
absl::Status RunMemberSetDatum(const Client& client,
                               const MemberReference& member,
                               const GivenDatum& datum,
                               std::uint64_t expected_revision,
                               const Terminal& terminal);
absl::Status RunMemberRemove(const Client& client,
                             const MemberReference& member,
                             const Terminal& terminal);
// Lists the members of all pages. As JSON: {"members": [...]}. `group` is an id
// or a name. DATA_LOSS if rows of others are damaged, below those that can be
// read.
absl::Status RunMembers(const Client& client, const std::string& group,
                        const Terminal& terminal);

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_CLI_COMMANDS_MEMBER_COMMANDS_H_
