#include "server/sessions/search_turns.h"

#include "absl/status/status.h"
#include "core/drive/drive.h"
#include "server/sessions/fair_executor.h"

namespace revisit::server {

std::optional<absl::StatusOr<core::CandidateSet>> SearchTurns::Take(
    const VehicleView& view, core::NodeIndex query,
    const core::SearchOptions& options, const core::ShouldStop& should_stop,
    const core::SearchScope* scope) {
  const Clock::time_point start = Clock::now();
  Clock::duration waited{};
  const auto stop = [&] {
    waited += FairExecutor::Yield();
    return should_stop && should_stop();
  };
  last_steps_ = 0;
  auto answer = Work(view, query, options, scope, stop);
  last_turn_ = Clock::now() - start - waited;
  all_turns_ += last_turn_;
  return answer;
}

std::optional<absl::StatusOr<core::CandidateSet>> SearchTurns::Work(
    const VehicleView& view, core::NodeIndex query,
    const core::SearchOptions& options, const core::SearchScope* scope,
    const core::ShouldStop& should_stop) {
  const auto missing = view.search->FindMissingMark(query, options);
  if (missing) {
    const std::int64_t others = comparisons_ + missing->comparisons_of_search;
    if (comparisons_ > 0 && missing->comparisons > most_comparisons_ - others) {
      return absl::ResourceExhaustedError("marks are missing");
    }
    comparisons_ += missing->comparisons;
    last_steps_ = missing->comparisons;
    const absl::Status learned = view.search->LearnMark(*missing, should_stop);
    if (!learned.ok()) return learned;
    return std::nullopt;
  }
  absl::StatusOr<core::CandidateSet> found =
      scope == nullptr ? view.search->At(query, options, should_stop)
                       : view.search->At(query, options, *scope, should_stop);
  last_steps_ = view.search->last_comparisons();
  if (found.ok()) found->comparisons += comparisons_;
  return found;
}

std::optional<core::CandidateSet> CheckTurns::Take(
    const VehicleView& view, core::NodeIndex query,
    const core::SearchOptions& options, const core::SearchScope* scope,
    const core::ShouldStop& is_wanted, const core::ShouldStop& should_stop) {
  const bool gives_way = gave_way_ < kMostGivenWay;
  auto answer = turns_.Take(
      view, query, options,
      [&] {
        return (gives_way && is_wanted()) || (should_stop && should_stop());
      },
      scope);
  if (!answer) {
    gave_way_ = 0;
    return std::nullopt;
  }
  if (!answer->ok()) {
    // It has searched as many marks as one search may, unless it was stopped:
    // the next one goes on behind them.
    ++gave_way_;
    turns_ = SearchTurns();
    return std::nullopt;
  }
  return **std::move(answer);
}

}  // namespace revisit::server
