// Looks at the stored checks of one vehicle again, once something changed that
// they depend on: closures, rejected candidates, poses or settings.
//
// A look goes through the rows, a page at a time, between other work of the
// vehicle. It marks checks whose basis (check_basis.h) is another one as stale,
// withdraws candidates whose poses were dropped, renews values, and opens
// candidates again whose loop closure others contradict. What is stale follows
// from the rows, so whoever loads the vehicle comes to the same.
//
// Then the stale checks are searched again, the most valuable first, in turns
// of the searches' threads, and what was found is compared with the candidates
// that are kept: those that became improbable are withdrawn, those that came
// back are open again, and new ones get numbers of their own.
//
// Work is bounded: a change allows kSearchesPerChange searches, each look of
// the fleet for what is owed (Fleet::PayChecks()) as many more.
#ifndef REVISIT_SERVER_SESSIONS_SECOND_SEARCHES_H_
#define REVISIT_SERVER_SESSIONS_SECOND_SEARCHES_H_

#include <atomic>
#include <chrono>
#include <cstddef>
#include <cstdint>
#include <functional>
#include <map>
#include <memory>
#include <optional>
#include <set>
#include <string>
#include <utility>
#include <vector>

#include "absl/status/statusor.h"
#include "core/drive/pose_graph.h"
#include "core/drive/suspects.h"
#include "core/search/candidates/candidate.h"
#include "core/search/candidates/value.h"
#include "server/sessions/check_basis.h"
#include "server/sessions/check_changes.h"
#include "server/sessions/check_monitor.h"
#include "server/sessions/check_scopes.h"
#include "server/sessions/check_search.h"
#include "server/sessions/check_steps.h"
#include "server/sessions/link_decisions.h"
#include "server/sessions/vehicle_queue.h"
#include "server/sessions/vehicle_state.h"
#include "server/storage/records.h"

namespace revisit::server {

inline constexpr int kSearchesPerChange = 64;
// The searches of so many changes may be saved up.
inline constexpr int kMostChangesAllowed = 4;

struct SecondSearchesPolicy {
  // As StoredChecksPolicy::max_search_steps.
  std::int64_t max_search_steps = 0;
  // As StoredChecksPolicy::scopes.
  CheckScopes* scopes = nullptr;
  // As StoredChecksPolicy::searches_per_change.
  int searches_per_change = kSearchesPerChange;
  // Null if nobody counts.
  std::shared_ptr<CheckMonitor> monitor = nullptr;
};

// Belongs to the strand, but for what is said to be called from any thread.
class SecondSearches {
 public:
  SecondSearches(VehicleState* vehicle, VehicleQueue* queue,
                 const CheckChanges* changes, CheckBasis* basis,
                 LinkDecisions* links, SecondSearchesPolicy policy)
      : vehicle_(vehicle),
        queue_(queue),
        changes_(changes),
        basis_(basis),
        links_(links),
        steps_(vehicle, queue, changes),
        policy_(std::move(policy)),
        search_(vehicle, queue,
                {"second searches", policy_.max_search_steps, policy_.scopes}) {
  }
  ~SecondSearches() { NoteStale(0); }

  SecondSearches(const SecondSearches&) = delete;
  SecondSearches& operator=(const SecondSearches&) = delete;

  // Looks whether something changed, and goes on. Call after a load and every
  // change; costs next to nothing where there is nothing to do.
  void Consider();
  // Allows more searches, also in a group that was not ready, and to judge
  // closures again; then as Consider().
  void AllowMore();
  // Rows were stored that the last look may have missed.
  void LookAgain() { looks_again_ = true; }
  // Whether AllowMore() would have more to do. From any thread.
  bool is_behind() const { return is_behind_.load(); }

 private:
  using Clock = std::chrono::steady_clock;

  // A check that is to be searched again.
  struct Waiting {
    double value = 0.0;
    std::uint64_t sequence = 0;
  };
  // A candidate of the search that is under way.
  struct Found {
    StoredCandidate candidate;
    bool is_kept = false;
  };
  struct Answer {
    std::uint64_t sequence = 0;
    std::vector<Found> found;
    // By uid, the graphs of the other vehicles that were searched.
    std::map<std::string, const core::PoseGraph*> others;
    // Keeps them.
    CheckScopePtr scope;
    std::string bytes;
  };

  void Allow();
  bool MustJudge() const;
  void Look();
  void JudgeClosures();
  // As CheckSteps::Run(); gives up where it did not work.
  void RunStep(std::function<absl::StatusOr<ChecksWrite>()> step,
               std::function<void(bool)> then);
  void LookAtNextPage();
  absl::StatusOr<ChecksWrite> LookAtPage();
  void LookAt(const CheckRecord& record, core::VarianceReductions* reductions,
              ChecksWrite* write);
  void EndLook();
  // Gives up what was begun, until something calls Consider() again.
  void GiveUp();
  void Search();
  void PostTurn();
  void TakeTurn();
  Answer Read(const core::CandidateSet& set) const;
  // The graph in which the candidate's match lies; null where that was not
  // searched.
  const core::PoseGraph* GraphOf(const StoredCandidate& candidate,
                                 const Answer& answer) const;
  // By candidate of the check: the nearest one that was found, if any lies at
  // its place, which is then taken from `found`.
  std::vector<std::optional<Found>> TakeSame(const StoredCheck& check,
                                             const Answer& answer,
                                             std::vector<Found>* found) const;
  absl::StatusOr<ChecksWrite> Compare(const Answer& answer);
  void NoteStale(std::size_t count);

  VehicleState* const vehicle_;
  VehicleQueue* const queue_;
  const CheckChanges* const changes_;
  CheckBasis* const basis_;
  LinkDecisions* const links_;
  CheckSteps steps_;
  const SecondSearchesPolicy policy_;

  // The version that was seen last, and the last one of which all rows were
  // looked at.
  std::optional<CheckBasis::Version> seen_;
  std::optional<CheckBasis::Version> looked_;
  bool looks_again_ = false;
  int allowed_ = 0;
  // A look or a search is under way, and does not wait for Consider().
  bool is_at_work_ = false;

  // ---- The look
  CheckBasis::Version looks_at_;
  std::uint64_t look_from_ = 0;
  bool may_judge_ = true;
  // The version of pairs of which closures were judged last, and which of them
  // contradict others.
  std::optional<std::uint64_t> judged_;
  std::optional<core::SuspectSearch> judging_;
  std::set<std::string> contradicted_;

  // ---- Searches
  // The most valuable last.
  std::vector<Waiting> waiting_;
  // Its turns are one flow beside those of all callers, whichever vehicle they
  // are of.
  CheckSearch search_;

  std::size_t stale_ = 0;
  std::atomic<bool> is_behind_{false};
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_SESSIONS_SECOND_SEARCHES_H_
