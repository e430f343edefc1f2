// Random towns, for tests of searches.
#ifndef REVISIT_TESTS_CORE_SEARCH_ALIGNMENT_TOWNS_H_
#define REVISIT_TESTS_CORE_SEARCH_ALIGNMENT_TOWNS_H_

#include <Eigen/Core>
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <random>
#include <sstream>
#include <string>
#include <vector>

#include "core/drive/confirmed_loop.h"
#include "core/drive/frame_relation.h"
#include "core/drive/pose_graph.h"
#include "core/geometry/frame_transform.h"
#include "core/geometry/heading.h"
#include "core/geometry/pose.h"
#include "core/geometry/state_matrix.h"
#include "core/search/alignment/relation.h"
#include "core/search/alignment/relative.h"
#include "tests/core/graphs.h"
#include "tests/random.h"

namespace revisit::core {

// A road as a pose every quarter of a metre.
using Road = std::vector<Pose>;

constexpr double kRoadStep = 0.25;

inline Road RandomRoad(std::mt19937_64& random, double meters,
                       double curvature) {
  Road road;
  Pose pose = RandomPose(random, 20.0);
  double bend = 0.0;
  double slope = 0.0;
  for (double s = 0.0; s <= meters; s += kRoadStep) {
    road.push_back(pose);
    if (UniformInt(random, 0, 24) == 0) bend = Normal(random, curvature);
    if (UniformInt(random, 0, 24) == 0) slope = Normal(random, 0.05);
    pose.heading += bend * kRoadStep;
    pose.x += kRoadStep * std::cos(pose.heading);
    pose.y += kRoadStep * std::sin(pose.heading);
    pose.z += kRoadStep * slope;
  }
  return road;
}

inline const Pose& At(const Road& road, double along) {
  const auto k = static_cast<std::int64_t>(std::llround(along / kRoadStep));
  return road[static_cast<std::size_t>(std::clamp<std::int64_t>(
      k, 0, static_cast<std::int64_t>(road.size()) - 1))];
}

struct Pass {
  NodeIndex first = 0;
  NodeIndex nodes = 0;
  double start = 0.0;
  // Distance along the road from node to node, signed.
  double stride = 0.0;
  // Number of nodes missing before node first + slip_at; if negative, nodes are
  // repeated there.
  int slip = 0;
  NodeIndex slip_at = 0;

  double Along(NodeIndex i) const {
    const NodeIndex k = i - first;
    return start + stride * static_cast<double>(k >= slip_at ? k + slip : k);
  }
};

struct Town {
  PoseGraph graph;
  std::vector<Pass> passes;
  RelativeModel model;
  NodeIndex query = 0;
  std::int64_t steps = 0;
  // The history is nodes [first, history), related to the query like this.
  NodeIndex history = 0;
  NodeIndex first = 0;
  Relation relation;

  Query Asked() const { return {graph, query, steps}; }
  History Past() const {
    History past{graph, history};
    past.first = first;
    past.relation = relation;
    return past;
  }
  FrameNodes Frames() const {
    return {graph, model.similarity.state_space, model.similarity.correlation};
  }

  std::string Text() const {
    std::ostringstream text;
    text << graph.size() << " nodes, query " << query << ", " << steps
         << " steps, passes";
    for (const Pass& pass : passes) {
      text << " " << pass.first << "+" << pass.nodes << " at " << pass.start
           << " by " << pass.stride;
    }
    text << ", loops";
    for (const auto& [a, b] : graph.LoopEdges()) text << " " << a << "-" << b;
    text << ", model " << static_cast<int>(model.similarity.correlation.model)
         << (model.similarity.state_space == StateSpace::kPlanar ? " planar"
                                                                 : " spatial");
    return text.str();
  }
};

// Gives the model uncertain scales and drifts, or either, or none.
inline void BelieveAnything(std::mt19937_64& random, Town* town) {
  const int scales = UniformInt(random, 0, 1) ? UniformInt(random, 1, 4) : 0;
  for (int k = 0; k < scales; ++k) {
    town->model.scales.push_back(
        {std::exp(Uniform(random, -2.0, 2.0)),
         std::log(Uniform(random, 0.0, 2.0) / scales)});
  }
  const int drifts = UniformInt(random, 0, 1) ? UniformInt(random, 1, 2) : 0;
  const auto last = static_cast<int>(town->query);
  for (int k = 0; k < drifts && last > 0; ++k) {
    WeighedDrift drift;
    const int pairs = UniformInt(random, 1, 3);
    for (int pair = 0; pair < pairs; ++pair) {
      const NodeIndex c = UniformInt(random, 1, last);
      const NodeIndex m = UniformInt(random, 0, static_cast<int>(c) - 1);
      drift.pairs.push_back({c, m, nullptr});
    }
    std::sort(drift.pairs.begin(), drift.pairs.end(),
              [](const ConfirmedLoop& a, const ConfirmedLoop& b) {
                return a.query < b.query;
              });
    drift.reach.first = UniformInt(random, 0, last);
    drift.reach.last = drift.reach.first + UniformInt(random, 1, last);
    drift.log_weight = std::log(Uniform(random, 0.0, 1.0) / drifts);
    town->model.drifts.push_back(drift);
  }
}

// Passes of a road, either way, each in a frame of its own, with odometers that
// differ, and with true and false loop closures. The last pass is the recent
// path. The number of nodes is some 50 times the scale.
inline Town RandomTown(std::mt19937_64& random, int scale = 1) {
  Town town;
  // Many passes of the same few metres, with closures all over.
  const bool crowded = UniformInt(random, 0, 3) == 0;
  const double spacing = Uniform(random, 1.0, 4.0);
  // Odometers that disagree, without any other error that could explain it.
  const bool slippery = !crowded && UniformInt(random, 0, 3) == 0;
  const double length =
      scale * (slippery ? 40.0 : (crowded ? 14.0 : 24.0)) * spacing;
  // The longer the road, the straighter, so that it leads away.
  const Road road = RandomRoad(random, length, 0.1 / std::sqrt(scale));
  RelativeModel& model = town.model;
  model.similarity.state_space =
      UniformInt(random, 0, 1) ? StateSpace::kPlanar : StateSpace::kSpatial;
  model.similarity.correlation = {
      static_cast<CorrelationModel>(UniformInt(random, 0, 3)),
      std::exp(Uniform(random, std::log(5.0), std::log(300.0)))};
  model.similarity.tolerance = {Uniform(random, 0.5, 4.0),
                                Uniform(random, 0.05, 0.4)};
  model.similarity.inflation =
      UniformInt(random, 0, 1) ? 1.0 : Uniform(random, 1.0, 2.0);
  model.shape.tolerance = {Uniform(random, 0.2, 1.5),
                           Uniform(random, 0.02, 0.15)};
  model.shape.correlation_meters = Uniform(random, 1.0, 20.0);
  model.spacing_meters = spacing;
  model.road_spacing_meters = Uniform(random, 20.0, 500.0);
  const int directions = UniformInt(random, 0, 2);
  model.same_direction = directions != 1;
  model.opposite_direction = directions != 0;

  if (slippery) {
    model.shape.tolerance.position_meters = Uniform(random, 0.1, 0.3) * spacing;
    model.similarity.inflation = 1.0;
  }

  Eigen::Matrix4d covariance =
      Eigen::Vector4d(0.04, 0.04, 0.04, 1e-4).asDiagonal();
  const double noise = slippery ? 1e-3 : Uniform(random, 0.01, 0.2);
  const int passes =
      crowded ? UniformInt(random, 5, 7) : UniformInt(random, 2, 4);
  for (int p = 0; p < passes; ++p) {
    const bool last = p + 1 == passes;
    Pass pass;
    pass.first = town.graph.size();
    pass.nodes = slippery ? UniformInt(random, 18 * scale, 30 * scale)
                          : UniformInt(random, (last ? 3 : 6) * scale,
                                       (crowded ? 10 : 14) * scale);
    pass.stride =
        spacing *
        (UniformInt(random, 0, 2) == 0 ? Uniform(random, 0.85, 1.15) : 1.0);
    pass.start = Uniform(
        random, 0.0,
        std::max(0.0, length - pass.stride * static_cast<double>(pass.nodes)));
    if (UniformInt(random, 0, 2) == 0) {
      pass.start += pass.stride * static_cast<double>(pass.nodes - 1);
      pass.stride = -pass.stride;
    }
    if (slippery) {
      pass.slip = UniformInt(random, -1, 1);
      pass.slip_at = UniformInt(random, 1, static_cast<int>(pass.nodes) - 1);
    }
    // The drift between the passes.
    const Pose drift = {Normal(random, 2.0), Normal(random, 2.0),
                        Normal(random, 0.5), Normal(random, 0.1 / scale)};
    const bool jump = p == 0 || UniformInt(random, 0, 3) > 0;
    for (NodeIndex k = 0; k < pass.nodes; ++k) {
      const Pose& on_road = At(road, pass.Along(pass.first + k));
      const double c = std::cos(drift.heading);
      const double s = std::sin(drift.heading);
      Node node;
      node.sequence = static_cast<std::uint64_t>(town.graph.size()) + 1;
      node.travelled_meters = spacing * static_cast<double>(town.graph.size());
      node.pose = {
          c * on_road.x - s * on_road.y + drift.x + Normal(random, 0.1),
          s * on_road.x + c * on_road.y + drift.y + Normal(random, 0.1),
          on_road.z + drift.z + Normal(random, 0.02),
          WrapHeading(on_road.heading + drift.heading +
                      (pass.stride < 0.0 ? kPi : 0.0) + Normal(random, 0.01))};
      const NodeIndex i = town.graph.size();
      Eigen::Matrix4d transition = Eigen::Matrix4d::Identity();
      if (i > 0) {
        if (model.similarity.correlation.model == CorrelationModel::kFilter) {
          transition *= 0.95;
          for (int m = 0; m < 16; ++m) transition(m) += Normal(random, 0.01);
        } else {
          const Pose& before = town.graph.node(i - 1).pose;
          transition(0, 3) = -(node.pose.y - before.y);
          transition(1, 3) = node.pose.x - before.x;
        }
        covariance = (transition * covariance * transition.transpose()).eval() +
                     ToMatrix<4>(RandomCovariance(random, noise));
      }
      node.covariance = ToCovariance<4>(covariance);
      town.graph.AddNode(node, k == 0 && jump,
                         ToErrorTransition<4>(transition));
    }
    town.passes.push_back(pass);
  }

  const Pass& recent = town.passes.back();
  town.query = town.graph.size() - 1 - UniformInt(random, 0, 1);
  const NodeIndex start = town.graph.SegmentStart(town.query);
  town.steps = UniformInt(random, 2,
                          static_cast<int>(std::min<NodeIndex>(
                              (slippery ? 18 : 11) + 2 * (scale - 1),
                              town.query - std::max(start, recent.first) + 1)));
  town.history = town.query - town.steps + 1;

  for (std::size_t a = 0; a < town.passes.size(); ++a) {
    for (std::size_t b = 0; b < a; ++b) {
      for (int e = UniformInt(random, 0, crowded ? 4 : 2); e > 0; --e) {
        // Where the two are nearest to each other on the road.
        const Pass& of_a = town.passes[a];
        const Pass& of_b = town.passes[b];
        const NodeIndex i =
            of_a.first +
            UniformInt(random, 0, static_cast<int>(of_a.nodes) - 1);
        NodeIndex nearest = of_b.first;
        for (NodeIndex j = of_b.first; j < of_b.first + of_b.nodes; ++j) {
          if (std::abs(of_b.Along(j) - of_a.Along(i)) <
              std::abs(of_b.Along(nearest) - of_a.Along(i))) {
            nearest = j;
          }
        }
        if (std::abs(of_b.Along(nearest) - of_a.Along(i)) > spacing) continue;
        town.graph.AddLoopEdge(i, nearest);
        if (model.similarity.correlation.model ==
                CorrelationModel::kDeadReckoning &&
            i <= town.query && UniformInt(random, 0, 1)) {
          model.last_confirmed = ConfirmedLoop{i, nearest, nullptr};
          if (UniformInt(random, 0, 1)) {
            model.last_confirmed->measured = RandomMeasurement(
                random, EstimateAt(town.graph, i),
                EstimateAt(town.graph, nearest), Uniform(random, 0.1, 1.0));
          }
        }
      }
    }
  }
  if (UniformInt(random, 0, 2) == 0) {
    const auto any = [&] {
      return static_cast<NodeIndex>(
          UniformInt(random, 0, static_cast<int>(town.graph.size()) - 1));
    };
    const NodeIndex a = any();
    const NodeIndex b = any();
    if (a != b) town.graph.AddLoopEdge(a, b);
  }
  if (model.similarity.correlation.model == CorrelationModel::kDeadReckoning) {
    BelieveAnything(random, &town);
  }
  return town;
}

// How the frame that lies at T truly may be tied, if at all.
inline FrameRelation RandomTie(std::mt19937_64& random, const Town& town,
                               const Pose& transform) {
  FrameRelation tie;
  tie.state = static_cast<FrameState>(UniformInt(random, 1, 5));
  if (!tie.is_tied()) return tie;
  tie.transform = transform;
  tie.transform.x += Normal(random, 2.0);
  tie.transform.y += Normal(random, 2.0);
  tie.transform.heading =
      WrapHeading(tie.transform.heading + Normal(random, 0.05));
  const bool planar = town.model.similarity.state_space == StateSpace::kPlanar;
  const auto anything = [&](double deviation) {
    StateMatrix<4> matrix = ToMatrix<4>(RandomCovariance(random, deviation));
    if (planar) {
      matrix.row(2).setZero();
      matrix.col(2).setZero();
    }
    return matrix;
  };
  tie.fixed = anything(Uniform(random, 0.3, 4.0));
  if (UniformInt(random, 0, 1)) tie.drift = anything(0.5);
  const NodeIndex m = UniformInt(random, static_cast<int>(town.first),
                                 static_cast<int>(town.history) - 1);
  tie.place = town.graph.pose(m);
  if (town.Frames().have_references()) {
    tie.other_node = m;
    tie.asking_node =
        town.query - UniformInt(random, 0, static_cast<int>(town.steps) - 1);
  }
  return tie;
}

// Makes the history another recording: moves its nodes to a frame of their own,
// and leaves out the nodes between it and the recent path. False where it is
// too short.
inline bool MoveApart(std::mt19937_64& random, Town* town) {
  const NodeIndex start = town->query - town->steps + 1;
  town->history = start - UniformInt(random, 0, 2);
  if (town->history < 4) return false;
  town->first = UniformInt(random, 0, 2) == 0
                    ? UniformInt(random, 0, static_cast<int>(town->history) / 2)
                    : 0;
  // T, the pose of the history's frame.
  const Pose transform = RandomPose(random, 100.0);
  const StateMatrix<4> back = TurnAbout<4>(-transform.heading);
  PoseGraph graph;
  for (NodeIndex i = 0; i < town->graph.size(); ++i) {
    Node node = town->graph.node(i);
    ErrorTransition transition = town->graph.transition(i);
    if (i < town->history) {
      node.pose = Compose(Inverse(transform), node.pose);
      node.covariance = ToCovariance<4>(back * ToMatrix<4>(node.covariance) *
                                        back.transpose());
      transition = ToErrorTransition<4>(back * ToMatrix<4>(transition) *
                                        back.transpose());
    }
    graph.AddNode(node,
                  i == town->first || i == town->history ||
                      town->graph.SegmentStart(i) == i,
                  transition);
  }
  for (const auto& [a, b] : town->graph.LoopEdges()) graph.AddLoopEdge(a, b);
  town->graph = graph;
  town->model.last_confirmed.reset();
  town->model.drifts.clear();
  const FrameRelation tie = RandomTie(random, *town, transform);
  std::vector<WeighedDrift> drifts;
  if (town->Frames().have_references() && UniformInt(random, 0, 1)) {
    const int count = UniformInt(random, 1, 2);
    for (int k = 0; k < count; ++k) {
      WeighedDrift drift;
      const NodeIndex c =
          start + UniformInt(random, 0, static_cast<int>(town->steps) - 1);
      const NodeIndex m = UniformInt(random, static_cast<int>(town->first),
                                     static_cast<int>(town->history) - 1);
      drift.pairs.push_back({c, m, nullptr});
      drift.reach.first = UniformInt(random, static_cast<int>(town->first),
                                     static_cast<int>(town->history) - 1);
      drift.reach.last = town->history;
      drift.log_weight = std::log(Uniform(random, 0.1, 1.0) / count);
      drifts.push_back(drift);
    }
  }
  town->relation = Relation(town->Frames(), tie, drifts);
  return true;
}

}  // namespace revisit::core

#endif  // REVISIT_TESTS_CORE_SEARCH_ALIGNMENT_TOWNS_H_
