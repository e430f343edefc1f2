#include "core/alignment/relative.h"

#include <algorithm>
#include <array>
#include <bitset>
#include <cassert>
#include <cmath>
#include <limits>

#include "core/alignment/similarity_kernel.h"
#include "core/alignment/walk_kernel.h"
#include "core/geometry/heading.h"

namespace revisit::core {
namespace {

constexpr Direction DirectionOf(std::size_t way) {
  return way == 0 ? Direction::kSame : Direction::kOpposite;
}

// -1 walks back in time, as the recent path is walked.
constexpr NodeIndex Stride(std::size_t way) { return way == 0 ? -1 : 1; }

// Share of an end's covariance that its path cannot take away.
constexpr double kLeastUncertaintyLeft = 1e-3;

// What bounds may be wrong by for rounding, nats.
constexpr double kBoundSlack = 1e-6;

// Share of two variances that their difference may be wrong by.
constexpr double kCancelled = 1e-12;

// The way on the far side of a loop closure: passes in opposite directions are
// told by their headings.
std::size_t WayBeyond(const PoseGraph& graph, NodeIndex near, NodeIndex far,
                      std::size_t way) {
  return DirectionOf(graph, {near, far}) == Direction::kOpposite ? 1 - way
                                                                 : way;
}

// Poses of the history as the kernel reads them; blocks are filled in when they
// are first needed, so that a search that looks at few nodes touches few.
class PoseTable {
 public:
  PoseTable(const PoseGraph& graph, NodeIndex size)
      : graph_(graph),
        size_(size),
        // Not set to 0: most of it may never be looked at.
        poses_(new double[4 * static_cast<std::size_t>(size)]),
        filled_(BlocksOf(size)) {
    if (size > 0) Need(0, 0);
  }

  const double* poses() const { return poses_.get(); }

  // That of the nodes of [first, last] which are of the history.
  void Need(NodeIndex first, NodeIndex last) {
    constexpr auto kSize = static_cast<NodeIndex>(NodeBlock::kSize);
    first = std::max<NodeIndex>(first, 0);
    last = std::min(last, size_ - 1);
    for (NodeIndex k = first / kSize; k * kSize <= last; ++k) {
      if (!filled_[static_cast<std::size_t>(k)]) Fill(k);
    }
  }

 private:
  void Fill(NodeIndex k) {
    filled_[static_cast<std::size_t>(k)] = 1;
    const NodeBlock& block = graph_.block(static_cast<std::size_t>(k));
    const auto first = static_cast<std::size_t>(k) * NodeBlock::kSize;
    const std::size_t count =
        std::min(NodeBlock::kSize, static_cast<std::size_t>(size_) - first);
    double* pose = poses_.get() + 4 * first;
    for (std::size_t i = 0; i < count; ++i, pose += 4) {
      const Pose of_node = block.pose(i);
      pose[0] = of_node.x;
      pose[1] = of_node.y;
      pose[2] = of_node.z;
      pose[3] = of_node.heading;
    }
  }

  const PoseGraph& graph_;
  const NodeIndex size_;
  const std::unique_ptr<double[]> poses_;
  std::vector<char> filled_;
};

// The differences of the query and the history block by block, from the last to
// the first.
template <int D>
class Differences {
 public:
  Differences(const PoseGraph& graph, const RelativeModel& model,
              NodeIndex query, std::size_t way)
      : graph_(graph),
        query_(query),
        model_(AnchorModel(model, way)),
        next_(query) {
    if (model_.correlation == CorrelationModel::kFilter) {
      psi_ = StateMatrix<D>::Identity();
      return;
    }
    kernel_query_ = MakeKernelQuery(graph, model_, query);
    if (model.last_confirmed) {
      if (const auto known = KnownDrift<D>::Make(
              graph, model_, *model.last_confirmed, query)) {
        known_drift_ = known->Terms();
      }
    }
  }

  // Of nodes [first, first + count), which begin block k. `next`: the block
  // that will be asked for after it.
  void Find(std::size_t k, std::size_t count, std::size_t next,
            DifferenceBlock* differences) {
    if (model_.correlation == CorrelationModel::kFilter) {
      FindFiltered(k, count, differences);
      return;
    }
    FindDifferences(kernel_query_, graph_.block(k), graph_.block(next),
                    differences);
    if (known_drift_) {
      TakeKnownDrift(*known_drift_, model_.state_space, graph_.block(k),
                     static_cast<NodeIndex>(k * NodeBlock::kSize), differences);
    }
  }

 private:
  // The similarity of the end poses, walked this way, as the Gaussian it is.
  static SimilarityModel AnchorModel(const RelativeModel& model,
                                     std::size_t way) {
    SimilarityModel anchor = model.similarity;
    anchor.direction = DirectionOf(way);
    anchor.form = LikelihoodForm::kGaussian;
    return anchor;
  }

  // One product of transitions, run backward from the query past every node.
  void FindFiltered(std::size_t k, std::size_t count,
                    DifferenceBlock* differences) {
    const auto first = static_cast<NodeIndex>(k * NodeBlock::kSize);
    const Pose query_pose = graph_.pose(query_);
    const StateMatrix<D> query_covariance =
        ToMatrix<D>(graph_.covariance(query_));
    for (std::size_t i = count; i-- > 0;) {
      const NodeIndex j = first + static_cast<NodeIndex>(i);
      for (; next_ > j && !decorrelated_; --next_) {
        psi_ *= ToMatrix<D>(graph_.transition(next_));
        if (psi_.template lpNorm<Eigen::Infinity>() < kDecorrelatedNorm) {
          psi_.setZero();
          decorrelated_ = true;
        }
      }
      const Node node = graph_.node(j);
      const StateMatrix<D> covariance = ToleratedCovariance<D>(
          model_, DifferenceCovariance<D>(ToMatrix<D>(node.covariance),
                                          query_covariance, psi_));
      const StateVector<D> difference =
          ToVector<D>(PassDifference(model_, query_pose, node.pose));
      std::size_t entry = 0;
      for (int r = 0; r < D; ++r) {
        differences->difference[static_cast<std::size_t>(r)][i] = difference(r);
        for (int c = 0; c <= r; ++c) {
          differences->covariance[entry++][i] = covariance(r, c);
        }
      }
    }
  }

  const PoseGraph& graph_;
  const NodeIndex query_;
  const SimilarityModel model_;
  // Of kDeadReckoning and kIndependent.
  KernelQuery kernel_query_;
  std::optional<KnownDriftTerms> known_drift_;
  // Of kFilter: Psi(query, next_).
  StateMatrix<D> psi_;
  NodeIndex next_;
  bool decorrelated_ = false;
};

}  // namespace

double LogNewPlaceTerm(const RelativeModel& model) {
  const int dimensions = DegreesOfFreedom(model.similarity.state_space);
  const double density =
      2.0 / (kPi * model.road_spacing_meters * model.spacing_meters) /
      (model.similarity.state_space == StateSpace::kSpatial ? kRoadHeightRange
                                                            : 1.0);
  return -0.5 * dimensions * std::log(2.0 * kPi) - std::log(density);
}

template <int D>
class RelativeAligner
    : public PathFinder,
      public std::enable_shared_from_this<RelativeAligner<D>> {
 public:
  RelativeAligner(const PoseGraph& graph, const RelativeModel& model,
                  NodeIndex query, std::int64_t steps, NodeIndex history_size)
      : graph_(graph),
        model_(model),
        query_(query),
        size_(history_size),
        filter_(graph, model.motion_history, query, steps,
                model.similarity.correlation, model.shape,
                model.similarity.tolerance, model.spacing_meters,
                model.similarity.inflation),
        has_loops_(graph.has_loop_edges()),
        constant_(LogNewPlaceTerm(model)),
        weight_(ShapeWeight(model.shape, model.spacing_meters)) {
    MakeSteps();
    MakeBound();
  }

  // Nothing if told to stop.
  std::optional<RelativeAlignment> Align(const ShouldStop& should_stop) const {
    PoseTable table(graph_, size_);
    std::vector<Sought> sought;
    for (const std::size_t way : {0, 1}) {
      if (way == 0 ? model_.same_direction : model_.opposite_direction) {
        sought.push_back({Search(*this, way, &table),
                          Differences<D>(graph_, model_, query_, way)});
      }
    }
    RelativeAlignment alignment;
    double greatest = 0.0;
    const std::vector<std::size_t> blocks = BlocksToSearch();
    for (std::size_t i = 0; i < blocks.size(); ++i) {
      if (should_stop && should_stop()) return std::nullopt;
      const std::size_t next =
          i + 1 < blocks.size() ? blocks[i + 1] : blocks[0];
      BlockNodes considered;
      for (Sought& way : sought) {
        considered |=
            way.search.Evaluate(blocks[i], next, &way.differences, &greatest);
      }
      alignment.considered_ += static_cast<NodeIndex>(considered.count());
    }
    for (Sought& way : sought) {
      way.search.Finish(model_.least_log_share + greatest, &alignment);
    }
    alignment.paths_ = this->shared_from_this();
    return alignment;
  }

  std::vector<PathStep> Find(Direction direction, NodeIndex j) const override {
    PoseTable table(graph_, size_);
    Search search(*this, IndexOf(direction), &table);
    return search.Retrace(j);
  }

 private:
  using BlockNodes = std::bitset<NodeBlock::kSize>;

  // A step of a path that is recorded.
  struct TrailStep {
    PathStep step;
    // Of the step before; -1 at the end.
    std::int64_t before = -1;
  };
  using Trail = std::vector<TrailStep>;

  static std::size_t Position(NodeIndex i) {
    return static_cast<std::size_t>(i);
  }

  void MakeSteps() {
    steps_.resize(Position(filter_.size()));
    certainties_.resize(Position(filter_.size()) * kMostEntries);
    for (std::int64_t t = filter_.size() - 1; t >= 0; --t) {
      WalkStep& step = steps_[Position(t)];
      step = filter_.Kernel(t);
      step.settled = 2.0 * kSlipCost;
      if (t + 1 < filter_.size()) {
        const WalkStep& next = steps_[Position(t + 1)];
        step.to_come = next.to_come + next.surprise;
      }
      Pack(ToFrame(filter_.EndCertainty(t)),
           certainties_.data() + Position(t) * kMostEntries);
    }
  }

  static void Pack(const StateMatrix<D>& matrix, double* entries) {
    for (int r = 0; r < D; ++r) {
      for (int c = 0; c <= r; ++c) *entries++ = matrix(r, c);
    }
  }

  StateMatrix<D> ToFrame(const StateMatrix<D>& covariance) const {
    const StateMatrix<D> turn = TurnAbout<D>(graph_.pose(query_).heading);
    return turn * covariance * turn.transpose();
  }

  // Of what an end's score gains by its shift, at most half is paid for by half
  // of its squared innovations: w/2 of them, which are at least
  // s^T EndShift()^-1 s. The other half stays with its path.
  void MakeBound() {
    Pack(ToFrame((2.0 / weight_) * filter_.EndShift()), bound_.shift);
    Pack(ToFrame(filter_.EndCertainty(filter_.size() - 1)), bound_.certainty);
    bound_.least_left = kLeastUncertaintyLeft;
  }

  // Those of the history that may hold an end with the least log-odds. From the
  // last to the first; but where few blocks are left the nearest come first,
  // which are likely to have the greatest odds: the greater these, the fewer
  // other ends need be walked from.
  std::vector<std::size_t> BlocksToSearch() const {
    const std::size_t all = BlocksOf(size_);
    // [bounded_from, bounded_to) may be judged by their bounds.
    std::size_t bounded_from = 0;
    std::size_t bounded_to = 0;
    BlockBounds::Region region;
    NodeRegion of_nodes;
    if (model_.least_log_share != kImpossible &&
        model_.block_bounds != nullptr) {
      BoundBlocks(&bounded_from, &bounded_to, &region, &of_nodes);
    }
    std::vector<std::size_t> blocks;
    for (std::size_t k = all; k-- > bounded_to;) blocks.push_back(k);
    if (bounded_from < bounded_to) {
      model_.block_bounds->VisitNear(region, bounded_from, bounded_to,
                                     [&](std::size_t k) {
                                       if (HoldsNear(of_nodes, graph_.block(k)))
                                         blocks.push_back(k);
                                     });
    }
    for (std::size_t k = bounded_from; k-- > 0;) blocks.push_back(k);
    if (bounded_from < bounded_to) SortByDistance(&blocks);
    return blocks;
  }

  // Of one node of each.
  void SortByDistance(std::vector<std::size_t>* blocks) const {
    const Pose query = graph_.pose(query_);
    std::vector<std::pair<double, std::size_t>> order;
    order.reserve(blocks->size());
    for (const std::size_t k : *blocks) {
      const auto first = static_cast<NodeIndex>(k * NodeBlock::kSize);
      constexpr auto kMiddle = static_cast<NodeIndex>(NodeBlock::kSize / 2);
      const Pose pose = graph_.pose(std::min(first + kMiddle, size_ - 1));
      order.emplace_back(std::hypot(pose.x - query.x, pose.y - query.y), k);
    }
    std::sort(order.begin(), order.end());
    for (std::size_t i = 0; i < order.size(); ++i) {
      (*blocks)[i] = order[i].second;
    }
  }

  // With u the direction from the node to the query in x and y, r the distance,
  // G = Gamma + R, V = u^T G u and a the shift in x and y:
  //
  //   (d + a)^T G^-1 (d + a) >= (u (d + a))^2 / V >= (r - |a|)^2 / V,
  //
  // and w |a|^2 / l is paid for, l the greatest variance of the shift; over all
  // a that is at least r^2 / (V + l / w). For dead reckoning the lever arm is
  // at right angles to u, so that u^T Gamma u = u^T (S_q - S_j) u. Where Gamma
  // is positive definite, |G - A| is at least |R - A|. Of blocks, bounds of V
  // are known in any direction; of single nodes it is known itself.
  void BoundBlocks(std::size_t* from, std::size_t* to,
                   BlockBounds::Region* region, NodeRegion* of_nodes) const {
    const SimilarityModel& similarity = model_.similarity;
    const bool dead_reckoning =
        similarity.correlation == CorrelationModel::kDeadReckoning;
    // What a closure tells moves the ends elsewhere, and filters' errors may
    // hang together in any way.
    if (similarity.correlation == CorrelationModel::kFilter ||
        (dead_reckoning && model_.last_confirmed)) {
      return;
    }
    StateMatrix<D> tolerance = StateMatrix<D>::Zero();
    AddTolerance<D>(similarity.tolerance, &tolerance);
    const StateMatrix<D> left =
        (1.0 - kLeastUncertaintyLeft) * tolerance -
        ToFrame(filter_.EndCertainty(filter_.size() - 1));
    double log_determinant = 0.0;
    if (const auto terms = Evaluate<D>(left, StateVector<D>::Zero())) {
      log_determinant = terms->log_determinant;
    } else if (const auto whole =
                   Evaluate<D>(tolerance, StateVector<D>::Zero())) {
      log_determinant =
          whole->log_determinant + D * std::log(kLeastUncertaintyLeft);
    } else {
      return;
    }
    // A check lies well behind its history, but sequences may be short.
    constexpr auto kBlock = static_cast<NodeIndex>(NodeBlock::kSize);
    std::size_t blocks = std::min(model_.block_bounds->size(),
                                  Position(size_) / NodeBlock::kSize);
    while (blocks > 0 &&
           (static_cast<NodeIndex>(blocks) + 1) * kBlock + kBlock / 2 >
               query_) {
      --blocks;
    }
    *to = blocks;
    *from = dead_reckoning
                ? model_.block_bounds->FirstGrowing(graph_, query_, blocks)
                : 0;
    const double claimed = similarity.inflation * similarity.inflation;
    const Covariance covariance = graph_.covariance(query_);
    const StateMatrix<D>& shift = filter_.EndShift();
    const Pose query = graph_.pose(query_);
    region->x = query.x;
    region->y = query.y;
    const double of_neither =
        tolerance(0, 0) +
        VariancesInAnyDirection(shift(0, 0), shift(0, 1), shift(1, 1)).most /
            weight_;
    region->variance =
        claimed * VariancesInAnyDirection(covariance(0, 0), covariance(0, 1),
                                          covariance(1, 1))
                      .most +
        of_neither;
    region->squared_per_variance =
        2.0 * (constant_ - 0.5 * log_determinant + weight_ * steps_[0].to_come +
               kBoundSlack - model_.least_log_share);
    (dead_reckoning ? region->least_taken : region->most_added) = claimed;
    of_nodes->x = query.x;
    of_nodes->y = query.y;
    of_nodes->squared_per_variance = region->squared_per_variance;
    of_nodes->variance = of_neither + kCancelled * region->variance;
    of_nodes->xx = claimed * covariance(0, 0);
    of_nodes->xy = claimed * covariance(0, 1);
    of_nodes->yy = claimed * covariance(1, 1);
    of_nodes->node_scale = dead_reckoning ? -claimed : claimed;
  }

  // The search of one direction.
  class Search {
   public:
    Search(const RelativeAligner& aligner, std::size_t way, PoseTable* table)
        : aligner_(aligner),
          graph_(aligner.graph_),
          way_(way),
          table_(*table),
          weight_(aligner.weight_) {
      const double heading = graph_.pose(aligner.query_).heading;
      change_.certainty = aligner.certainties_.data();
      change_.cosine = std::cos(heading);
      change_.sine = std::sin(heading);
      change_.least_left = kLeastUncertaintyLeft;
    }

    // The ends in block k; answers which of them were considered, or are none.
    // `greatest` rises to the greatest log-odds, if it is less. `next`: the
    // block that will be asked for after it.
    BlockNodes Evaluate(std::size_t k, std::size_t next,
                        Differences<D>* differences, double* greatest) {
      constexpr std::size_t kSize = NodeBlock::kSize;
      first_ = static_cast<NodeIndex>(k * kSize);
      count_ = std::min(kSize, Position(aligner_.size_ - first_));
      differences->Find(k, count_, next, &differences_);
      // Nothing is said of entries beyond the history.
      for (auto& column : differences_.difference) {
        std::fill(column.begin() + static_cast<int>(count_), column.end(), 0.0);
      }
      EvaluateDifferences(StateSpaceOf(), differences_, &similarity_);
      for (const NodeRange& nodes : aligner_.model_.not_sought) {
        const NodeIndex last =
            std::min(nodes.last - first_, static_cast<NodeIndex>(count_));
        for (NodeIndex i = std::max<NodeIndex>(nodes.first - first_, 0);
             i < last; ++i) {
          similarity_.log_similarity[Position(i)] = kImpossible;
        }
      }
      const double least = aligner_.model_.least_log_share + *greatest;
      BlockNodes useful;
      BlockNodes considered;
      FindUseful(least, &useful, &considered);
      if (useful.none()) return considered;
      Reset();
      table_.Need(first_ - 2 * aligner_.filter_.size(),
                  first_ + static_cast<NodeIndex>(count_) +
                      2 * aligner_.filter_.size());
      std::array<std::size_t, kTogether> together;
      for (std::size_t i = 0; i < count_;) {
        std::size_t count = 0;
        for (; i < count_ && count < kTogether; ++i) {
          if (useful[i]) together[count++] = i;
        }
        walkers_.Begin(count);
        for (std::size_t w = 0; w < count; ++w) {
          const std::size_t at = together[w];
          // What the best path could have, less what the end can do without.
          Seed(w, first_ + static_cast<NodeIndex>(at),
               aligner_.steps_[0].to_come - (bounds_[at] - least) / weight_);
        }
        Walk();
      }
      EvaluateChanged(StateSpaceOf(), differences_, change_, &similarity_);
      for (std::size_t i = count_; i-- > 0;) {
        const double score = similarity_.log_similarity[i] +
                             weight_ * ratios_[i] + aligner_.constant_;
        if (!useful[i] || !(score >= least)) continue;
        *greatest = std::max(*greatest, score);
        found_.push_back(
            {{first_ + static_cast<NodeIndex>(i), score},
             {ratios_[i], squares_[i], similarity_.squared_mahalanobis[i],
              change_.row[i]}});
      }
      return considered;
    }

    // Hands over what was found, but for what has lower log-odds.
    void Finish(double least, RelativeAlignment* alignment) {
      const auto older = [](const Found& a, const Found& b) {
        return a.end.node < b.end.node;
      };
      // As they are found where all blocks are walked from in their order.
      std::reverse(found_.begin(), found_.end());
      if (!std::is_sorted(found_.begin(), found_.end(), older)) {
        std::sort(found_.begin(), found_.end(), older);
      }
      ScoredEnds& ends = alignment->ends_[way_];
      std::vector<ShapeMatch>& matches = alignment->matches_[way_];
      ends.reserve(found_.size());
      matches.reserve(found_.size());
      for (const Found& found : found_) {
        if (!(found.end.score >= least)) continue;
        ends.push_back(found.end);
        matches.push_back(found.match);
      }
    }

    std::vector<PathStep> Retrace(NodeIndex j) {
      Trail trail;
      trail_ = &trail;
      first_ = j;
      count_ = 1;
      Reset();
      table_.Need(j - 2 * aligner_.filter_.size(),
                  j + 2 * aligner_.filter_.size());
      trail.push_back({{0, j, DirectionOf(way_)}, -1});
      walkers_.Begin(1);
      Seed(0, j, kImpossible);
      Walk();
      std::vector<PathStep> path;
      for (std::int64_t i = best_trail_; i >= 0;
           i = trail[Position(i)].before) {
        path.push_back(trail[Position(i)].step);
      }
      std::reverse(path.begin(), path.end());
      return path;
    }

   private:
    // Ends that are walked back from at once: what they hold should fit the
    // nearest cache.
    static constexpr std::size_t kTogether = 64;

    using Drift = typename ShapeFilter<D>::Drift;
    using Evidence = typename ShapeFilter<D>::Evidence;

    StateSpace StateSpaceOf() const {
      return aligner_.model_.similarity.state_space;
    }

    struct Found {
      ScoredEnd end;
      ShapeMatch match;
    };

    // Which ends may come to the least log-odds, and what each can come to at
    // most, were its path the best there can be. Those are considered, and
    // those of which nothing can be said.
    void FindUseful(double least, BlockNodes* useful, BlockNodes* considered) {
      constexpr double kNothingKnown = std::numeric_limits<double>::infinity();
      if (least == kImpossible) {
        bounds_.fill(kNothingKnown);
      } else {
        BoundChanged(StateSpaceOf(), differences_, aligner_.bound_, similarity_,
                     &bounds_);
      }
      const double beside = aligner_.constant_ + kBoundSlack +
                            weight_ * aligner_.steps_[0].to_come;
      for (std::size_t i = 0; i < count_; ++i) {
        if (similarity_.log_similarity[i] == kImpossible) {
          considered->set(i);
          continue;
        }
        bounds_[i] += beside;
        // Written so that what is not a number is nothing known.
        if (!(bounds_[i] <= kNothingKnown)) bounds_[i] = kNothingKnown;
        if (bounds_[i] < least) continue;
        useful->set(i);
        considered->set(i);
      }
    }

    void Reset() {
      ratios_.fill(0.0);
      squares_.fill(0.0);
      change_.row.fill(0);
      for (auto& column : change_.shift) column.fill(0.0);
      best_trail_ = 0;
    }

    // The last node to be reached from i, walked this way.
    NodeIndex LastOf(NodeIndex i, std::size_t way) const {
      return way == 0 ? graph_.SegmentStart(i)
                      : std::min(graph_.SegmentEnd(i), aligner_.size_) - 1;
    }

    // Puts walker i, which is as Begin() left it, at end j.
    void Seed(std::size_t i, NodeIndex j, double needed) {
      const Pose pose = graph_.pose(j);
      const double sign = way_ == 0 ? 1.0 : -1.0;
      walkers_.at(Walkers::kX, i) = pose.x;
      walkers_.at(Walkers::kY, i) = pose.y;
      walkers_.at(Walkers::kZ, i) = pose.z;
      walkers_.at(Walkers::kHeading, i) = pose.heading;
      walkers_.at(Walkers::kCosine, i) = sign * std::cos(pose.heading);
      walkers_.at(Walkers::kSine, i) = sign * std::sin(pose.heading);
      walkers_.at(Walkers::kNeeded, i) = needed;
      walkers_.at(Walkers::kNode, i) = j;
      walkers_.at(Walkers::kStride, i) = Stride(way_);
      walkers_.at(Walkers::kLast, i) = LastOf(j, way_);
      walkers_.at(Walkers::kEnd, i) = j - first_;
    }

    std::size_t WayOf(std::size_t i) const {
      return walkers_.at(Walkers::kStride, i) < 0 ? 0 : 1;
    }

    // A pose (x, y, z, heading) as walker i sees it from its end.
    StateVector<D> SeenBy(std::size_t i, const double* pose) const {
      const double x = pose[0] - walkers_.at(Walkers::kX, i);
      const double y = pose[1] - walkers_.at(Walkers::kY, i);
      const double cosine = walkers_.at(Walkers::kCosine, i);
      const double sine = walkers_.at(Walkers::kSine, i);
      const double forward = cosine * x + sine * y;
      const double left = cosine * y - sine * x;
      const double heading = pose[3] - walkers_.at(Walkers::kHeading, i);
      if constexpr (D == 3) {
        return {forward, left, heading};
      } else {
        return {forward, left, pose[2] - walkers_.at(Walkers::kZ, i), heading};
      }
    }

    // nu^T S^-1 nu of walker i, were it at this node next.
    double SquaredInnovation(const WalkStep& step, std::size_t i,
                             NodeIndex node) const {
      const StateVector<D> seen =
          SeenBy(i, table_.poses() + 4 * Position(node));
      const double turn = walkers_.at(Walkers::kNow + D - 1, i);
      const double carried[2] = {-step.step_y * turn, step.step_x * turn};
      double position[D - 1];
      for (std::size_t r = 0; r < D - 1; ++r) {
        position[r] = step.path[r] - seen(static_cast<int>(r)) -
                      walkers_.at(Walkers::kNow + r, i);
        if (r < 2) position[r] -= carried[r];
      }
      // Apart from the position: kept together in memory, they would be read
      // before they are written.
      double heading = step.path[D - 1] - seen(D - 1) - turn;
      // Off by a turn or two at most.
      while (heading > kPi) heading -= 2.0 * kPi;
      while (heading < -kPi) heading += 2.0 * kPi;
      double squared = 0.0;
      for (int r = 0; r < D; ++r) {
        double whitened = 0.0;
        for (int c = r; c < D - 1; ++c) {
          whitened += step.whitening[r][c] * position[c];
        }
        whitened += step.whitening[r][D - 1] * heading;
        squared += whitened * whitened;
      }
      return squared;
    }

    Drift DriftOf(std::size_t i) const {
      Drift drift;
      for (int r = 0; r < D; ++r) {
        const auto row = static_cast<std::size_t>(r);
        drift.now(r) = walkers_.at(Walkers::kNow + row, i);
        drift.at_end(r) = walkers_.at(Walkers::kAtEnd + row, i);
      }
      return drift;
    }

    // Takes a walker one step on to a node.
    void Take(std::int64_t t, std::size_t i, NodeIndex to, const Drift& drift,
              double gained, double squared_innovation) {
      walkers_.at(Walkers::kNode, i) = to;
      const double ratio = walkers_.at(Walkers::kRatio, i) += gained;
      const double squares = walkers_.at(Walkers::kSquared, i) +=
          squared_innovation;
      for (int r = 0; r < D; ++r) {
        const auto row = static_cast<std::size_t>(r);
        walkers_.at(Walkers::kNow + row, i) = drift.now(r);
        walkers_.at(Walkers::kAtEnd + row, i) = drift.at_end(r);
      }
      if (!(ratio > walkers_.at(Walkers::kBestRatio, i))) return;
      walkers_.at(Walkers::kBestRatio, i) = ratio;
      walkers_.at(Walkers::kBestSquared, i) = squares;
      walkers_.at(Walkers::kBestSteps, i) = static_cast<double>(t);
      for (int r = 0; r < D; ++r) {
        walkers_.at(Walkers::kBestAtEnd + static_cast<std::size_t>(r), i) =
            drift.at_end(r);
      }
    }

    // Where keeping step may not be best: the likeliest of that, staying and
    // skipping a node. False if none is possible or of use.
    bool Slip(std::int64_t t, const Unsettled& unsettled) {
      const std::size_t i = unsettled.walker;
      const WalkStep& step = aligner_.steps_[Position(t)];
      // Were there no innovation from here on.
      const double most = walkers_.at(Walkers::kRatio, i) + step.surprise +
                          step.to_come - kSlipCost;
      const bool slips = most > walkers_.at(Walkers::kBestRatio, i) &&
                         most + 0.25 * walkers_.at(Walkers::kSquared, i) >=
                             walkers_.at(Walkers::kNeeded, i);
      double gained = kImpossible;
      NodeIndex nodes = 0;
      const auto consider = [&](double squared, double cost, NodeIndex on) {
        // Written so that NaN fails too.
        if (!(squared <= kSquaredInnovationLimit)) return;
        if (!(step.surprise - 0.5 * squared - cost > gained)) return;
        gained = step.surprise - 0.5 * squared - cost;
        nodes = on;
      };
      consider(unsettled.squared_innovation, 0.0, 1);
      if (slips) {
        const NodeIndex node = walkers_.at(Walkers::kNode, i);
        const NodeIndex stride = walkers_.at(Walkers::kStride, i);
        const NodeIndex last = walkers_.at(Walkers::kLast, i);
        consider(SquaredInnovation(step, i, node), kSlipCost, 0);
        if (node != last && node + stride != last) {
          consider(SquaredInnovation(step, i, node + 2 * stride), kSlipCost, 2);
        }
      }
      if (gained == kImpossible) return false;
      const NodeIndex to = walkers_.at(Walkers::kNode, i) +
                           nodes * walkers_.at(Walkers::kStride, i);
      Drift drift = DriftOf(i);
      const Evidence evidence = aligner_.filter_.Advance(
          t, SeenBy(i, table_.poses() + 4 * Position(to)), &drift);
      Take(t, i, to, drift, gained, evidence.squared_innovation);
      return true;
    }

    // Adds, for each walker at a loop closure, what walks on beyond it.
    void WalkOverLoops(std::int64_t t, std::size_t walkers) {
      for (std::size_t i = 0; i < walkers; ++i) {
        const NodeIndex near = walkers_.at(Walkers::kNode, i);
        for (const NodeIndex far : graph_.LoopNeighbours(near)) {
          if (far < aligner_.size_) WalkOver(t, i, far);
        }
      }
    }

    void WalkOver(std::int64_t t, std::size_t i, NodeIndex far) {
      const std::size_t way = WayOf(i);
      const NodeIndex near = walkers_.at(Walkers::kNode, i);
      const std::size_t far_way = WayBeyond(graph_, near, far, way);
      const NodeIndex last = LastOf(far, far_way);
      if (far == last) return;
      table_.Need(far - 2 * aligner_.filter_.size(),
                  far + 2 * aligner_.filter_.size());
      // The far node is where this one is, and is seen as this one is.
      const StateVector<D> seen =
          SeenBy(i, table_.poses() + 4 * Position(near));
      const Pose pose = graph_.pose(far);
      const double turned = far_way == 0 ? 0.0 : kPi;
      const double heading = pose.heading + turned - seen(D - 1);
      const double cosine = std::cos(heading);
      const double sine = std::sin(heading);
      const std::size_t on = walkers_.Add();
      walkers_.Copy(i, on);
      walkers_.at(Walkers::kX, on) =
          pose.x - (cosine * seen(0) - sine * seen(1));
      walkers_.at(Walkers::kY, on) =
          pose.y - (sine * seen(0) + cosine * seen(1));
      if constexpr (D == 4) walkers_.at(Walkers::kZ, on) = pose.z - seen(2);
      walkers_.at(Walkers::kHeading, on) = heading - turned;
      walkers_.at(Walkers::kCosine, on) = cosine;
      walkers_.at(Walkers::kSine, on) = sine;
      walkers_.at(Walkers::kStride, on) = Stride(far_way);
      walkers_.at(Walkers::kLast, on) = last;
      const NodeIndex beyond = far + Stride(far_way);
      Drift drift = DriftOf(on);
      const Evidence evidence = aligner_.filter_.Advance(
          t, SeenBy(on, table_.poses() + 4 * Position(beyond)), &drift);
      if (!(evidence.squared_innovation <= kSquaredInnovationLimit)) {
        walkers_.Remove(on);
        return;
      }
      Take(t, on, beyond, drift, evidence.log_likelihood_ratio,
           evidence.squared_innovation);
    }

    // Of the paths of the ends of walkers from `first` on: marks as done those
    // that met a likelier one, and the least likely beyond kMostPaths.
    void Merge(std::size_t first, std::vector<char>* done) {
      std::vector<std::int64_t> ends;
      for (std::size_t i = first; i < walkers_.size(); ++i) {
        ends.push_back(walkers_.at(Walkers::kEnd, i));
      }
      std::sort(ends.begin(), ends.end());
      ends.erase(std::unique(ends.begin(), ends.end()), ends.end());
      std::vector<std::size_t> paths;
      for (const std::int64_t end : ends) {
        paths.clear();
        for (std::size_t i = 0; i < walkers_.size(); ++i) {
          if (walkers_.at(Walkers::kEnd, i) == end && !(*done)[i]) {
            paths.push_back(i);
          }
        }
        std::stable_sort(paths.begin(), paths.end(),
                         [this](std::size_t a, std::size_t b) {
                           return walkers_.at(Walkers::kRatio, a) >
                                  walkers_.at(Walkers::kRatio, b);
                         });
        std::size_t kept = 0;
        for (std::size_t k = 0; k < paths.size(); ++k) {
          const std::size_t i = paths[k];
          const bool met =
              std::any_of(paths.begin(), paths.begin() + static_cast<int>(k),
                          [&](std::size_t other) {
                            return !(*done)[other] &&
                                   walkers_.at(Walkers::kNode, other) ==
                                       walkers_.at(Walkers::kNode, i) &&
                                   walkers_.at(Walkers::kStride, other) ==
                                       walkers_.at(Walkers::kStride, i);
                          });
          if (met || kept == kMostPaths) {
            (*done)[i] = 1;
          } else {
            ++kept;
          }
        }
      }
    }

    void Walk() {
      std::vector<char> done;
      for (std::int64_t t = 1;
           t < aligner_.filter_.size() && walkers_.size() > 0; ++t) {
        // Beyond loop closures first, while the others are where they were.
        const std::size_t before = walkers_.size();
        if (aligner_.has_loops_) WalkOverLoops(t, before);
        const std::size_t after = walkers_.size();
        WalkOn(StateSpaceOf(), aligner_.steps_[Position(t)], table_.poses(),
               before, &walkers_, &unsettled_);
        if (unsettled_.empty() && after == before && trail_ == nullptr) {
          continue;
        }
        done.assign(after, 0);
        for (const Unsettled& unsettled : unsettled_) {
          const std::size_t i = unsettled.walker;
          done[i] = unsettled.hopeless || !Slip(t, unsettled);
        }
        if (after > before) Merge(before, &done);
        if (trail_ != nullptr) Record(t);
        for (std::size_t i = after; i-- > 0;) {
          if (!done[i]) continue;
          Credit(i);
          walkers_.Remove(i);
        }
      }
      for (std::size_t i = 0; i < walkers_.size(); ++i) Credit(i);
    }

    void Record(std::int64_t t) {
      for (std::size_t i = 0; i < walkers_.size(); ++i) {
        std::int64_t& trail = walkers_.at(Walkers::kTrail, i);
        trail_->push_back(
            {{t, walkers_.at(Walkers::kNode, i), DirectionOf(WayOf(i))},
             trail});
        trail = static_cast<std::int64_t>(trail_->size()) - 1;
        if (walkers_.at(Walkers::kBestSteps, i) == static_cast<double>(t)) {
          walkers_.at(Walkers::kBestTrail, i) = trail;
        }
      }
    }

    // The best of a path counts for its end.
    void Credit(std::size_t i) {
      const std::size_t end = Position(walkers_.at(Walkers::kEnd, i));
      const double ratio = walkers_.at(Walkers::kBestRatio, i);
      if (!(ratio > ratios_[end])) return;
      ratios_[end] = ratio;
      squares_[end] = walkers_.at(Walkers::kBestSquared, i);
      change_.row[end] =
          static_cast<std::int64_t>(walkers_.at(Walkers::kBestSteps, i));
      for (std::size_t r = 0; r < D; ++r) {
        change_.shift[r][end] = walkers_.at(Walkers::kBestAtEnd + r, i);
      }
      best_trail_ = walkers_.at(Walkers::kBestTrail, i);
    }

    const RelativeAligner& aligner_;
    const PoseGraph& graph_;
    const std::size_t way_;
    PoseTable& table_;
    const double weight_;
    // Of the block at hand.
    NodeIndex first_ = 0;
    std::size_t count_ = 0;
    DifferenceBlock differences_;
    BlockSimilarity similarity_;
    // The most that the log-odds of each useful end can come to.
    BlockColumn bounds_;
    BlockColumn ratios_;
    BlockColumn squares_;
    DifferenceChange change_;
    Walkers walkers_;
    std::vector<Unsettled> unsettled_;
    // Where paths are recorded, if they are, and the best one's last step.
    Trail* trail_ = nullptr;
    std::int64_t best_trail_ = 0;
    // In the order in which they were walked from.
    std::vector<Found> found_;
  };

  // One direction.
  struct Sought {
    Search search;
    Differences<D> differences;
  };

  const PoseGraph& graph_;
  const RelativeModel model_;
  const NodeIndex query_;
  const NodeIndex size_;
  const ShapeFilter<D> filter_;
  const bool has_loops_;
  const double constant_;
  const double weight_;
  std::vector<WalkStep> steps_;
  ChangeBound bound_;
  // By step, kMostEntries each: EndCertainty() in the axes of the local frame.
  std::vector<double> certainties_;
};

const ShapeMatch& RelativeAlignment::match(Direction direction,
                                           NodeIndex j) const {
  const ScoredEnds& ends = ends_[IndexOf(direction)];
  const auto found = std::lower_bound(
      ends.begin(), ends.end(), j,
      [](const ScoredEnd& end, NodeIndex node) { return end.node < node; });
  assert(found != ends.end() && found->node == j);
  return matches_[IndexOf(direction)]
                 [static_cast<std::size_t>(found - ends.begin())];
}

std::optional<RelativeAlignment> AlignRelative(
    const PoseGraph& graph, const RelativeModel& model, NodeIndex query,
    std::int64_t steps, NodeIndex history_size, const ShouldStop& should_stop) {
  assert(1 <= steps && steps <= query + 1);
  assert(history_size <= query - steps + 1);
  if (model.similarity.state_space == StateSpace::kPlanar) {
    return std::make_shared<const RelativeAligner<3>>(graph, model, query,
                                                      steps, history_size)
        ->Align(should_stop);
  }
  return std::make_shared<const RelativeAligner<4>>(graph, model, query, steps,
                                                    history_size)
      ->Align(should_stop);
}

}  // namespace revisit::core
