#include "core/search/alignment/relative.h"

#include <algorithm>
#include <array>
#include <cassert>
#include <cstddef>
#include <memory>
#include <utility>

#include "core/drive/node_range.h"
#include "core/geometry/state_matrix.h"
#include "core/search/alignment/anchors.h"
#include "core/search/alignment/direction_search.h"
#include "core/search/alignment/heading_match.h"
#include "core/search/alignment/path_axes.h"
#include "core/search/alignment/pose_table.h"
#include "core/search/alignment/recent_path.h"
#include "core/search/alignment/search_bounds.h"
#include "core/search/alignment/search_inputs.h"
#include "core/search/alignment/search_progress.h"
#include "core/search/alignment/walked_ends.h"

namespace revisit::core {
namespace {

// AlignmentParts::parts.
template <int D>
struct Parts {
  Parts(const Query& query, const History& history,
        std::shared_ptr<const RecentPath<D>> path)
      : recent(std::move(path)),
        poses(history.graph, history.end),
        headings(HeadingMatch::Make<D>(query, history, *recent)) {}

  // The parts that are kept, which are made if there are none.
  static std::shared_ptr<const Parts> Of(const Query& query,
                                         const History& history,
                                         const RelativeModel& model,
                                         AlignmentParts* kept) {
    if (kept->parts == nullptr) {
      kept->parts = std::make_shared<const Parts>(
          query, history, PathOf<D>(query, model, kept));
    }
    return std::static_pointer_cast<const Parts>(kept->parts);
  }

  const std::shared_ptr<const RecentPath<D>> recent;
  // Filled in on the way.
  mutable PoseTable poses;
  // Nothing where these tell nothing.
  const std::optional<HeadingMatch> headings;
};

// The axes that are kept, which are made if there are none.
template <int D>
std::shared_ptr<const PathAxes<D>> AxesOf(const Query& query,
                                          const History& history,
                                          const RelativeModel& model,
                                          const RecentPath<D>& recent,
                                          AlignmentParts* kept) {
  if (kept->axes == nullptr) {
    kept->axes = std::make_shared<const PathAxes<D>>(
        recent,
        history.relation.InHistory(query.graph.pose(query.node)).heading,
        static_cast<double>(StrideOf(history.size())) * model.spacing_meters);
  }
  return std::static_pointer_cast<const PathAxes<D>>(kept->axes);
}

// Where paths may cross loop closures, headings do not tell how far these can
// go. Closures beyond the history may have been confirmed since, and the answer
// does not depend on them.
bool TakesHeadings(const RelativeModel& model, const History& history) {
  return model.most_log_odds_sampled != kImpossible &&
         !(model.over_loops &&
           history.graph.HasLoopEdgeAmong(history.first, history.end));
}

// One alignment, in all directions that are sought.
template <int D>
class Aligner {
 public:
  Aligner(const Query& query, const History& history,
          const RelativeModel& model, const Parts<D>& parts,
          const PathAxes<D>& axes, std::array<WalkedEnds, 2>* walked)
      : bounds_(query, history, model, *parts.recent, axes),
        inputs_{query,
                history,
                model,
                *parts.recent,
                axes,
                bounds_,
                parts.headings && TakesHeadings(model, history)
                    ? &*parts.headings
                    : nullptr,
                &parts.poses,
                walked},
        progress_(history.first, history.end) {
    const auto search_in = [this](Direction direction) {
      searches_[IndexOf(direction)] =
          std::make_unique<DirectionSearch<D>>(inputs_, direction);
    };
    if (model.same_direction) search_in(Direction::kSame);
    if (model.opposite_direction) search_in(Direction::kOpposite);
  }

  // Returns false if told to stop.
  bool Search(const ShouldStop& should_stop) {
    typename SearchBounds<D>::Blocks blocks = bounds_.BlocksToSearch();
    if (inputs_.headings == nullptr) {
      blocks.all.insert(blocks.all.end(), blocks.sampled.begin(),
                        blocks.sampled.end());
      blocks.sampled.clear();
    }
    for (std::size_t i = 0; i < blocks.all.size(); ++i) {
      if (should_stop && should_stop()) return false;
      const std::size_t next =
          blocks.all[i + 1 < blocks.all.size() ? i + 1 : 0];
      for (auto& search : searches_) {
        if (search) search->SearchBlock(blocks.all[i], next, &progress_);
      }
    }
    return std::all_of(searches_.begin(), searches_.end(), [&](auto& search) {
      return !search ||
             search->SampleBlocks(blocks.sampled, should_stop, &progress_);
    });
  }

  // The ends that were found in each direction.
  std::array<MatchedEnds, 2> HandOver() {
    const double least = inputs_.model.least_log_share + progress_.greatest();
    std::array<MatchedEnds, 2> found;
    for (std::size_t i = 0; i < found.size(); ++i) {
      if (searches_[i]) found[i] = searches_[i]->HandOver(least);
    }
    return found;
  }
  NodeIndex considered() const { return progress_.considered(); }

 private:
  const SearchBounds<D> bounds_;
  const SearchInputs<D> inputs_;
  // By IndexOf(direction); null for a direction that is not sought.
  std::array<std::unique_ptr<DirectionSearch<D>>, 2> searches_;
  SearchProgress progress_;
};

template <int D>
std::optional<RelativeAlignment> AlignIn(const Query& query,
                                         const History& history,
                                         const RelativeModel& model,
                                         const ShouldStop& should_stop,
                                         AlignmentParts* kept) {
  AlignmentParts none;
  if (kept == nullptr) kept = &none;
  const auto parts = Parts<D>::Of(query, history, model, kept);
  const auto axes = AxesOf<D>(query, history, model, *parts->recent, kept);
  Aligner<D> aligner(query, history, model, *parts, *axes, kept->walked.get());
  if (!aligner.Search(should_stop)) return std::nullopt;
  return RelativeAlignment(
      aligner.HandOver(), aligner.considered(),
      [history, parts, axes, over_loops = model.over_loops](Direction direction,
                                                            NodeIndex j) {
        return PathWalk<D>(history, *parts->recent, *axes, direction,
                           over_loops, &parts->poses)
            .Trace(j);
      });
}

}  // namespace

const ShapeMatch& RelativeAlignment::match(Direction direction,
                                           NodeIndex j) const {
  const MatchedEnds& found = found_[IndexOf(direction)];
  const auto end = std::lower_bound(
      found.ends.begin(), found.ends.end(), j,
      [](const ScoredEnd& e, NodeIndex node) { return e.node < node; });
  assert(end != found.ends.end() && end->node == j);
  return found.matches[static_cast<std::size_t>(end - found.ends.begin())];
}

std::optional<RelativeAlignment> AlignRelative(const Query& query,
                                               const History& history,
                                               const RelativeModel& model,
                                               const ShouldStop& should_stop,
                                               AlignmentParts* parts) {
  assert(1 <= query.steps && query.steps <= query.node + 1);
  return model.similarity.state_space == StateSpace::kPlanar
             ? AlignIn<3>(query, history, model, should_stop, parts)
             : AlignIn<4>(query, history, model, should_stop, parts);
}

}  // namespace revisit::core
