#include "core/alignment/relative.h"

#include <algorithm>
#include <bitset>
#include <cassert>
#include <cstddef>
#include <memory>

#include "core/alignment/anchors.h"
#include "core/alignment/pose_table.h"
#include "core/alignment/recent_path.h"
#include "core/alignment/search_bounds.h"
#include "core/alignment/similarity_kernel.h"

namespace revisit::core {
namespace {

using BlockNodes = std::bitset<NodeBlock::kSize>;

// The search of one direction, block by block.
template <int D>
class DirectionSearch {
 public:
  // All must outlive this.
  DirectionSearch(const PoseGraph& graph, const RelativeModel& model,
                  const RecentPath<D>& recent, const SearchBounds<D>& bounds,
                  NodeIndex query, NodeIndex history_size, Direction direction,
                  PoseTable* table)
      : model_(model),
        recent_(recent),
        bounds_(bounds),
        size_(history_size),
        direction_(direction),
        constant_(bounds.constant()),
        anchors_(graph, model, query, direction),
        walk_(graph, recent, history_size, direction, model.over_loops, table) {
  }

  Direction direction() const { return direction_; }

  // Finds the ends in block k. Returns which of its nodes were considered:
  // walked from, not sought, or ill-conditioned. `greatest` rises to the
  // greatest log-odds, if it is less. `next`: the block that will be asked for
  // after it.
  BlockNodes Search(std::size_t k, std::size_t next, double* greatest) {
    first_ = static_cast<NodeIndex>(k * NodeBlock::kSize);
    count_ =
        std::min(NodeBlock::kSize, static_cast<std::size_t>(size_ - first_));
    anchors_.Find(k, count_, next);
    FindSought();
    const double least = model_.least_log_share + *greatest;
    BlockNodes considered;
    const BlockNodes useful = FindUseful(least, &considered);
    if (useful.none()) return considered;
    const BestPaths& paths = WalkBack(useful, least);
    anchors_.Change(paths.change);
    Collect(useful, least, paths, greatest);
    return considered;
  }

  // Hands over what was found, except for what has lower log-odds.
  void HandOver(double least, ScoredEnds* ends,
                std::vector<ShapeMatch>* matches,
                std::vector<double>* odds_by_scale) {
    const auto older = [](const Found& a, const Found& b) {
      return a.end.node < b.end.node;
    };
    // Where all blocks are searched, from the last to the first, this sorts.
    std::reverse(found_.begin(), found_.end());
    if (!std::is_sorted(found_.begin(), found_.end(), older)) {
      std::sort(found_.begin(), found_.end(), older);
    }
    ends->reserve(found_.size());
    matches->reserve(found_.size());
    for (const Found& found : found_) {
      if (!(found.end.score >= least)) continue;
      ends->push_back(found.end);
      matches->push_back(found.match);
      const auto scales = by_scale_.begin() + found.first_scale;
      odds_by_scale->insert(odds_by_scale->end(), scales,
                            scales + (model_.tell_scales ? Scales() : 0));
    }
  }

 private:
  struct Found {
    ScoredEnd end;
    ShapeMatch match;
    // Where its log-odds under each scale begin.
    std::ptrdiff_t first_scale = 0;
  };

  std::ptrdiff_t Scales() const {
    return std::max<std::ptrdiff_t>(
        1, static_cast<std::ptrdiff_t>(model_.scales.size()));
  }

  void FindSought() {
    sought_.set();
    for (const NodeRange& nodes : model_.not_sought) {
      const NodeIndex last =
          std::min(nodes.last - first_, static_cast<NodeIndex>(count_));
      for (NodeIndex i = std::max<NodeIndex>(nodes.first - first_, 0); i < last;
           ++i) {
        sought_.reset(static_cast<std::size_t>(i));
      }
    }
  }

  // The ends that may come to the least log-odds.
  BlockNodes FindUseful(double least, BlockNodes* considered) {
    anchors_.Bound(bounds_, &most_);
    BlockNodes useful;
    for (std::size_t i = 0; i < count_; ++i) {
      if (!sought_[i] || !anchors_.IsPossible(i)) {
        considered->set(i);
      } else if (!(most_[i] < least)) {
        useful.set(i);
        considered->set(i);
      }
    }
    return useful;
  }

  const BestPaths& WalkBack(const BlockNodes& useful, double least) {
    starts_.clear();
    for (std::size_t i = 0; i < count_; ++i) {
      if (!useful[i]) continue;
      // The ratio of a path without any innovation, less the ratio by which the
      // end's bound exceeds the least log-odds.
      starts_.push_back({first_ + static_cast<NodeIndex>(i),
                         recent_.most_log_likelihood_ratio() -
                             (most_[i] - least) / recent_.weight()});
    }
    return walk_.Walk(first_, starts_);
  }

  // Keeps the useful ends that have come to the least log-odds.
  void Collect(const BlockNodes& useful, double least, const BestPaths& paths,
               double* greatest) {
    for (std::size_t i = count_; i-- > 0;) {
      if (!useful[i]) continue;
      const auto anchor = anchors_.At(i);
      const double beside =
          recent_.weight() * paths.log_likelihood_ratios[i] + constant_;
      const double score = anchor.log_similarity + beside;
      if (!(score >= least)) continue;
      *greatest = std::max(*greatest, score);
      found_.push_back(
          {{first_ + static_cast<NodeIndex>(i), score},
           {paths.log_likelihood_ratios[i], paths.squared_innovations[i],
            anchor.squared_mahalanobis, anchor.scale, paths.change.row[i]},
           static_cast<std::ptrdiff_t>(by_scale_.size())});
      if (!model_.tell_scales) continue;
      anchors_.AppendScales(i, &by_scale_);
      std::for_each(by_scale_.end() - Scales(), by_scale_.end(),
                    [beside](double& odds) { odds += beside; });
    }
  }

  const RelativeModel& model_;
  const RecentPath<D>& recent_;
  const SearchBounds<D>& bounds_;
  const NodeIndex size_;
  const Direction direction_;
  const double constant_;
  Anchors<D> anchors_;
  PathWalk<D> walk_;
  // The block at hand: nodes [first_, first_ + count_).
  NodeIndex first_ = 0;
  std::size_t count_ = 0;
  // Its nodes that may be ends.
  BlockNodes sought_;
  // The most that the log-odds of each end can come to.
  BlockColumn most_;
  std::vector<WalkStart> starts_;
  // In the order in which they were found.
  std::vector<Found> found_;
  std::vector<double> by_scale_;
};

}  // namespace

template <int D>
std::optional<RelativeAlignment> AlignRelativeIn(
    const PoseGraph& graph, const RelativeModel& model, NodeIndex query,
    std::int64_t steps, NodeIndex history_size, const ShouldStop& should_stop) {
  const auto recent =
      std::make_shared<const RecentPath<D>>(graph, model, query, steps);
  const SearchBounds<D> bounds(graph, model, *recent, query, history_size);
  PoseTable table(graph, history_size);
  std::vector<DirectionSearch<D>> searches;
  searches.reserve(2);
  const auto search_in = [&](Direction direction) {
    searches.emplace_back(graph, model, *recent, bounds, query, history_size,
                          direction, &table);
  };
  if (model.same_direction) search_in(Direction::kSame);
  if (model.opposite_direction) search_in(Direction::kOpposite);

  RelativeAlignment alignment;
  double greatest = 0.0;
  const std::vector<std::size_t> blocks = bounds.BlocksToSearch();
  for (std::size_t i = 0; i < blocks.size(); ++i) {
    if (should_stop && should_stop()) return std::nullopt;
    const std::size_t next = blocks[i + 1 < blocks.size() ? i + 1 : 0];
    BlockNodes considered;
    for (DirectionSearch<D>& search : searches) {
      considered |= search.Search(blocks[i], next, &greatest);
    }
    alignment.considered_ += static_cast<NodeIndex>(considered.count());
  }
  for (DirectionSearch<D>& search : searches) {
    RelativeAlignment::Found& found =
        alignment.found_[IndexOf(search.direction())];
    search.HandOver(model.least_log_share + greatest, &found.ends,
                    &found.matches, &found.odds_by_scale);
  }
  alignment.trace_ = [&graph, recent, history_size,
                      over_loops = model.over_loops](Direction direction,
                                                     NodeIndex j) {
    PoseTable poses(graph, history_size);
    return PathWalk<D>(graph, *recent, history_size, direction, over_loops,
                       &poses)
        .Trace(j);
  };
  return alignment;
}

const ShapeMatch& RelativeAlignment::match(Direction direction,
                                           NodeIndex j) const {
  const Found& found = found_[IndexOf(direction)];
  const auto end = std::lower_bound(
      found.ends.begin(), found.ends.end(), j,
      [](const ScoredEnd& e, NodeIndex node) { return e.node < node; });
  assert(end != found.ends.end() && end->node == j);
  return found.matches[static_cast<std::size_t>(end - found.ends.begin())];
}

std::optional<RelativeAlignment> AlignRelative(
    const PoseGraph& graph, const RelativeModel& model, NodeIndex query,
    std::int64_t steps, NodeIndex history_size, const ShouldStop& should_stop) {
  assert(1 <= steps && steps <= query + 1);
  assert(history_size <= query);
  if (model.similarity.state_space == StateSpace::kPlanar) {
    return AlignRelativeIn<3>(graph, model, query, steps, history_size,
                              should_stop);
  }
  return AlignRelativeIn<4>(graph, model, query, steps, history_size,
                            should_stop);
}

}  // namespace revisit::core
