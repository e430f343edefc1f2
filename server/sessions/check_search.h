// One search of a stored check, in turns of the searches' threads, in the scope
// that the vehicle's settings name.
#ifndef REVISIT_SERVER_SESSIONS_CHECK_SEARCH_H_
#define REVISIT_SERVER_SESSIONS_CHECK_SEARCH_H_

#include <chrono>
#include <cstdint>
#include <functional>
#include <optional>
#include <string>
#include <utility>

#include "core/drive/node_index.h"
#include "core/search/candidates/candidate.h"
#include "server/sessions/check_scopes.h"
#include "server/sessions/search_turns.h"
#include "server/sessions/vehicle_queue.h"
#include "server/sessions/vehicle_state.h"

namespace revisit::server {

// Belongs to the strand.
class CheckSearch {
 public:
  struct Policy {
    // The flow of its turns (VehicleQueue::PostSearch()).
    std::string flow;
    // The most comparisons of one search; one that needs more finds nothing.
    std::int64_t max_steps = 0;
    // Null where all checks search the vehicle's own history alone.
    CheckScopes* scopes = nullptr;
  };

  CheckSearch(VehicleState* vehicle, VehicleQueue* queue, Policy policy)
      : vehicle_(vehicle), queue_(queue), policy_(std::move(policy)) {}

  CheckSearch(const CheckSearch&) = delete;
  CheckSearch& operator=(const CheckSearch&) = delete;

  // The next search is of another check, in a scope of its own.
  void Restart();
  // It is searched anew, in the scope that is ready.
  void RestartTurns();

  // Whether Post() may be called: not soon after a scope was not ready.
  bool MayPost() const;
  // From now on it may.
  void TryAgain() { not_before_ = {}; }
  // Gets the scope of the search ready unless it is, and has `turn` take a turn
  // in the lane of searches; calls `not_ready` instead where that cannot be
  // done now. Either comes once, later, on the strand. REQUIRES: the vehicle is
  // loaded.
  void Post(std::function<void()> turn, std::function<void()> not_ready);

  // Whether the scope that was got ready is still the one that the vehicle's
  // settings name.
  bool is_ready() const { return ready_for_ == Group(); }
  // Takes a turn of the search at a node. Nothing if it needs another one: it
  // has given way to other work of the vehicle, or marks are missing.
  // REQUIRES: within `turn`; is_ready().
  std::optional<core::CandidateSet> TakeTurn(core::NodeIndex node);

  // The scope of the search that found; null for the vehicle's own history
  // alone.
  const CheckScopePtr& scope() const { return scope_; }
  SearchTurns::Clock::duration duration() const { return turns_.duration(); }

 private:
  using Clock = std::chrono::steady_clock;

  // Empty if none is searched.
  std::string Group() const;
  void Prepare(const std::string& group, std::function<void()> turn,
               std::function<void()> not_ready);

  VehicleState* const vehicle_;
  VehicleQueue* const queue_;
  const Policy policy_;

  CheckTurns turns_;
  // The group whose scope is ready; nothing if none is. Empty for none.
  std::optional<std::string> ready_for_;
  CheckScopePtr scope_;
  Clock::time_point not_before_{};
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_SESSIONS_CHECK_SEARCH_H_
