// Groups as they are stored, and what was joined of their vehicles' histories.
#ifndef REVISIT_SERVER_FLEET_GROUP_CACHE_H_
#define REVISIT_SERVER_FLEET_GROUP_CACHE_H_

#include <chrono>
#include <cstdint>
#include <map>
#include <memory>
#include <optional>
#include <string>
#include <utility>
#include <vector>

#include "absl/status/statusor.h"
#include "core/base/mutex.h"
#include "server/fleet/joined_group.h"
#include "server/fleet/known_history.h"
#include "server/fleet/stored_group.h"
#include "server/sessions/record_codec.h"

namespace revisit::server {

class Storage;

// How old the version of a group may be that is used as it is.
inline constexpr std::chrono::seconds kFreshGroup{1};

// Thread-safe. Reads the store on the caller's thread.
class GroupCache {
 public:
  using Clock = std::chrono::steady_clock;
  using Histories = std::vector<std::shared_ptr<const KnownHistory>>;

  GroupCache(Storage* storage, const RecordCodec* codec)
      : storage_(storage), codec_(codec) {}

  // The group, no older than kFreshGroup; older where the store cannot be
  // reached, as long as this server may answer at all (Storage::CheckLease()).
  // Errors: those of ReadStoredGroup().
  absl::StatusOr<std::shared_ptr<const StoredGroup>> Group(
      const std::string& id) ABSL_LOCKS_EXCLUDED(mutex_);

  // Joins histories of the group's members, by the vehicles' ids; the last ones
  // are kept for each choice of vehicles.
  std::shared_ptr<const JoinedGroup> Joined(
      const std::shared_ptr<const StoredGroup>& group, Histories histories)
      ABSL_LOCKS_EXCLUDED(mutex_);

  // Forgets what nobody has asked for since then.
  void Forget(Clock::time_point since) ABSL_LOCKS_EXCLUDED(mutex_);

 private:
  struct KnownGroup {
    std::shared_ptr<const StoredGroup> group;
    Clock::time_point looked;
    Clock::time_point last_asked;
  };
  struct Join {
    std::shared_ptr<const JoinedGroup> joined;
    Clock::time_point last_asked;
  };
  struct KnownPose {
    std::string series;
    core::PoseEstimate pose;
    Clock::time_point last_asked;
  };
  // The group's id and its vehicles' keys.
  using JoinKey = std::pair<std::string, std::vector<VehicleKey>>;
  using PoseKey = std::pair<VehicleKey, std::uint64_t>;

  absl::StatusOr<std::shared_ptr<const StoredGroup>> ReadIfChanged(
      const std::string& id,
      const std::shared_ptr<const StoredGroup>& known) const;
  std::optional<core::PoseEstimate> ReadPose(const KnownHistory& history,
                                             std::uint64_t sequence)
      ABSL_LOCKS_EXCLUDED(mutex_);

  Storage* const storage_;
  const RecordCodec* const codec_;
  Mutex mutex_;
  std::map<std::string, KnownGroup> groups_ ABSL_GUARDED_BY(mutex_);
  std::map<JoinKey, Join> joins_ ABSL_GUARDED_BY(mutex_);
  // The poses of links, as long as their vehicles' poses stay what they are.
  std::map<PoseKey, KnownPose> poses_ ABSL_GUARDED_BY(mutex_);
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_FLEET_GROUP_CACHE_H_
