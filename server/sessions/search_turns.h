// One search, made in turns: each of the marks that it has to search first, and
// the search itself. Between them other vehicles' searches get their turn, so
// that none waits for more than a turn of each of those before it; within a
// turn the searches of other flows do (FairExecutor::Yield()).
#ifndef REVISIT_SERVER_SESSIONS_SEARCH_TURNS_H_
#define REVISIT_SERVER_SESSIONS_SEARCH_TURNS_H_

#include <chrono>
#include <cstdint>
#include <limits>
#include <optional>

#include "absl/status/statusor.h"
#include "core/drive/node_index.h"
#include "core/search/candidates/candidate.h"
#include "core/search/search_scope.h"
#include "core/search/should_stop.h"
#include "core/settings.h"
#include "server/sessions/vehicle_view.h"

namespace revisit::server {

class SearchTurns {
 public:
  using Clock = std::chrono::steady_clock;

  // `most_comparisons`: of the marks and the search together. The first mark is
  // searched in any case, so that somebody who asks again gets an answer in the
  // end however little is allowed.
  explicit SearchTurns(
      std::int64_t most_comparisons = std::numeric_limits<std::int64_t>::max())
      : most_comparisons_(most_comparisons) {}

  // Takes a turn. Returns the answer, whose comparisons include those of the
  // marks, or nothing if the search needs another turn. Poses may have come and
  // settings may have changed since the turn before.
  // RESOURCE_EXHAUSTED, without details, if the marks that are missing are too
  // much for one search: those that it searched are kept, so that another one
  // comes further. CANCELLED if told to stop. REQUIRES: as for
  // core::Search::At(). `scope`: null for the vehicle's own history alone.
  std::optional<absl::StatusOr<core::CandidateSet>> Take(
      const VehicleView& view, core::NodeIndex query,
      const core::SearchOptions& options, const core::ShouldStop& should_stop,
      const core::SearchScope* scope = nullptr);

  // The comparisons that the last turn was about to make when it began, also if
  // it was stopped.
  std::int64_t last_steps() const { return last_steps_; }
  // How long the last turn took, and all of them, without the waits within and
  // between.
  Clock::duration last_turn() const { return last_turn_; }
  Clock::duration all_turns() const { return all_turns_; }

 private:
  std::optional<absl::StatusOr<core::CandidateSet>> Work(
      const VehicleView& view, core::NodeIndex query,
      const core::SearchOptions& options, const core::SearchScope* scope,
      const core::ShouldStop& should_stop);

  std::int64_t most_comparisons_;
  // Of the marks that were searched.
  std::int64_t comparisons_ = 0;
  std::int64_t last_steps_ = 0;
  Clock::duration last_turn_{};
  Clock::duration all_turns_{};
};

// The search of a check for which nothing else of the vehicle is to wait.
class CheckTurns {
 public:
  // How often a turn gives way to other work of its vehicle. After that it
  // holds that work up by itself once, as the checks of a stream do in the
  // vehicle's own history.
  static constexpr int kMostGivenWay = 3;

  // Takes a turn. Nothing if the search needs another one: it has given way, or
  // was told to stop, or marks are missing. `is_wanted`: whether other work
  // waits for this turn. REQUIRES: as for SearchTurns::Take().
  std::optional<core::CandidateSet> Take(
      const VehicleView& view, core::NodeIndex query,
      const core::SearchOptions& options, const core::SearchScope* scope,
      const core::ShouldStop& is_wanted,
      const core::ShouldStop& should_stop = nullptr);

  // See SearchTurns::all_turns(); of the search that found.
  SearchTurns::Clock::duration duration() const { return turns_.all_turns(); }

 private:
  SearchTurns turns_;
  int gave_way_ = 0;
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_SESSIONS_SEARCH_TURNS_H_
