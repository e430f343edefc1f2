// Histories of a group's vehicles, joined by what is known of how their frames
// lie to each other.
#ifndef REVISIT_SERVER_FLEET_JOINED_GROUP_H_
#define REVISIT_SERVER_FLEET_JOINED_GROUP_H_

#include <cstdint>
#include <functional>
#include <memory>
#include <optional>
#include <vector>

#include "core/drive/joined_drives.h"
#include "core/geometry/pose.h"
#include "server/fleet/known_history.h"
#include "server/fleet/stored_group.h"

namespace revisit::server {

// Never changes, so that any number of threads may read it.
struct JoinedGroup {
  std::shared_ptr<const StoredGroup> group;
  // By their index among the drives, which follows the vehicles' ids.
  std::vector<std::shared_ptr<const KnownHistory>> histories;
  // Never null.
  std::shared_ptr<const core::JoinedDrives> drives;
};

// Reads a pose of a history's vehicle from the store; nothing where it cannot
// be read.
using PoseReader = std::function<std::optional<core::PoseEstimate>(
    const KnownHistory& history, std::uint64_t sequence)>;

// Links that name a pose which a history does not have, or has dropped, tie
// nothing, and such rejected candidates exclude nothing. `before`: the drives
// that these take the place of, or null. REQUIRES: the histories are of
// members, by the vehicles' ids.
std::shared_ptr<const JoinedGroup> JoinGroup(
    std::shared_ptr<const StoredGroup> group,
    std::vector<std::shared_ptr<const KnownHistory>> histories,
    const PoseReader& read_pose, const core::JoinedDrives* before);

}  // namespace revisit::server

#endif  // REVISIT_SERVER_FLEET_JOINED_GROUP_H_
