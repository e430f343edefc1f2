// The checks of one vehicle that are stored (VehicleConfig::checks), and what
// becomes of their candidates.
//
// A check that is due is a debt: acknowledgements do not wait for it. Which
// ones are owed follows from the graph and from how far the store says that
// they were made (core::Drive::NextCheck()), so nothing is kept of them, and
// whoever loads the vehicle goes on where another server ended. Each is
// searched with the vehicle's own settings, in the order of poses, in turns of
// the searches' threads, each of which makes as many checks as fit in; a turn
// that holds up other work of the vehicle gives way, a few times. What was
// found is written behind the turn, that of several turns at a time where
// writes take longer.
#ifndef REVISIT_SERVER_SESSIONS_STORED_CHECKS_H_
#define REVISIT_SERVER_SESSIONS_STORED_CHECKS_H_

#include <atomic>
#include <chrono>
#include <cstddef>
#include <cstdint>
#include <deque>
#include <functional>
#include <limits>
#include <memory>
#include <optional>
#include <string>
#include <vector>

#include "absl/status/statusor.h"
#include "core/drive/drive.h"
#include "server/sessions/appends_in_flight.h"
#include "server/sessions/check_basis.h"
#include "server/sessions/check_changes.h"
#include "server/sessions/check_codec.h"
#include "server/sessions/check_monitor.h"
#include "server/sessions/check_scopes.h"
#include "server/sessions/check_search.h"
#include "server/sessions/check_steps.h"
#include "server/sessions/link_decisions.h"
#include "server/sessions/second_searches.h"
#include "server/sessions/vehicle_queue.h"
#include "server/sessions/vehicle_state.h"
#include "server/storage/records.h"

namespace revisit::server {

// How long checks are kept: those on all of whose candidates somebody decided,
// those with open ones, and how many of a vehicle at most.
inline constexpr std::chrono::hours kDecidedKept{30 * 24};
inline constexpr std::chrono::hours kOpenKept{90 * 24};
inline constexpr std::uint64_t kMostChecks = 10'000;

struct StoredChecksPolicy {
  // Null: no checks are stored, whatever vehicles' settings say.
  const CheckCodec* codec = nullptr;
  // The most comparisons of one search; a check that needs more finds nothing.
  std::int64_t max_search_steps = std::numeric_limits<std::int64_t>::max();
  // Null if checks search no groups, whatever vehicles' settings say. Outlives
  // the sessions.
  CheckScopes* scopes = nullptr;
  // Null if nobody counts.
  std::shared_ptr<CheckMonitor> monitor = nullptr;
  // How often a vehicle in memory is looked through for checks that are kept no
  // longer.
  std::chrono::steady_clock::duration tidy_period = std::chrono::hours(1);
  std::uint64_t most_checks = kMostChecks;
  // How long searches of one vehicle follow each other before those of others
  // get their turn: several small ones, so that what a turn and a write take
  // beside them is shared.
  std::chrono::steady_clock::duration turn = std::chrono::milliseconds(10);
  // Second searches that a change allows (second_searches.h).
  int searches_per_change = kSearchesPerChange;
};

// Belongs to the strand, but for what is said to be called from any thread.
class StoredChecks {
 public:
  StoredChecks(VehicleState* vehicle, VehicleQueue* queue,
               AppendsInFlight* in_flight, StoredChecksPolicy policy)
      : vehicle_(vehicle),
        queue_(queue),
        in_flight_(in_flight),
        policy_(std::move(policy)),
        changes_(vehicle, policy_.codec),
        steps_(vehicle, queue, &changes_),
        basis_(vehicle, policy_.scopes != nullptr),
        links_(vehicle, queue, &changes_, &basis_, policy_.scopes,
               [this] { second_.Consider(); }),
        second_(vehicle, queue, &changes_, &basis_, &links_,
                {policy_.max_search_steps, policy_.scopes,
                 policy_.searches_per_change, policy_.monitor}),
        search_(vehicle, queue,
                {"stored checks", policy_.max_search_steps, policy_.scopes}) {}
  ~StoredChecks() { NoteDebt(0); }

  StoredChecks(const StoredChecks&) = delete;
  StoredChecks& operator=(const StoredChecks&) = delete;

  // Goes on with what is owed. Call whenever that may be more: after a load, an
  // append or a change of the vehicle.
  void Consider();

  // Whether the store says that checks are owed although none is: it does not
  // know yet that none was due since the last one. From any thread.
  bool is_unsettled() const { return is_unsettled_.load(); }
  // Tells the store, so that nobody loads the vehicle to look; then calls
  // `then`, also where that failed. REQUIRES: no change of the vehicle is under
  // way.
  void Settle(std::function<void()> then);

  // Whether GoOn() is to be called from time to time: searches wait for their
  // group's histories, or, second ones (second_searches.h), until more are
  // allowed; or the group may come to decide on candidates (link_decisions.h).
  // From any thread.
  bool waits() const {
    return waits_for_group_.load() || second_.is_behind() ||
           links_.is_watching();
  }
  void GoOn();

  // The checks that are owed. From any thread.
  std::int64_t debt() const { return debt_.load(); }

  // Whether a pair could concern a stored candidate at all.
  bool HasCandidates() const { return changes_.HasCandidates(); }
  // The changes of stored candidates that a pair makes when it is added: it
  // decides on those open whose two places lie within kPlaceRadiusMeters of the
  // pair's, along the path, and `named`, whatever it is. One that `is_there` is
  // upheld: it decides on `named`, and on those that were opened again because
  // others contradict it. Nothing if there are none. NOT_FOUND
  // (CHECK_NOT_FOUND) if `named` is not stored, INVALID_ARGUMENT
  // (INVALID_FIELD) if it is in the history of another vehicle, on which pairs
  // never decide. Reads the store. REQUIRES:
  // nothing else of the vehicle is written until the write that it answers is.
  absl::StatusOr<std::optional<ChecksWrite>> WithPair(
      PairKind kind, const PosePairRecord& pair, bool is_there,
      const std::optional<CandidateId>& named, const std::string& actor) const;
  // The same when a pair is deleted: those that it has decided are open again.
  absl::StatusOr<std::optional<ChecksWrite>> WithoutPair(
      PairKind kind, const PosePairRecord& pair, const std::string& actor,
      std::int64_t time_ns) const;
  // NOT_FOUND (CHECK_NOT_FOUND).
  static absl::Status CheckNotFound(const std::string& vehicle_id,
                                    const CandidateId& named);
  // The last event of a vehicle that is deleted.
  EventRecord Farewell() const;

 private:
  static absl::Status IsInOtherVehicle(const std::string& matched);
  // A check that was made and is not known to be stored.
  struct Made {
    std::uint64_t sequence = 0;
    std::uint64_t revision = 0;
    CheckBasis::Version version;
    // With which it was searched; null for none.
    CheckTiesPtr ties;
    StoredCheck check;
  };
  // When a pose was acknowledged, or loaded, up to which checks were owed.
  struct Landed {
    std::uint64_t sequence = 0;
    std::chrono::steady_clock::time_point time;
  };
  bool Stores() const;
  void NoteDebt(std::int64_t debt);
  void NoteLanded();
  void TakeTurn();
  // Goes on with the search of the next check. False if there is nothing to be
  // searched in this turn of the lane.
  bool SearchOn();
  void Take(const core::CandidateSet& set);
  // Has what was made written, if there is anything to write, or a check that
  // none is owed.
  void WriteSoon();
  void Write();
  void TakeResult(const ChecksHead& after, const absl::Status& status);
  // Has what was stored of other vehicles' histories decided.
  void LookAtLinks(const ChecksHead& after);
  // Calls, once each, those that wait for the end of a write.
  void RunSettled();
  // Looks for checks that are kept no longer, if it is time, and removes them;
  // what was open of them is withdrawn.
  void TidySoon();
  // Those of the next checks, by sequence, that go. Reads the store.
  absl::StatusOr<ChecksWrite> FindOld();
  // Forgets what is stored.
  void DropStored();
  ChecksWrite MakeWrite();
  // The stored checks of poses that lie near this one, along the path.
  absl::StatusOr<std::vector<CheckRecord>> ChecksNear(
      std::uint64_t sequence) const;
  VehicleState* const vehicle_;
  VehicleQueue* const queue_;
  AppendsInFlight* const in_flight_;
  const StoredChecksPolicy policy_;
  const CheckChanges changes_;
  CheckSteps steps_;
  CheckBasis basis_;
  LinkDecisions links_;
  SecondSearches second_;

  // The search that is under way.
  bool searching_ = false;
  core::DueCheck due_;
  std::uint64_t series_ = 0;
  // Its turns are one flow beside those of all callers, so that the checks of
  // all vehicles take one share of the threads of searches.
  CheckSearch search_;
  // The last pose whose check was made, stored or not.
  std::uint64_t made_to_ = 0;
  std::vector<Made> made_;
  // Whether a write waits for its turn or is under way.
  bool writing_ = false;
  bool failed_ = false;
  // Called once the write that waits or is under way is over.
  std::vector<std::function<void()>> settled_;
  std::deque<Landed> landed_;
  // The look through what is kept.
  bool tidying_ = false;
  std::chrono::steady_clock::time_point next_tidy_{};
  // The next check of it; 0 where none is under way.
  std::uint64_t tidy_from_ = 0;
  // Checks that are more than are kept, of those that come.
  std::uint64_t tidy_excess_ = 0;
  std::atomic<std::int64_t> debt_{0};
  std::atomic<bool> is_unsettled_{false};
  std::atomic<bool> waits_for_group_{false};
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_SESSIONS_STORED_CHECKS_H_
