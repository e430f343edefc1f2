// Drives that wander about by dead reckoning, with honest claims of any shape.
#ifndef REVISIT_TESTS_CORE_DRIVE_WANDERING_H_
#define REVISIT_TESTS_CORE_DRIVE_WANDERING_H_

#include <cmath>
#include <cstdint>
#include <random>
#include <vector>

#include "core/drive/pose_graph.h"
#include "core/geometry/heading.h"
#include "core/geometry/pose.h"
#include "core/geometry/state_matrix.h"
#include "core/noise/dead_reckoning.h"
#include "tests/core/graphs.h"
#include "tests/random.h"

namespace revisit::core {

// Wanders about, with the covariances of its dead reckoning: each pose, or
// nearly, becomes a node.
template <int D>
std::vector<PoseSample> WanderingSamples(std::mt19937_64& random, int poses) {
  std::vector<PoseSample> samples;
  Pose pose = RandomPose(random, 50.0);
  StateMatrix<D> covariance = ToMatrix<D>(RandomCovariance(random, 0.5));
  for (int i = 0; i < poses; ++i) {
    PoseSample sample;
    sample.sequence = static_cast<std::uint64_t>(i) + 1;
    if (i > 0) {
      const Pose before = pose;
      pose.heading = WrapHeading(pose.heading + Normal(random, 0.3));
      pose.x += 2.0 * std::cos(pose.heading);
      pose.y += 2.0 * std::sin(pose.heading);
      if (D == 4) pose.z += Normal(random, 0.1);
      const StateMatrix<D> psi = DeadReckoningTransition<D>(before, pose);
      covariance = (psi * covariance * psi.transpose()).eval() +
                   ToMatrix<D>(RandomCovariance(random, 0.4));
    }
    sample.pose = pose;
    sample.covariance = ToCovariance<D>(covariance);
    samples.push_back(sample);
  }
  return samples;
}

// A pose whose last node is this one; 0 if there is none.
inline std::uint64_t PoseAt(const PoseGraph& graph, NodeIndex i) {
  const std::uint64_t before = graph.node(i).sequence;
  for (const std::uint64_t sequence : {before, before + 1}) {
    if (graph.NodeAtOrBefore(sequence) == i) return sequence;
  }
  return 0;
}

}  // namespace revisit::core

#endif  // REVISIT_TESTS_CORE_DRIVE_WANDERING_H_
