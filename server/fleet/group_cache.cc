#include "server/fleet/group_cache.h"

#include <iterator>

#include "server/sessions/vehicle_reader.h"
#include "server/storage/storage.h"

namespace revisit::server {
namespace {

template <typename Map>
void EraseOlder(GroupCache::Clock::time_point since, Map* map) {
  for (auto i = map->begin(); i != map->end();) {
    i = i->second.last_asked < since ? map->erase(i) : std::next(i);
  }
}

}  // namespace

absl::StatusOr<std::shared_ptr<const StoredGroup>> GroupCache::Group(
    const std::string& id) {
  const auto asked = Clock::now();
  std::shared_ptr<const StoredGroup> known;
  {
    const MutexLock lock(&mutex_);
    const auto found = groups_.find(id);
    if (found != groups_.end()) {
      found->second.last_asked = asked;
      known = found->second.group;
      if (asked - found->second.looked < kFreshGroup) return known;
    }
  }
  absl::StatusOr<std::shared_ptr<const StoredGroup>> group =
      ReadIfChanged(id, known);
  const MutexLock lock(&mutex_);
  if (group.ok()) {
    groups_[id] = {*group, asked, asked};
  } else if (!absl::IsUnavailable(group.status())) {
    groups_.erase(id);
  } else if (known != nullptr && storage_->CheckLease().ok()) {
    return known;
  }
  return group;
}

absl::StatusOr<std::shared_ptr<const StoredGroup>> GroupCache::ReadIfChanged(
    const std::string& id,
    const std::shared_ptr<const StoredGroup>& known) const {
  GroupStorage* const groups = &storage_->Groups();
  if (known != nullptr) {
    const absl::StatusOr<std::vector<GroupRecord>> versions =
        groups->ListGroupVersions(std::vector<std::string>{id});
    if (!versions.ok()) return versions.status();
    if (versions->size() == 1 && versions->front().version == known->version) {
      return known;
    }
  }
  absl::StatusOr<StoredGroup> group = ReadStoredGroup(groups, id);
  if (!group.ok()) return group.status();
  return std::make_shared<const StoredGroup>(*std::move(group));
}

std::shared_ptr<const JoinedGroup> GroupCache::Joined(
    const std::shared_ptr<const StoredGroup>& group, Histories histories) {
  JoinKey key{group->id, {}};
  for (const auto& history : histories) key.second.push_back(history->key);
  const auto now = Clock::now();
  std::shared_ptr<const JoinedGroup> before;
  {
    const MutexLock lock(&mutex_);
    const auto found = joins_.find(key);
    if (found != joins_.end()) before = found->second.joined;
    if (before != nullptr && before->group == group &&
        before->histories == histories) {
      found->second.last_asked = now;
      return before;
    }
  }
  auto joined = JoinGroup(
      group, std::move(histories),
      [this](const KnownHistory& history, std::uint64_t sequence) {
        return ReadPose(history, sequence);
      },
      before == nullptr ? nullptr : before->drives.get());
  const MutexLock lock(&mutex_);
  joins_[key] = {joined, now};
  return joined;
}

std::optional<core::PoseEstimate> GroupCache::ReadPose(
    const KnownHistory& history, std::uint64_t sequence) {
  const PoseKey key{history.key, sequence};
  const auto now = Clock::now();
  {
    const MutexLock lock(&mutex_);
    const auto found = poses_.find(key);
    if (found != poses_.end() && found->second.series == history.series) {
      found->second.last_asked = now;
      return found->second.pose;
    }
  }
  const VehicleReader vehicle(history.vehicle_id, storage_, codec_);
  const absl::StatusOr<std::vector<core::PoseSample>> around =
      vehicle.ReadPosesAround(history.key, sequence, history.config);
  if (!around.ok()) return std::nullopt;
  for (const core::PoseSample& sample : *around) {
    if (sample.sequence != sequence) continue;
    const core::PoseEstimate pose{sample.pose, sample.covariance};
    const MutexLock lock(&mutex_);
    poses_[key] = {history.series, pose, now};
    return pose;
  }
  return std::nullopt;
}

void GroupCache::Forget(Clock::time_point since) {
  const MutexLock lock(&mutex_);
  EraseOlder(since, &groups_);
  EraseOlder(since, &joins_);
  EraseOlder(since, &poses_);
}

}  // namespace revisit::server
