// Walks back from ends of the history beside the recent path, and finds the
// best path of each end.
//
// Paths walk the graph: to the node before; over a confirmed loop closure,
// where the two passes are taken for one place and the other pass is walked on;
// and, where the odometers of the two passes disagree, by a slip: staying at a
// node or skipping one, if that step is then the likelier by more than
// kSlipCost. Each end has its own paths, which carry their drift with them: one
// to begin with, and one more for each loop closure that is crossed. Where
// paths of one end meet after a loop closure, only the likeliest is walked on,
// and at most kMostPaths are in all. A path ends where the next innovation lies
// beyond kSquaredInnovationLimit. An end's only path ends early, once it can
// count for nothing more; one of several is walked on, for those that it may
// end. Opposite passes walk the history forward in time with all headings
// turned by pi.
#ifndef REVISIT_CORE_SEARCH_ALIGNMENT_PATH_WALK_H_
#define REVISIT_CORE_SEARCH_ALIGNMENT_PATH_WALK_H_

#include <array>
#include <cstddef>
#include <cstdint>
#include <functional>
#include <vector>

#include "core/drive/pose_graph.h"
#include "core/geometry/state_matrix.h"
#include "core/search/alignment/history.h"
#include "core/search/alignment/log_similarity.h"
#include "core/search/alignment/path_axes.h"
#include "core/search/alignment/pose_table.h"
#include "core/search/alignment/recent_path.h"
#include "core/search/alignment/search_progress.h"
#include "core/search/alignment/shape_filter.h"
#include "core/search/alignment/similarity_kernel.h"
#include "core/search/alignment/walk_kernel.h"
#include "core/search/alignment/walked_ends.h"

namespace revisit::core {

// A step of a path: t steps back from the recent path's end, the node it is at
// and the way it walks there.
struct PathStep {
  std::int64_t t = 0;
  NodeIndex node = 0;
  Direction direction = Direction::kSame;

  bool operator==(const PathStep& other) const {
    return t == other.t && node == other.node && direction == other.direction;
  }
};

// A path after some steps.
template <int D>
struct PathSoFar {
  std::size_t slot = 0;
  std::int64_t steps = 0;
  // drift_0 as the smoother has it.
  StateVector<D> shift = StateVector<D>::Zero();
  // The most that its log-likelihood ratio can still come to.
  double most_ratio = 0.0;
  // The shift and the ratio at the step at which the ratio was greatest.
  StateVector<D> best_shift = StateVector<D>::Zero();
  double best_ratio = 0.0;
};

// The best paths back from up to NodeBlock::kSize ends, by slot; the end alone
// where no longer path is better.
struct BestPaths {
  BlockColumn log_likelihood_ratios;
  // Sum over the steps of the path.
  BlockColumn squared_innovations;
  // How the path changes the difference of its end: row is its number of steps,
  // shift is drift_0 as the smoother has it after them.
  DifferenceChange change;
};

// An end to walk back from. Its only path is given up once its log-likelihood
// ratio plus a quarter of its squared innovations cannot come to `needed`.
struct WalkStart {
  NodeIndex end = 0;
  double needed = kImpossible;
  // Where BestPaths tells of it.
  std::size_t slot = 0;
};

// The walks of one search in one direction.
template <int D>
class PathWalk {
 public:
  // `over_loops`: whether paths are walked over the history's confirmed loop
  // closures; none leads out of the history. The history's graph, the recent
  // path, its axes there and the table, that of the history, must outlive this,
  // and so must `walked`: the ends from which other searches with this recent
  // path have walked there in this direction, or null.
  PathWalk(const History& history, const RecentPath<D>& recent,
           const PathAxes<D>& axes, Direction direction, bool over_loops,
           PoseTable* table, WalkedEnds* walked = nullptr);

  // Whether a path is of no use, neither as it was when it was best nor however
  // it goes on.
  using IsUseless = std::function<bool(const PathSoFar<D>&)>;

  // The best paths of these ends, each with a slot of its own. Valid until the
  // next walk; other slots say that the end is alone. Paths that `is_useless`
  // calls so, if it is not null, need not be walked to their end.
  const BestPaths& Walk(const std::vector<WalkStart>& starts,
                        const IsUseless& is_useless);

  // The steps of the best path back from `end`, the end first.
  std::vector<PathStep> Trace(NodeIndex end);

 private:
  using Drift = typename ShapeFilter<D>::Drift;
  using Evidence = typename ShapeFilter<D>::Evidence;

  // A step of a path that is recorded.
  struct TrailStep {
    PathStep step;
    // Entry of the step before; -1 at the end.
    std::int64_t before = -1;
  };

  void Reset();
  const std::vector<WalkStart>& TakeWalked(
      const std::vector<WalkStart>& starts);
  void WalkFrom(const std::vector<WalkStart>& starts,
                const IsUseless& is_useless);
  void KeepWalked(const std::vector<WalkStart>& starts);
  void Seed(std::size_t i, const WalkStart& start);
  void WalkAll(const IsUseless& is_useless);
  void GiveUp(std::int64_t t, const IsUseless& is_useless);
  void WalkOverLoops(std::int64_t t, std::size_t walkers);
  void WalkOver(std::int64_t t, std::size_t i, NodeIndex far);
  void CountPaths();
  bool IsOnlyPath(std::size_t i) const;
  // Whether a walker's ratio after step t can still become its best.
  bool MayImprove(std::int64_t t, std::size_t i) const {
    return walkers_.at(Walkers::kRatio, i) + recent_.step(t).to_come >
           walkers_.at(Walkers::kBestRatio, i);
  }
  void CutShort(std::size_t i) {
    cut_short_.set(static_cast<std::size_t>(walkers_.at(Walkers::kEnd, i)));
  }
  bool Slip(std::int64_t t, const Unsettled& unsettled, bool is_only);
  void Take(std::int64_t t, std::size_t i, NodeIndex to, const Drift& drift,
            double gained, double squared_innovation);
  void Merge(std::size_t first, std::vector<char>* done) const;
  void MergePathsOf(std::int64_t end, std::vector<char>* done) const;
  void Credit(std::size_t i);
  void Record(std::int64_t t);

  Direction DirectionAt(std::size_t i) const {
    return walkers_.at(Walkers::kStride, i) < 0 ? Direction::kSame
                                                : Direction::kOpposite;
  }
  NodeIndex LastOf(NodeIndex i, Direction direction) const;
  Drift DriftOf(std::size_t i) const;
  StateVector<D> SeenBy(std::size_t i, const double* pose) const;
  // More than kSquaredInnovationLimit, or exact.
  double SquaredInnovation(const WalkStep& step, std::size_t i,
                           NodeIndex node) const;

  const PoseGraph& graph_;
  const RecentPath<D>& recent_;
  const NodeIndex first_;
  const NodeIndex end_;
  const Direction direction_;
  PoseTable& table_;
  const bool has_loops_;
  // Null where paths cross loop closures.
  WalkedEnds* const walked_;
  BestPaths best_;
  // The slots of ends whose path has ended before it could be known to be the
  // best, since it was of no use.
  BlockNodes cut_short_;
  // Scratch: the ends that are not known yet.
  std::vector<WalkStart> unknown_;
  Walkers walkers_;
  std::vector<Unsettled> unsettled_;
  // The number of paths by slot, where paths cross loop closures.
  std::array<std::uint32_t, NodeBlock::kSize> paths_of_ = {};
  // Paths that were asked about, and those that were of no use.
  std::int64_t asked_ = 0;
  std::int64_t given_up_ = 0;
  // While tracing: all steps, and the last one of the best path.
  bool tracing_ = false;
  std::vector<TrailStep> trail_;
  std::int64_t best_trail_ = 0;
};

}  // namespace revisit::core

#endif  // REVISIT_CORE_SEARCH_ALIGNMENT_PATH_WALK_H_
