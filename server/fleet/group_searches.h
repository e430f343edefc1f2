// Gets ready what searches in groups look at: the groups as they are stored,
// the histories of their vehicles, and both joined. All of it is kept for the
// next search, as long as somebody asks.
//
// Answers are a function of the group, of the histories and of which of these
// the caller may read, wherever they come from and whoever else asks.
#ifndef REVISIT_SERVER_FLEET_GROUP_SEARCHES_H_
#define REVISIT_SERVER_FLEET_GROUP_SEARCHES_H_

#include <chrono>
#include <cstdint>
#include <functional>
#include <map>
#include <memory>
#include <string>

#include "absl/status/statusor.h"
#include "server/fleet/group_scope.h"
#include "server/fleet/stored_group.h"
#include "server/sessions/executor.h"
#include "server/sessions/fleet.h"
#include "server/sessions/record_codec.h"

namespace revisit::server {

class Metrics;
class Storage;

// Thread-safe.
class GroupSearches {
 public:
  struct Options {
    // Of the histories that are read from the store.
    std::int64_t most_bytes = std::int64_t{1} << 30;
    // Histories that nobody has asked for this long are let go.
    std::chrono::milliseconds idle_unload{std::chrono::minutes(10)};
  };

  // The executor runs work that reads the store. All of these must outlive
  // this.
  GroupSearches(Fleet* fleet, Storage* storage, const RecordCodec* codec,
                Executor* executor, const Options& options);
  // Waits for what is under way; not on a thread of the executor. Nobody may
  // call it any more.
  ~GroupSearches();

  GroupSearches(const GroupSearches&) = delete;
  GroupSearches& operator=(const GroupSearches&) = delete;

  // Calls `then` once, on a thread of the executor. Errors: NOT_FOUND
  // (GROUP_NOT_FOUND), (MEMBER_NOT_FOUND) for one of the vehicles that is no
  // member, or may not be read; UNAVAILABLE (GROUP_NOT_READY) while histories
  // are read from the store, unless the request allows that; those of the
  // storage. For an asking vehicle that is needed also: GROUP_NOT_READY in any
  // case, DATA_LOSS (STORE_CORRUPT) where it is damaged, RESOURCE_EXHAUSTED
  // (MEMORY_PRESSURE) where its history has no room. A search holds a session
  // of the asking vehicle, which is loaded: then its history is known.
  void Prepare(ScopeRequest request,
               std::function<void(absl::StatusOr<GroupScope>)> then);

  // A group as it is stored, no older than kFreshGroup (group_cache.h), with
  // the uids of its vehicles; those of damaged ones are left out. Calls `then`
  // once, on a thread of the executor. Errors: NOT_FOUND (GROUP_NOT_FOUND);
  // those of the storage.
  struct NamedGroup {
    std::shared_ptr<const StoredGroup> group;
    std::map<VehicleKey, std::string> uids;
  };
  void ReadGroup(std::string id,
                 std::function<void(absl::StatusOr<NamedGroup>)> then);

  // Lets go the histories that nobody has asked for, since before `now` less
  // Options::idle_unload. The server calls it on a timer.
  void UnloadIdle(std::chrono::steady_clock::time_point now);

  void CollectMetrics(Metrics* metrics) const;

 private:
  struct State;
  const std::unique_ptr<State> state_;
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_FLEET_GROUP_SEARCHES_H_
