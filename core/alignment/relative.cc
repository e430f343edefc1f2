#include "core/alignment/relative.h"

#include <algorithm>
#include <cassert>
#include <cmath>

#include "core/geometry/heading.h"

namespace revisit::core {
namespace {

enum Move : std::uint8_t {
  kNone = 0,
  kOn = 1,
  kStay = 2,
  kSkip = 3,
  kOverLoop = 4,
};

constexpr Direction DirectionOf(std::size_t way) {
  return way == 0 ? Direction::kSame : Direction::kOpposite;
}

// -1 walks back in time, as the recent path is walked.
constexpr NodeIndex Stride(std::size_t way) { return way == 0 ? -1 : 1; }

constexpr std::int32_t kNoSlot = -1;

// Share of an end's covariance that its path cannot take away.
constexpr double kLeastUncertaintyLeft = 1e-3;

// The way on the far side of a loop closure: passes in opposite directions are
// told by their headings.
std::size_t WayBeyond(const PoseGraph& graph, NodeIndex near, NodeIndex far,
                      std::size_t way) {
  return DirectionOf(graph, {near, far}) == Direction::kOpposite ? 1 - way
                                                                 : way;
}

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
class RelativeAligner {
 public:
  RelativeAligner(const PoseGraph& graph, const RelativeModel& model,
                  NodeIndex query, std::int64_t steps, NodeIndex history_size)
      : graph_(graph),
        model_(model),
        query_(query),
        size_(history_size),
        weight_(ShapeWeight(model.shape, model.spacing_meters)),
        filter_(graph, query, steps,
                MeasureMotion<D>(graph, model.similarity.correlation, query),
                model.shape, model.similarity.tolerance, model.spacing_meters,
                model.similarity.inflation) {
    result_.size_ = history_size;
    if (model.last_confirmed) {
      known_drift_ = KnownDrift<D>::Make(graph, model.similarity,
                                         *model.last_confirmed, query);
    }
    joined_.resize(Position(size_) + 1);
    for (NodeIndex i = 0; i < size_;) {
      const NodeIndex end = std::min(graph.SegmentEnd(i), size_);
      for (++i; i < end; ++i) joined_[Position(i)] = 1;
    }
    has_loops_ = graph.has_loop_edges();
    for (std::size_t way = 0; way < 2; ++way) {
      next_slot_[way].assign(Position(size_), kNoSlot);
      if (way == 0 ? model.same_direction : model.opposite_direction) {
        Seed(way);
      }
    }
  }

  bool Run(const ShouldStop& should_stop) {
    for (std::int64_t t = 1; t < filter_.size() && !survivors_.empty(); ++t) {
      if (should_stop && should_stop()) return false;
      for (const Survivor& survivor : survivors_) WalkOn(t, survivor);
      if (has_loops_) {
        for (const Survivor& survivor : survivors_) WalkOverLoops(t, survivor);
      }
      for (const Survivor& survivor : survivors_) Slip(t, survivor);
      std::swap(survivors_, next_);
      next_.clear();
      for (const Survivor& survivor : survivors_) {
        next_slot_[survivor.way][Position(survivor.node)] = kNoSlot;
        Credit(t, survivor);
      }
    }
    return true;
  }

  RelativeAlignment Finish() {
    for (std::size_t way = 0; way < 2; ++way) {
      if (!result_.scores_[way].empty()) Score(way);
    }
    return std::move(result_);
  }

 private:
  // From where a path of history is seen: its end pose, carried over loop
  // closures.
  struct Frame {
    double x = 0.0;
    double y = 0.0;
    double z = 0.0;
    double heading = 0.0;
    double cosine = 1.0;
    double sine = 0.0;
  };
  struct Survivor {
    // Where it is, and which way it walks. Nodes of one vehicle are far fewer
    // than 2^31, and survivors are many.
    std::int32_t node = 0;
    // Where it began.
    std::int32_t end = 0;
    std::uint8_t way = 0;
    std::uint8_t end_way = 0;
    Frame frame;
    typename ShapeFilter<D>::Drift drift;
    double log_likelihood_ratio = 0.0;
    double squared_innovations = 0.0;
    // anchor + w log_likelihood_ratio: by which paths to one node compete.
    double total = 0.0;
  };

  static std::size_t Position(NodeIndex i) {
    return static_cast<std::size_t>(i);
  }

  double HeadingOf(NodeIndex i, std::size_t way) const {
    return graph_.node(i).pose.heading + (way == 0 ? 0.0 : kPi);
  }

  static Frame MakeFrame(double x, double y, double z, double heading) {
    return {x, y, z, heading, std::cos(heading), std::sin(heading)};
  }

  StateVector<D> SeenFrom(const Frame& frame, NodeIndex i,
                          std::size_t way) const {
    const Pose pose = graph_.node(i).pose;
    const double x = pose.x - frame.x;
    const double y = pose.y - frame.y;
    const double forward = frame.cosine * x + frame.sine * y;
    const double left = frame.cosine * y - frame.sine * x;
    const double heading = HeadingOf(i, way) - frame.heading;
    if constexpr (D == 3) {
      return {forward, left, heading};
    } else {
      return {forward, left, pose.z - frame.z, heading};
    }
  }

  // The similarity of the end poses, walked this way, as the Gaussian it is.
  SimilarityModel AnchorModel(std::size_t way) const {
    SimilarityModel anchor = model_.similarity;
    anchor.direction = DirectionOf(way);
    anchor.form = LikelihoodForm::kGaussian;
    return anchor;
  }

  // Calls visit(j, d_j, Gamma_j + R) for the nodes of history with wanted(j),
  // walked this way.
  template <typename Wanted, typename Visit>
  void VisitAnchors(std::size_t way, const Wanted& wanted,
                    const Visit& visit) const {
    const SimilarityModel anchor = AnchorModel(way);
    const Pose query = graph_.node(query_).pose;
    const auto call = [&](NodeIndex j, const StateMatrix<D>& gamma) {
      StateMatrix<D> covariance = ToleratedCovariance<D>(anchor, gamma);
      StateVector<D> difference =
          ToVector<D>(PassDifference(anchor, query, graph_.node(j).pose));
      if (known_drift_) {
        StateVector<D> known_difference = difference;
        StateMatrix<D> known_covariance = covariance;
        known_drift_->Apply(j, &known_difference, &known_covariance);
        // Where rounding leaves nothing of it, the node is judged without.
        if (Evaluate<D>(known_covariance, known_difference)) {
          visit(j, known_difference, known_covariance);
          return;
        }
      }
      visit(j, difference, covariance);
    };
    if (anchor.correlation == CorrelationModel::kFilter) {
      VisitDifferenceCovariances<D>(
          graph_, anchor.correlation, query_, size_,
          [&](NodeIndex j, const StateMatrix<D>& gamma) {
            if (wanted(j)) call(j, gamma);
          });
      return;
    }
    for (NodeIndex j = 0; j < size_; ++j) {
      if (!wanted(j)) continue;
      call(j, DifferenceCovariance<D>(graph_, anchor.correlation, query_, j));
    }
  }

  // ln N(d_j; 0, Gamma_j + R), less a constant, and its squared Mahalanobis
  // distance: of the end alone.
  void FindAnchors(std::size_t way) {
    std::vector<double>& anchors = result_.scores_[way];
    std::vector<ShapeMatch>& matches = result_.matches_[way];
    anchors.resize(Position(size_), kImpossible);
    matches.resize(Position(size_));
    const SimilarityModel anchor = AnchorModel(way);
    if (!known_drift_ && anchor.correlation != CorrelationModel::kFilter) {
      VisitBlockSimilarities(graph_, anchor, query_, size_,
                             [&](NodeIndex first, const BlockSimilarity& part) {
                               const std::size_t at = Position(first);
                               const std::size_t count = std::min(
                                   NodeBlock::kSize, Position(size_) - at);
                               for (std::size_t k = 0; k < count; ++k) {
                                 anchors[at + k] = part.log_similarity[k];
                                 matches[at + k].squared_end_difference =
                                     part.squared_mahalanobis[k];
                               }
                             });
      return;
    }
    VisitAnchors(
        way, [](NodeIndex) { return true; },
        [&](NodeIndex j, const StateVector<D>& difference,
            const StateMatrix<D>& covariance) {
          if (const auto terms = Evaluate<D>(covariance, difference)) {
            anchors[Position(j)] =
                -0.5 * (terms->log_determinant + terms->squared_mahalanobis);
            matches[Position(j)].squared_end_difference =
                terms->squared_mahalanobis;
          }
        });
  }

  // A survivor at every node, by the anchor of the end poses alone.
  void Seed(std::size_t way) {
    FindAnchors(way);
    const std::vector<double>& anchors = result_.scores_[way];
    end_drifts_[way].resize(Position(size_), StateVector<D>::Zero());
    survivors_.reserve(survivors_.size() + Position(size_));
    next_.reserve(survivors_.capacity());
    for (NodeIndex j = 0; j < size_; ++j) {
      ShapeMatch& match = result_.matches_[way][Position(j)];
      match.last = static_cast<std::int32_t>(j);
      match.last_direction = DirectionOf(way);
      const double anchor = anchors[Position(j)];
      if (anchor == kImpossible) continue;
      Survivor survivor;
      survivor.node = survivor.end = static_cast<std::int32_t>(j);
      survivor.way = survivor.end_way = static_cast<std::uint8_t>(way);
      const Pose pose = graph_.node(j).pose;
      survivor.frame = MakeFrame(pose.x, pose.y, pose.z, HeadingOf(j, way));
      survivor.total = anchor;
      survivors_.push_back(survivor);
    }
  }

  // Makes scores of the anchors.
  void Score(std::size_t way) {
    const StateMatrix<D> to_frame =
        TurnAbout<D>(graph_.node(query_).pose.heading);
    std::vector<StateMatrix<D>> certainties;
    for (std::int64_t t = 0; t < filter_.size(); ++t) {
      certainties.push_back(to_frame * filter_.EndCertainty(t) *
                            to_frame.transpose());
    }
    const double constant = LogNewPlaceTerm(model_);
    std::vector<double>& scores = result_.scores_[way];
    const auto has_path = [&](NodeIndex j) {
      return result_.matches_[way][Position(j)].steps > 0;
    };
    // Where nothing is known but the end, the anchor stands.
    for (NodeIndex j = 0; j < size_; ++j) {
      if (!has_path(j)) scores[Position(j)] += constant;
    }
    VisitAnchors(
        way, has_path,
        [&](NodeIndex j, const StateVector<D>& difference,
            const StateMatrix<D>& covariance) {
          double& score = scores[Position(j)];
          ShapeMatch& match = result_.matches_[way][Position(j)];
          const StateMatrix<D> smoothed =
              covariance - certainties[static_cast<std::size_t>(match.steps)];
          std::optional<QuadraticForm> terms;
          // An end that is itself about as certain as its path makes it is
          // better judged by itself: what is left would be rounding, or less.
          if (Evaluate<D>(smoothed - kLeastUncertaintyLeft * covariance,
                          difference)) {
            terms = Evaluate<D>(
                smoothed,
                difference + to_frame * end_drifts_[way][Position(j)]);
          }
          if (!terms) terms = Evaluate<D>(covariance, difference);
          if (!terms) {
            score = kImpossible;
            return;
          }
          match.squared_end_difference = terms->squared_mahalanobis;
          score = -0.5 * (terms->squared_mahalanobis + terms->log_determinant) +
                  weight_ * match.log_likelihood_ratio + constant;
        });
  }

  // Nodes of one road, next to each other.
  bool Joined(NodeIndex i, NodeIndex next) const {
    return next >= 0 && next < size_ && joined_[Position(std::max(i, next))];
  }

  // Paths that keep step with the recent one, which come first: slips seldom
  // beat them.
  void WalkOn(std::int64_t t, const Survivor& survivor) {
    const std::size_t way = survivor.way;
    const NodeIndex next = survivor.node + Stride(way);
    if (Joined(survivor.node, next)) {
      Try(t, survivor, survivor.frame, way, next, kOn);
    }
  }

  void Slip(std::int64_t t, const Survivor& survivor) {
    const NodeIndex i = survivor.node;
    const std::size_t way = survivor.way;
    // Were there no innovation.
    const double most =
        survivor.total + weight_ * (filter_.Surprise(t) - kSlipCost);
    const auto hopeless = [&](NodeIndex to) {
      const std::int32_t slot = next_slot_[way][Position(to)];
      return slot != kNoSlot &&
             !(most > next_[static_cast<std::size_t>(slot)].total);
    };
    if (!hopeless(i)) Try(t, survivor, survivor.frame, way, i, kStay);
    const NodeIndex next = i + Stride(way);
    const NodeIndex after = next + Stride(way);
    if (Joined(i, next) && Joined(next, after) && !hopeless(after)) {
      Try(t, survivor, survivor.frame, way, after, kSkip);
    }
  }

  void WalkOverLoops(std::int64_t t, const Survivor& survivor) {
    const NodeIndex i = survivor.node;
    const std::size_t way = survivor.way;
    for (const NodeIndex far : graph_.LoopNeighbours(i)) {
      if (far >= size_) continue;
      const std::size_t far_way = WayBeyond(graph_, i, far, way);
      const NodeIndex beyond = far + Stride(far_way);
      if (!Joined(far, beyond)) continue;
      // The far node is where this one is, and is seen as this one is.
      const StateVector<D> seen = SeenFrom(survivor.frame, i, way);
      const Pose pose = graph_.node(far).pose;
      Frame frame =
          MakeFrame(0.0, 0.0, 0.0, HeadingOf(far, far_way) - seen(D - 1));
      frame.x = pose.x - (frame.cosine * seen(0) - frame.sine * seen(1));
      frame.y = pose.y - (frame.sine * seen(0) + frame.cosine * seen(1));
      if constexpr (D == 4) frame.z = pose.z - seen(2);
      Try(t, survivor, frame, far_way, beyond, kOverLoop);
    }
  }

  // Walks a survivor to a node; it stays there if nothing better is.
  void Try(std::int64_t t, const Survivor& survivor, const Frame& frame,
           std::size_t way, NodeIndex to, Move move) {
    typename ShapeFilter<D>::Drift drift = survivor.drift;
    const auto evidence = filter_.Advance(t, SeenFrom(frame, to, way), &drift);
    // Written so that NaN fails too.
    if (!(evidence.squared_innovation <= kSquaredInnovationLimit)) return;
    const double gain = evidence.log_likelihood_ratio -
                        (move == kStay || move == kSkip ? kSlipCost : 0.0);
    const double total = survivor.total + weight_ * gain;
    std::int32_t& slot = next_slot_[way][Position(to)];
    if (slot == kNoSlot) {
      slot = static_cast<std::int32_t>(next_.size());
      next_.emplace_back();
    } else if (!(total > next_[static_cast<std::size_t>(slot)].total)) {
      return;
    }
    Survivor& there = next_[static_cast<std::size_t>(slot)];
    there = survivor;
    there.node = static_cast<std::int32_t>(to);
    there.way = static_cast<std::uint8_t>(way);
    there.frame = frame;
    there.drift = drift;
    there.log_likelihood_ratio += gain;
    there.squared_innovations += evidence.squared_innovation;
    there.total = total;

    std::vector<std::uint8_t>& moves = result_.moves_[way];
    if (moves.empty()) {
      moves.resize(static_cast<std::size_t>((filter_.size() - 1) * size_));
    }
    const auto position = static_cast<std::size_t>((t - 1) * size_ + to);
    moves[position] = move;
    if (move == kOverLoop) {
      result_.over_loops_[way][position] = {survivor.node,
                                            DirectionOf(survivor.way)};
    }
  }

  // Where a path has become better than it ever was, its end is credited.
  void Credit(std::int64_t t, const Survivor& survivor) {
    ShapeMatch& match =
        result_.matches_[survivor.end_way][Position(survivor.end)];
    if (!(survivor.log_likelihood_ratio > match.log_likelihood_ratio)) return;
    match.log_likelihood_ratio = survivor.log_likelihood_ratio;
    match.squared_innovations = survivor.squared_innovations;
    end_drifts_[survivor.end_way][Position(survivor.end)] =
        survivor.drift.at_end;
    match.steps = static_cast<std::int32_t>(t);
    match.last = survivor.node;
    match.last_direction = DirectionOf(survivor.way);
  }

  const PoseGraph& graph_;
  const RelativeModel& model_;
  const NodeIndex query_;
  const NodeIndex size_;
  const double weight_;
  const ShapeFilter<D> filter_;
  std::optional<KnownDrift<D>> known_drift_;
  // Whether node i has an edge to node i - 1.
  std::vector<char> joined_;
  bool has_loops_ = false;
  // Of all paths that reach one node at one step, walking one way, the best.
  std::vector<Survivor> survivors_;
  std::vector<Survivor> next_;
  // Where the survivor of a node is in next_, by way.
  std::array<std::vector<std::int32_t>, 2> next_slot_;
  // a of the best path of each end, in the axes of the vehicle at the query.
  std::array<std::vector<StateVector<D>>, 2> end_drifts_;
  RelativeAlignment result_;
};

std::vector<std::pair<std::int64_t, NodeIndex>> RelativeAlignment::Path(
    Direction direction, NodeIndex j) const {
  const ShapeMatch& best = match(direction, j);
  std::vector<std::pair<std::int64_t, NodeIndex>> path;
  NodeIndex node = best.last;
  std::size_t way = IndexOf(best.last_direction);
  for (std::int64_t t = best.steps; t > 0; --t) {
    path.emplace_back(t, node);
    const auto position = static_cast<std::size_t>((t - 1) * size_ + node);
    switch (static_cast<Move>(moves_[way][position])) {
      case kOn:
        node -= Stride(way);
        break;
      case kSkip:
        node -= 2 * Stride(way);
        break;
      case kOverLoop: {
        const auto& [near, direction_before] = over_loops_[way].at(position);
        node = near;
        way = IndexOf(direction_before);
        break;
      }
      case kStay:
        break;
      case kNone:
        assert(false);
        break;
    }
  }
  path.emplace_back(0, node);
  std::reverse(path.begin(), path.end());
  return path;
}

std::optional<RelativeAlignment> AlignRelative(
    const PoseGraph& graph, const RelativeModel& model, NodeIndex query,
    std::int64_t steps, NodeIndex history_size, const ShouldStop& should_stop) {
  assert(1 <= steps && steps <= query + 1);
  assert(history_size <= query - steps + 1);
  const auto align = [&](auto aligner) -> std::optional<RelativeAlignment> {
    if (!aligner->Run(should_stop)) return std::nullopt;
    return aligner->Finish();
  };
  if (model.similarity.state_space == StateSpace::kPlanar) {
    RelativeAligner<3> aligner(graph, model, query, steps, history_size);
    return align(&aligner);
  }
  RelativeAligner<4> aligner(graph, model, query, steps, history_size);
  return align(&aligner);
}

}  // namespace revisit::core
