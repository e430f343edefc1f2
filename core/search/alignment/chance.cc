#include "core/search/alignment/chance.h"

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <memory>
#include <optional>

#include "core/drive/frame_relation.h"
#include "core/geometry/heading.h"
#include "core/geometry/pose.h"
#include "core/geometry/state_matrix.h"
#include "core/noise/comparison.h"
#include "core/search/alignment/path_axes.h"
#include "core/search/alignment/path_walk.h"
#include "core/search/alignment/pose_table.h"
#include "core/search/alignment/recent_path.h"

namespace revisit::core {
namespace {

// By how many measured nodes one is fetched before it is looked at.
constexpr NodeIndex kFetchedAhead = 6;

double NormalDensity(double deviation, double variance) {
  return std::exp(-0.5 * deviation * deviation / variance) /
         std::sqrt(2.0 * kPi * variance);
}

// Sees the nodes of a history where the vehicle is not.
template <int D>
class Elsewhere {
 public:
  // REQUIRES: the history is another recording, and tied.
  Elsewhere(const Query& query, const History& history,
            const RelativeModel& model)
      : graph_(history.graph),
        pair_(history.relation.frames(), history.relation.tie(), query.node,
              model.similarity.inflation),
        tolerance_(StateMatrix<D>::Zero()),
        same_(model.same_direction),
        opposite_(model.opposite_direction) {
    AddTolerance<D>(model.similarity.tolerance, &tolerance_);
  }

  // The density of headings at the query's, per radian, were all roads to head
  // as the node's does; the mean of the directions that are searched. Nothing
  // where the vehicle may be.
  std::optional<double> HeadingDensity(NodeIndex j) const {
    const Pose pose = graph_.pose(j);
    const StateMatrix<D> gamma =
        pair_.Covariance(j, pose, ToMatrix<D>(graph_.covariance(j))) +
        tolerance_;
    const double x = pose.x - pair_.query().x;
    const double y = pose.y - pair_.query().y;
    if (x * x + y * y <=
        kSquaredElsewhere *
            VariancesInAnyDirection(gamma(0, 0), gamma(0, 1), gamma(1, 1))
                .most) {
      return std::nullopt;
    }
    return MeanDensity(
        pose.heading - pair_.query().heading,
        std::max(gamma(D - 1, D - 1),
                 kLeastHeadingDeviation * kLeastHeadingDeviation));
  }

 private:
  double MeanDensity(double difference, double variance) const {
    const double same =
        same_ ? NormalDensity(WrapHeading(difference), variance) : 0.0;
    const double opposite =
        opposite_ ? NormalDensity(WrapHeading(difference + kPi), variance)
                  : 0.0;
    return (same + opposite) / (same_ && opposite_ ? 2.0 : 1.0);
  }

  const PoseGraph& graph_;
  const FramePair<D> pair_;
  StateMatrix<D> tolerance_;
  const bool same_;
  const bool opposite_;
};

// The histories that are measured.
std::vector<const History*> Measured(const std::vector<History>& histories) {
  std::vector<const History*> tied;
  for (const History& history : histories) {
    if (!history.relation.is_own() && history.relation.tie().is_tied() &&
        history.size() > 0) {
      tied.push_back(&history);
    }
  }
  const std::size_t every =
      (tied.size() + kMostHistoriesMeasured - 1) / kMostHistoriesMeasured;
  std::vector<const History*> measured;
  for (std::size_t h = 0; h < tied.size(); h += every) {
    measured.push_back(tied[h]);
  }
  return measured;
}

// Gathers the ratios of nodes, each that of the best path back from it, and
// their headings.
template <int D>
class ChanceMeter {
 public:
  ChanceMeter(const Query& query, const RelativeModel& model,
              const RecentPath<D>& recent)
      : query_(query),
        model_(model),
        recent_(recent),
        axes_(recent, 0.0, 0.0) {}

  // Adds those of every `stride`-th node from `first` on.
  void Add(const History& history, NodeIndex first, NodeIndex stride) {
    std::vector<NodeIndex> ends;
    const Elsewhere<D> elsewhere(query_, history, model_);
    for (NodeIndex j = first; j < history.end; j += stride) {
      const NodeIndex ahead = j + kFetchedAhead * stride;
      if (ahead < history.end) history.graph.Prefetch(ahead);
      const std::optional<double> density = elsewhere.HeadingDensity(j);
      if (!density) continue;
      ends.push_back(j);
      heading_density_ += *density;
      ++nodes_;
    }
    if (ends.empty()) return;
    PoseTable table(history.graph, history.end);
    for (const Direction direction : {Direction::kSame, Direction::kOpposite}) {
      if (!(direction == Direction::kSame ? model_.same_direction
                                          : model_.opposite_direction)) {
        continue;
      }
      PathWalk<D> walk(history, recent_, axes_, direction, model_.over_loops,
                       &table);
      std::vector<WalkStart> starts;
      for (const NodeIndex j : ends) {
        starts.push_back({j, kImpossible, starts.size()});
        if (starts.size() == NodeBlock::kSize) Walk(&walk, &starts);
      }
      Walk(&walk, &starts);
    }
  }

  // The mean is over the nodes where the vehicle is not; at least 0.
  double LogMeanRatio() const {
    if (nats_.empty()) return 0.0;
    const auto count = static_cast<double>(nats_.size());
    const double most = std::log(count);
    double sum = 0.0;
    for (const double nats : nats_) sum += std::exp(std::min(nats, most));
    const double more = std::max(0.0, sum / count - 1.0);
    return std::log1p(kUnseenRatios * more);
  }

  // Tells how many times as many roads head as the query does as if all ways
  // were alike; at least 0.
  double LogShareOfHeading() const {
    if (nodes_ == 0) return 0.0;
    const double density = heading_density_ / static_cast<double>(nodes_);
    return std::log(std::max(1.0, 2.0 * kPi * density));
  }

 private:
  void Walk(PathWalk<D>* walk, std::vector<WalkStart>* starts) {
    const BestPaths& paths = walk->Walk(*starts, nullptr);
    for (const WalkStart& start : *starts) {
      nats_.push_back(recent_.weight() *
                          paths.log_likelihood_ratios[start.slot] -
                      recent_.filter().join_cost());
    }
    starts->clear();
  }

  const Query& query_;
  const RelativeModel& model_;
  const RecentPath<D>& recent_;
  const PathAxes<D> axes_;
  std::vector<double> nats_;
  double heading_density_ = 0.0;
  std::int64_t nodes_ = 0;
};

template <int D>
Chance MeasureChanceIn(const Query& query,
                       const std::vector<History>& histories,
                       const RelativeModel& model, AlignmentParts* parts) {
  const std::vector<const History*> measured = Measured(histories);
  NodeIndex nodes = 0;
  for (const History* history : measured) nodes += history->size();
  if (nodes == 0) return {};
  if (parts->path == nullptr) {
    parts->path = std::make_shared<const RecentPath<D>>(query, model);
  }
  const NodeIndex stride = (nodes + kMostMeasured - 1) / kMostMeasured;
  ChanceMeter<D> meter(
      query, model,
      *std::static_pointer_cast<const RecentPath<D>>(parts->path));
  NodeIndex before = 0;
  for (const History* history : measured) {
    meter.Add(*history, history->first + (stride - before % stride) % stride,
              stride);
    before += history->size();
  }
  return {meter.LogMeanRatio(), meter.LogShareOfHeading()};
}

}  // namespace

Chance MeasureChance(const Query& query, const std::vector<History>& histories,
                     const RelativeModel& model, AlignmentParts* parts) {
  AlignmentParts own;
  AlignmentParts* const kept = parts == nullptr ? &own : parts;
  return model.similarity.state_space == StateSpace::kPlanar
             ? MeasureChanceIn<3>(query, histories, model, kept)
             : MeasureChanceIn<4>(query, histories, model, kept);
}

}  // namespace revisit::core
