// Random graphs for the core's tests.
#ifndef REVISIT_TESTS_CORE_GRAPHS_H_
#define REVISIT_TESTS_CORE_GRAPHS_H_

#include <Eigen/Core>
#include <cmath>
#include <memory>
#include <random>
#include <vector>

#include "core/drive/confirmed_loop.h"
#include "core/drive/pose_graph.h"
#include "core/geometry/heading.h"
#include "core/geometry/pose.h"
#include "core/geometry/state_matrix.h"
#include "tests/random.h"

namespace revisit::core {

// A random covariance with standard deviations up to about `scale` metres and a
// twentieth of that in radians, of any correlation.
inline Covariance RandomCovariance(std::mt19937_64& random, double scale) {
  Eigen::Matrix4d root;
  for (int i = 0; i < 16; ++i) root(i) = Normal(random, 0.5);
  root += 0.3 * Eigen::Matrix4d::Identity();
  const Eigen::Vector4d units(scale, scale, scale, scale / 20.0);
  const Eigen::Matrix4d scaled = units.asDiagonal() * root;
  return ToCovariance<4>(scaled * scaled.transpose());
}

inline Pose RandomPose(std::mt19937_64& random, double extent) {
  return {Uniform(random, -extent, extent), Uniform(random, -extent, extent),
          Uniform(random, -extent, extent) / 10.0, Uniform(random, -kPi, kPi)};
}

// A graph of unrelated random nodes.
inline PoseGraph RandomGraph(std::mt19937_64& random, NodeIndex size,
                             double new_segment_probability, int loop_edges,
                             bool transitions) {
  PoseGraph graph;
  for (NodeIndex i = 0; i < size; ++i) {
    Node node;
    node.sequence = static_cast<std::uint64_t>(i) + 1;
    node.travelled_meters = 2.0 * static_cast<double>(i);
    node.pose = RandomPose(random, 5.0);
    // Grows, as a filter's does, so that correlated differences stay positive
    // definite.
    node.covariance = RandomCovariance(random, 2.0);
    std::optional<ErrorTransition> transition;
    if (transitions) {
      Eigen::Matrix4d matrix = 0.9 * Eigen::Matrix4d::Identity();
      for (int k = 0; k < 16; ++k) matrix(k) += Normal(random, 0.05);
      transition = ToErrorTransition<4>(matrix);
    }
    graph.AddNode(node,
                  i == 0 || Uniform(random, 0.0, 1.0) < new_segment_probability,
                  transition);
  }
  for (int e = 0; e < loop_edges; ++e) {
    const auto a = static_cast<NodeIndex>(
        UniformInt(random, 0, static_cast<int>(size) - 1));
    const auto b = static_cast<NodeIndex>(
        UniformInt(random, 0, static_cast<int>(size) - 1));
    if (a != b) graph.AddLoopEdge(a, b);
  }
  return graph;
}

// A measurement between two poses: as they are estimated, up to `noise` metres
// and a twentieth of that in radians, with a covariance that is as large.
inline std::shared_ptr<const MeasuredLoop> RandomMeasurement(
    std::mt19937_64& random, const PoseEstimate& query,
    const PoseEstimate& matched, double noise) {
  MeasuredLoop loop;
  loop.query = query;
  loop.matched = matched;
  loop.measurement.covariance = RandomCovariance(random, noise);
  const double c = std::cos(matched.pose.heading);
  const double s = std::sin(matched.pose.heading);
  const Pose apart = Difference(query.pose, matched.pose);
  loop.measurement.relative = {
      c * apart.x + s * apart.y + Normal(random, noise),
      c * apart.y - s * apart.x + Normal(random, noise),
      apart.z + Normal(random, noise),
      apart.heading + Normal(random, noise / 20.0)};
  return std::make_shared<const MeasuredLoop>(loop);
}

inline PoseEstimate EstimateAt(const PoseGraph& graph, NodeIndex i) {
  return {graph.pose(i), graph.covariance(i)};
}

}  // namespace revisit::core

#endif  // REVISIT_TESTS_CORE_GRAPHS_H_
