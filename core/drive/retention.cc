#include "core/drive/retention.h"

#include <algorithm>
#include <cassert>
#include <cmath>
#include <cstddef>
#include <map>
#include <tuple>
#include <unordered_map>
#include <utility>
#include <vector>

#include "core/drive/node_noise.h"
#include "core/drive/pose_graph.h"
#include "core/drive/stamps.h"
#include "core/geometry/heading.h"
#include "core/geometry/state_matrix.h"

namespace revisit::core {
namespace {

// Nodes that lie closer along the path are not all compared.
constexpr double kComparedMeters = 2.0;

// Nodes of a cell with which others are compared, for each pass that is to be
// kept: more than a vehicle needs to cross a cell in every direction. It bounds
// the work where many passes lie in one place and none is sure.
constexpr std::size_t kComparedPerPass = 16;

// Headings are alike if they differ by less than this in the root mean square.
constexpr double kAlikeRadians = kPi / 4.0;

std::size_t Place(NodeIndex i) { return static_cast<std::size_t>(i); }

// Counts the better passes that cover a node.
class Coverage {
 public:
  Coverage(const PoseGraph& graph, const RetentionNeeds& needs, int passes)
      : graph_(graph),
        needs_(needs),
        noise_(needs.correlation.noise()),
        passes_(passes),
        stride_(std::max<NodeIndex>(
            1, static_cast<NodeIndex>(kComparedMeters / needs.spacing_meters))),
        half_step_(0.5 * static_cast<double>(stride_) * needs.spacing_meters),
        reach_(std::hypot(kPassRadiusMeters, half_step_)),
        separation_(std::max(needs.separation_meters, 4.0 * reach_)) {}

  // Whether enough passes among the kept nodes cover this one.
  bool IsCovered(NodeIndex i) {
    if (!MayBeSure(i)) return false;
    const Pose pose = graph_.pose(i);
    const Cell centre = CellOf(i, pose);
    near_.clear();
    for (std::int64_t x = -1; x <= 1; ++x) {
      for (std::int64_t y = -1; y <= 1; ++y) {
        const auto cell =
            cells_.find({centre.recording, centre.x + x, centre.y + y});
        if (cell == cells_.end()) continue;
        for (const Kept& kept : cell->second) {
          const double dx = kept.x - pose.x;
          const double dy = kept.y - pose.y;
          if (dx * dx + dy * dy <= reach_ * reach_) near_.push_back(kept.node);
        }
      }
    }
    // From the first on, as many as lie so far apart along the path.
    std::sort(near_.begin(), near_.end());
    int passes = 0;
    std::optional<NodeIndex> last;
    for (const NodeIndex j : near_) {
      if (last && graph_.MetersApart(j, *last) < separation_) continue;
      if (graph_.MetersApart(i, j) < separation_) continue;
      if (!IsSurelySamePlace(i, j)) continue;
      last = j;
      if (++passes == passes_) return true;
    }
    return false;
  }

  void Keep(NodeIndex i) {
    if (i % stride_ != 0 || !MayBeSure(i)) return;
    const Pose pose = graph_.pose(i);
    std::vector<Kept>& cell = cells_[CellOf(i, pose)];
    if (cell.size() < kComparedPerPass * static_cast<std::size_t>(passes_)) {
      cell.push_back({pose.x, pose.y, i});
    }
  }

  bool IsSurelySamePlace(NodeIndex i, NodeIndex j) const {
    return needs_.state_space == StateSpace::kPlanar
               ? IsSurelySamePlace<3>(i, j)
               : IsSurelySamePlace<4>(i, j);
  }

 private:
  // A square of one recording's frame.
  struct Cell {
    std::ptrdiff_t recording;
    std::int64_t x;
    std::int64_t y;
    bool operator==(const Cell& other) const {
      return recording == other.recording && x == other.x && y == other.y;
    }
  };
  struct HashOfCell {
    std::size_t operator()(const Cell& cell) const {
      const auto x = static_cast<std::uint64_t>(cell.x);
      const auto y = static_cast<std::uint64_t>(cell.y);
      const auto recording = static_cast<std::uint64_t>(cell.recording);
      std::uint64_t hash = (x * 0x9e3779b97f4a7c15u) ^ y ^ (recording << 40);
      hash = (hash ^ (hash >> 32)) * 0xd6e8feb86659fd93u;
      return hash ^ (hash >> 32);
    }
  };
  struct Kept {
    double x;
    double y;
    NodeIndex node;
  };

  Cell CellOf(NodeIndex i, const Pose& pose) const {
    const std::vector<NodeIndex>& starts = needs_.recording_starts;
    return {std::upper_bound(starts.begin(), starts.end(), i) - starts.begin(),
            static_cast<std::int64_t>(std::floor(pose.x / reach_)),
            static_cast<std::int64_t>(std::floor(pose.y / reach_))};
  }

  // False where the node's own covariance is too large for any place, so that
  // there is no use in comparing it: G is then at least as large.
  bool MayBeSure(NodeIndex i) const {
    if (noise_.has_closed_form() && !noise_.exceeds_either) return true;
    const Covariance covariance = graph_.covariance(i);
    const double z =
        needs_.state_space == StateSpace::kPlanar ? 0.0 : covariance(2, 2);
    return covariance(0, 0) + covariance(1, 1) + z <= reach_ * reach_;
  }

  // G. Where the model's is none, as after an optimiser has revised poses that
  // were reckoned, and where it takes long: twice the sum of both covariances,
  // which bounds it.
  template <int D>
  StateVector<D> Variances(NodeIndex i, NodeIndex j) const {
    if (noise_.has_closed_form()) {
      const StateVector<D> variances =
          DifferenceCovariance<D>(graph_, needs_.correlation, i, j).diagonal();
      if (variances.minCoeff() >= 0.0) return variances;
    }
    return 2.0 * (ToMatrix<D>(graph_.covariance(i)).diagonal() +
                  ToMatrix<D>(graph_.covariance(j)).diagonal());
  }

  template <int D>
  bool IsSurelySamePlace(NodeIndex i, NodeIndex j) const {
    const StateVector<D> apart =
        ToVector<D>(Difference(graph_.pose(i), graph_.pose(j)));
    const StateVector<D> variances = Variances<D>(i, j);
    const double square = apart.template head<D - 1>().squaredNorm();
    const double spread = variances.template head<D - 1>().sum();
    const double tolerance = 2.0 * needs_.tolerance_meters;
    const double turn = apart(D - 1);
    return square + spread <= reach_ * reach_ &&
           square <= tolerance * tolerance + half_step_ * half_step_ + spread &&
           turn * turn + variances(D - 1) <= kAlikeRadians * kAlikeRadians;
  }

  const PoseGraph& graph_;
  const RetentionNeeds& needs_;
  const NoiseModel& noise_;
  const int passes_;
  const NodeIndex stride_;
  const double half_step_;
  const double reach_;
  const double separation_;
  std::unordered_map<Cell, std::vector<Kept>, HashOfCell> cells_;
  std::vector<NodeIndex> near_;
};

enum class Fate : std::uint8_t { kStays, kWanted, kCovered, kTooOld };

}  // namespace

bool HaveSameRules(const RetentionNeeds& a, const RetentionNeeds& b) {
  const auto numbers = [](const RetentionNeeds& needs) {
    return std::tie(needs.state_space, needs.tolerance_meters,
                    needs.spacing_meters, needs.separation_meters,
                    needs.aligned_nodes, needs.newest_nodes,
                    needs.agreeing_nodes, needs.least_nodes);
  };
  return a.correlation == b.correlation && numbers(a) == numbers(b);
}

class DroppableSearch::Impl {
 public:
  Impl(const PoseGraph& graph, const RetentionOptions& options,
       RetentionNeeds needs, std::optional<std::int64_t> latest_ns)
      : graph_(graph),
        options_(options),
        needs_(std::move(needs)),
        size_(graph.size()),
        coverage_(graph_, needs_, options_.max_passes),
        fates_(Place(size_), Fate::kWanted) {
    if (options_.max_age_ns) {
      old_nodes_.emplace(graph_,
                         AgeRules{*options_.max_age_ns, needs_.agreeing_nodes,
                                  needs_.newest_nodes, latest_ns});
    }
    Keep(size_ - needs_.newest_nodes, size_);
    for (const NodeIndex start : needs_.recording_starts) {
      Keep(start - 1, start + 1);
    }
    KeepLoopEnds(needs_.loop_ends);
  }

  const RetentionOptions& options() const { return options_; }
  const RetentionNeeds& needs() const { return needs_; }

  bool Advance(NodeIndex nodes) {
    while (nodes > 0 && stage_ != Stage::kDone) {
      switch (stage_) {
        case Stage::kRank:
          nodes -= Rank(nodes);
          break;
        case Stage::kCover:
          nodes -= Cover(nodes);
          break;
        case Stage::kKeepPaths:
          nodes -= KeepPathsToWanted(nodes);
          break;
        case Stage::kDone:
          break;
      }
    }
    return stage_ == Stage::kDone;
  }

  std::vector<NodeRange> Droppable(const std::vector<NodeIndex>& loop_ends) {
    assert(stage_ == Stage::kDone);
    KeepLoopEnds(loop_ends);
    return Ranges();
  }

  NodeIndex CountTooOld(const std::vector<NodeRange>& ranges) const {
    NodeIndex count = 0;
    for (const NodeRange& range : ranges) {
      count += static_cast<NodeIndex>(std::count(fates_.begin() + range.first,
                                                 fates_.begin() + range.last,
                                                 Fate::kTooOld));
    }
    return count;
  }

 private:
  // The stages follow each other in this order. Each goes through all nodes;
  // the function of a stage returns how many it went through.
  enum class Stage { kRank, kCover, kKeepPaths, kDone };

  void Keep(NodeIndex first, NodeIndex last) {
    std::fill(fates_.begin() + std::max<NodeIndex>(0, first),
              fates_.begin() + std::min(last, size_), Fate::kStays);
  }

  void KeepLoopEnds(const std::vector<NodeIndex>& loop_ends) {
    const auto behind = static_cast<NodeIndex>(
        std::ceil(kPassRadiusMeters / needs_.spacing_meters));
    for (const NodeIndex end : loop_ends) {
      if (end >= size_) continue;
      Keep(std::max(graph_.SegmentStart(end), end - needs_.aligned_nodes),
           std::min(graph_.SegmentEnd(end), end + behind + 1));
    }
  }

  // Finds what is too old, and how well the position of each other node is
  // known, in steps by a factor of two.
  NodeIndex Rank(NodeIndex most) {
    const NodeIndex end = std::min(size_, next_ + most);
    const int dimensions = needs_.state_space == StateSpace::kPlanar ? 2 : 3;
    for (NodeIndex i = next_; i < end; ++i) {
      Fate& fate = fates_[Place(i)];
      const bool is_too_old = old_nodes_ && old_nodes_->IsTooOld(i);
      if (is_too_old && fate == Fate::kWanted) fate = Fate::kTooOld;
      if (options_.max_passes == 0 || fate == Fate::kTooOld) continue;
      const Covariance covariance = graph_.covariance(i);
      double spread = 0.0;
      for (int k = 0; k < dimensions; ++k) spread += covariance(k, k);
      ranked_[std::ilogb(std::sqrt(spread))].push_back(i);
    }
    const NodeIndex done = end - next_;
    next_ = end;
    if (next_ == size_) {
      stage_ = options_.max_passes > 0 ? Stage::kCover : Stage::kDone;
    }
    return done;
  }

  // Goes from the best on, and among those that are known about alike from the
  // last on, so that a node is covered only by such as stay.
  NodeIndex Cover(NodeIndex most) {
    NodeIndex done = 0;
    while (done < most && !ranked_.empty()) {
      std::vector<NodeIndex>& best = ranked_.begin()->second;
      for (; done < most && !best.empty(); ++done) {
        const NodeIndex i = best.back();
        best.pop_back();
        Fate& fate = fates_[Place(i)];
        if (fate == Fate::kWanted && coverage_.IsCovered(i)) {
          fate = Fate::kCovered;
        } else {
          coverage_.Keep(i);
        }
      }
      if (best.empty()) ranked_.erase(ranked_.begin());
    }
    if (ranked_.empty()) stage_ = Stage::kKeepPaths;
    return done;
  }

  // Goes back from the last node; `next_` is behind the next one to look at.
  NodeIndex KeepPathsToWanted(NodeIndex most) {
    const NodeIndex end = std::max<NodeIndex>(0, next_ - most);
    const NodeIndex done = next_ - end;
    while (next_ > end) {
      const NodeIndex i = --next_;
      Fate& fate = fates_[Place(i)];
      if (fate == Fate::kWanted) {
        reach_ = needs_.aligned_nodes;
      } else if (reach_ > 0 && fate == Fate::kCovered) {
        fate = Fate::kStays;
      }
      reach_ =
          graph_.SegmentStart(i) == i ? 0 : std::max<NodeIndex>(0, reach_ - 1);
    }
    if (next_ == 0) stage_ = Stage::kDone;
    return done;
  }

  std::vector<NodeRange> Ranges() const {
    std::vector<NodeRange> ranges;
    NodeIndex i = 0;
    while (i < size_) {
      NodeRange range{i, i};
      bool is_old = false;
      for (; i < size_ && IsUnwanted(i); ++i) {
        is_old |= fates_[Place(i)] == Fate::kTooOld;
      }
      range.last = i;
      if (is_old || (range.last > range.first &&
                     range.last - range.first >= needs_.least_nodes)) {
        ranges.push_back(range);
      }
      if (range.last == range.first) ++i;
    }
    return ranges;
  }

  bool IsUnwanted(NodeIndex i) const {
    return fates_[Place(i)] == Fate::kCovered ||
           fates_[Place(i)] == Fate::kTooOld;
  }

  const PoseGraph& graph_;
  const RetentionOptions options_;
  const RetentionNeeds needs_;
  const NodeIndex size_;
  // With a greatest age only.
  std::optional<OldNodes> old_nodes_;
  Coverage coverage_;
  std::vector<Fate> fates_;
  Stage stage_ = Stage::kRank;
  // Where the stages that follow the path go on.
  NodeIndex next_ = 0;
  // Nodes that are not yet looked at, by the logarithm of their deviations; the
  // least is known best. Each in ascending order.
  std::map<int, std::vector<NodeIndex>> ranked_;
  // Nodes before the next one that stay for one behind it.
  NodeIndex reach_ = 0;
};

DroppableSearch::DroppableSearch(const PoseGraph& graph,
                                 const RetentionOptions& options,
                                 RetentionNeeds needs,
                                 std::optional<std::int64_t> latest_ns)
    : impl_(
          std::make_unique<Impl>(graph, options, std::move(needs), latest_ns)) {
  assert(options.max_passes >= 0 && options.max_passes <= kMostPasses);
}

DroppableSearch::~DroppableSearch() = default;

const RetentionOptions& DroppableSearch::options() const {
  return impl_->options();
}

const RetentionNeeds& DroppableSearch::needs() const { return impl_->needs(); }

bool DroppableSearch::Advance(NodeIndex nodes) { return impl_->Advance(nodes); }

std::vector<NodeRange> DroppableSearch::Droppable(
    const std::vector<NodeIndex>& loop_ends) {
  return impl_->Droppable(loop_ends);
}

NodeIndex DroppableSearch::CountTooOld(
    const std::vector<NodeRange>& ranges) const {
  return impl_->CountTooOld(ranges);
}

// A node lies at or after its pose and before the next one, unless it starts a
// segment, which it does at its pose.
SequenceRange SequencesOf(const PoseGraph& graph, const NodeRange& nodes) {
  assert(nodes.first < nodes.last && nodes.last < graph.size());
  const auto starts = [&](NodeIndex i) { return graph.SegmentStart(i) == i; };
  SequenceRange range{1, 0};
  if (nodes.first > 0) {
    range.first =
        graph.node(nodes.first).sequence + (starts(nodes.first) ? 0 : 1);
  }
  range.last = starts(nodes.last) ? graph.node(nodes.last).sequence - 1
                                  : graph.node(nodes.last - 1).sequence;
  return range;
}

}  // namespace revisit::core
