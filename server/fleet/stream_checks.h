// Checks of one stream of poses that search in a group.
#ifndef REVISIT_SERVER_FLEET_STREAM_CHECKS_H_
#define REVISIT_SERVER_FLEET_STREAM_CHECKS_H_

#include <atomic>
#include <chrono>
#include <cstdint>
#include <deque>
#include <functional>
#include <memory>
#include <optional>
#include <string>
#include <utility>
#include <vector>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "core/base/mutex.h"
#include "core/search/candidates/candidate.h"
#include "server/fleet/group_scope.h"
#include "server/sessions/append_request.h"
#include "server/sessions/search_turns.h"
#include "server/sessions/vehicle_session.h"

namespace revisit::server {

class GroupSearches;

// They are made one at a time, in the order in which they fell due, beside the
// appends of the vehicle: acknowledgements wait neither for them nor for
// histories to be read. One that waits takes a few bytes, so that as many wait
// as the poses make fall due.
//
// Thread-safe.
class StreamChecks : public std::enable_shared_from_this<StreamChecks> {
 public:
  // Calls come one at a time, on any thread, without locks held.
  class Observer {
   public:
    virtual ~Observer() = default;

    // `duration` is that of the search, without its waits.
    virtual void OnFound(const VehicleView& view, core::CandidateSet set,
                         std::chrono::nanoseconds duration,
                         const GroupScope& scope) = 0;
    // No check is under way or waits any more. Unless this is OK, the last one
    // could not be made, and no other will be.
    virtual void OnIdle(const absl::Status& status) = 0;
  };

  // `scope`: its `allow_partial` is about Open() alone. `searches` is there
  // until GiveUp() has returned.
  StreamChecks(std::shared_ptr<VehicleSession> session, GroupSearches* searches,
               std::shared_ptr<const CheckOrder> order, ScopeRequest scope,
               std::weak_ptr<Observer> observer)
      : session_(std::move(session)),
        searches_(searches),
        order_(std::move(order)),
        observer_(std::move(observer)),
        scope_(std::move(scope)) {}

  StreamChecks(const StreamChecks&) = delete;
  StreamChecks& operator=(const StreamChecks&) = delete;

  // Calls `then` once, on another thread, with OK once checks may be made, or
  // with the error of GroupSearches::Prepare(); after GiveUp() not at all. From
  // then on they search the histories that are there. REQUIRES: the session is
  // loaded.
  void Open(std::function<void(const absl::Status&)> then)
      ABSL_LOCKS_EXCLUDED(mutex_);

  // The caller's rights may be others than before: see ScopeRequest::may_read.
  void SetMayRead(std::function<bool(const std::string&)> may_read)
      ABSL_LOCKS_EXCLUDED(mutex_);

  // Checks fell due at these poses (AppendObserver::OnChecksDue()). Several at
  // one pose are one. One whose pose is there no more when its turn comes,
  // since it was dropped or given up, is left out.
  void Add(const std::vector<std::uint64_t>& sequences)
      ABSL_LOCKS_EXCLUDED(mutex_);

  // Checks that wait are not made, the one under way ends soon without an
  // answer, and none begins any more. Once this has returned `searches` is
  // asked no more.
  void GiveUp() ABSL_LOCKS_EXCLUDED(mutex_);

  // Whether none is under way or waits.
  bool idle() const ABSL_LOCKS_EXCLUDED(mutex_);

 private:
  // One that is under way.
  struct Check {
    std::uint64_t sequence = 0;
    GroupScope scope;
    CheckTurns turns;
  };

  // Gets the scope of the next check ready.
  void Begin() ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_);
  void Search(std::uint64_t sequence, absl::StatusOr<GroupScope> ready);
  // Whether the check is over.
  bool TakeTurn(Check* check, const absl::StatusOr<VehicleView>& view);
  // The status to end the check with, or nothing if it needs another turn.
  std::optional<absl::Status> Answer(Check* check, const VehicleView& view);
  void End(const absl::Status& status) ABSL_LOCKS_EXCLUDED(mutex_);

  const std::shared_ptr<VehicleSession> session_;
  GroupSearches* const searches_;
  const std::shared_ptr<const CheckOrder> order_;
  const std::weak_ptr<Observer> observer_;
  // Written with `mutex_`, so that whoever holds it sees no check begin.
  std::atomic<bool> given_up_{false};

  mutable Mutex mutex_;
  ScopeRequest scope_ ABSL_GUARDED_BY(mutex_);
  // Poses of the checks that wait, and the last one that came.
  std::deque<std::uint64_t> waiting_ ABSL_GUARDED_BY(mutex_);
  std::uint64_t last_added_ ABSL_GUARDED_BY(mutex_) = 0;
  bool is_checking_ ABSL_GUARDED_BY(mutex_) = false;
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_FLEET_STREAM_CHECKS_H_
