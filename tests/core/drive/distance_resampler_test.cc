#include "core/drive/distance_resampler.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <Eigen/Cholesky>
#include <cmath>
#include <vector>

#include "core/drive/findings.h"
#include "core/drive/pose_graph.h"
#include "core/geometry/heading.h"
#include "core/geometry/pose.h"
#include "core/geometry/state_matrix.h"
#include "tests/core/graphs.h"
#include "tests/random.h"

namespace revisit::core {
namespace {

PoseSample Sample(std::uint64_t sequence, double x, double y = 0.0,
                  double heading = 0.0) {
  PoseSample sample;
  sample.sequence = sequence;
  sample.pose = {x, y, 0.0, heading};
  for (int i = 0; i < 4; ++i) sample.covariance(i, i) = 1.0;
  return sample;
}

struct Resampled {
  PoseGraph graph;
  std::vector<Jump> jumps;
  double travelled_meters = 0.0;
};

Resampled Resample(const std::vector<PoseSample>& samples,
                   const ResamplerOptions& options = {}) {
  Resampled result;
  DistanceResampler resampler(options);
  for (const PoseSample& sample : samples) {
    if (const auto jump = resampler.Add(sample, &result.graph)) {
      result.jumps.push_back(*jump);
    }
  }
  result.travelled_meters = resampler.travelled_meters();
  return result;
}

TEST(DistanceResamplerTest, InterpolatesBetweenPosesFartherApartThanSpacing) {
  std::vector<PoseSample> samples = {Sample(1, 0.0), Sample(2, 5.0)};
  samples[0].stamp_ns = 1'000'000'000;
  samples[1].stamp_ns = 2'000'000'000;
  samples[1].covariance(0, 0) = 6.0;
  samples[1].covariance(0, 3) = 0.5;
  const PoseGraph graph = Resample(samples).graph;
  ASSERT_EQ(graph.size(), 3);
  const Node& node = graph.node(1);
  EXPECT_EQ(node.sequence, 1u);
  EXPECT_DOUBLE_EQ(node.fraction, 0.4);
  EXPECT_EQ(node.stamp_ns, 1'400'000'000);
  EXPECT_DOUBLE_EQ(node.travelled_meters, 2.0);
  EXPECT_DOUBLE_EQ(node.pose.x, 2.0);
  EXPECT_DOUBLE_EQ(node.covariance(0, 0), 0.6 * 1.0 + 0.4 * 6.0);
  EXPECT_DOUBLE_EQ(node.covariance(0, 3), 0.4 * 0.5);
}

TEST(DistanceResamplerTest, ANodeOnAPoseIsThatPose) {
  const PoseGraph graph =
      Resample({Sample(1, 0.0), Sample(2, 2.0), Sample(3, 4.0)}).graph;
  ASSERT_EQ(graph.size(), 3);
  EXPECT_EQ(graph.node(2).sequence, 3u);
  EXPECT_EQ(graph.node(2).fraction, 0.0);
  EXPECT_EQ(graph.node(2).stamp_ns, std::nullopt);
}

TEST(DistanceResamplerTest, HeadingTakesTheShorterArc) {
  const PoseGraph graph = Resample({Sample(1, 0.0, 0.0, kPi - 0.1),
                                    Sample(2, 4.0, 0.0, -kPi + 0.3)})
                              .graph;
  ASSERT_EQ(graph.size(), 3);
  EXPECT_NEAR(graph.node(1).pose.heading, -kPi + 0.1, 1e-12);
}

TEST(DistanceResamplerTest, SpacingIsEvenAtAnyRate) {
  std::mt19937_64 random = SeededRandom();
  for (double step : {0.15, 0.7, 2.0, 3.3, 17.0}) {
    std::vector<PoseSample> samples;
    for (std::uint64_t i = 1; i <= 400; ++i) {
      samples.push_back(Sample(i, static_cast<double>(i) * step +
                                      Uniform(random, -0.1, 0.1) * step));
    }
    const Resampled result = Resample(samples);
    ASSERT_EQ(result.graph.size(),
              static_cast<NodeIndex>(result.travelled_meters / 2.0) + 1);
    for (NodeIndex i = 0; i < result.graph.size(); ++i) {
      EXPECT_NEAR(result.graph.node(i).pose.x - samples[0].pose.x,
                  2.0 * static_cast<double>(i), 0.11)
          << "step " << step << " node " << i;
      EXPECT_DOUBLE_EQ(result.graph.node(i).travelled_meters,
                       2.0 * static_cast<double>(i));
    }
  }
}

TEST(DistanceResamplerTest, TheSameRoadGivesTheSameNodesAtAnotherRate) {
  // A quarter circle: chords are shorter than arcs, by little at these rates.
  const auto drive = [](int poses) {
    std::vector<PoseSample> samples;
    for (int i = 0; i <= poses; ++i) {
      const double angle = 0.5 * kPi * i / poses;
      samples.push_back(Sample(static_cast<std::uint64_t>(i) + 1,
                               100.0 * std::sin(angle),
                               100.0 - 100.0 * std::cos(angle), angle));
    }
    return Resample(samples).graph;
  };
  const PoseGraph sparse = drive(30);
  const PoseGraph dense = drive(3000);
  ASSERT_EQ(sparse.size(), dense.size());
  for (NodeIndex i = 0; i < sparse.size(); ++i) {
    const Pose d = Difference(sparse.node(i).pose, dense.node(i).pose);
    EXPECT_LT(std::hypot(d.x, d.y), 0.05);
    EXPECT_LT(std::abs(d.heading), 0.001);
  }
}

TEST(DistanceResamplerTest, StandingStillAddsNothing) {
  std::mt19937_64 random = SeededRandom();
  std::vector<PoseSample> samples = {Sample(1, 0.0), Sample(2, 3.0)};
  for (std::uint64_t i = 3; i < 2000; ++i) {
    samples.push_back(Sample(i, 3.0 + Uniform(random, -0.04, 0.04),
                             Uniform(random, -0.04, 0.04)));
  }
  const Resampled result = Resample(samples);
  EXPECT_EQ(result.graph.size(), 2);
  EXPECT_DOUBLE_EQ(result.travelled_meters, 3.0);
}

TEST(DistanceResamplerTest, AfterAStandstillTheNodeIsTimedFromTheDeparture) {
  std::vector<PoseSample> samples = {Sample(1, 0.0), Sample(2, 0.0),
                                     Sample(3, 4.0)};
  samples[0].stamp_ns = 0;
  samples[1].stamp_ns = 60'000'000'000;
  samples[2].stamp_ns = 61'000'000'000;
  const PoseGraph graph = Resample(samples).graph;
  ASSERT_EQ(graph.size(), 3);
  EXPECT_EQ(graph.node(1).sequence, 2u);
  EXPECT_EQ(graph.node(1).stamp_ns, 60'500'000'000);
}

TEST(DistanceResamplerTest, AJumpIsReportedAndNotBridged) {
  const Resampled result = Resample(
      {Sample(1, 0.0), Sample(2, 3.0), Sample(3, 500.0), Sample(4, 503.0)});
  ASSERT_EQ(result.jumps.size(), 1u);
  EXPECT_EQ(result.jumps[0].sequence, 3u);
  EXPECT_DOUBLE_EQ(result.jumps[0].distance_meters, 497.0);
  ASSERT_EQ(result.graph.size(), 4);
  EXPECT_EQ(result.graph.SegmentStart(1), 0);
  EXPECT_EQ(result.graph.SegmentStart(2), 2);
  EXPECT_DOUBLE_EQ(result.graph.node(2).pose.x, 500.0);
  EXPECT_DOUBLE_EQ(result.graph.node(2).travelled_meters, 3.0);
  EXPECT_DOUBLE_EQ(result.graph.node(3).travelled_meters, 5.0);
  EXPECT_DOUBLE_EQ(result.travelled_meters, 6.0);
}

TEST(DistanceResamplerTest, InterpolatedCovariancesStayPositiveDefinite) {
  std::mt19937_64 random = SeededRandom();
  std::vector<PoseSample> samples;
  for (std::uint64_t i = 1; i <= 200; ++i) {
    PoseSample sample = Sample(i, static_cast<double>(i) * 7.3);
    sample.covariance = RandomCovariance(random, 5.0);
    samples.push_back(sample);
  }
  ResamplerOptions options;
  options.state_space = StateSpace::kSpatial;
  const PoseGraph graph = Resample(samples, options).graph;
  for (NodeIndex i = 0; i < graph.size(); ++i) {
    EXPECT_EQ(ToMatrix<4>(graph.node(i).covariance).llt().info(),
              Eigen::Success);
  }
}

TEST(DistanceResamplerTest, TransitionsMultiplyUpOverPosesAndNodes) {
  // Whatever falls between two nodes, the product from the first to the last
  // node is the product over the poses between them.
  std::mt19937_64 random = SeededRandom();
  for (double step : {0.5, 2.0, 6.5}) {
    std::vector<PoseSample> samples;
    const int poses = 40;
    Eigen::Matrix4d product = Eigen::Matrix4d::Identity();
    for (int i = 0; i <= poses; ++i) {
      PoseSample sample = Sample(static_cast<std::uint64_t>(i) + 1, step * i);
      if (i > 0) {
        Eigen::Matrix4d matrix = 0.98 * Eigen::Matrix4d::Identity();
        for (int k = 0; k < 16; ++k) matrix(k) += Normal(random, 0.01);
        sample.transition = ToErrorTransition<4>(matrix);
        product = matrix * product;
      }
      samples.push_back(sample);
    }
    ResamplerOptions options;
    options.state_space = StateSpace::kSpatial;
    options.carry_transitions = true;
    const PoseGraph graph = Resample(samples, options).graph;
    // 0.5 * 40, 2 * 40 and 6.5 * 40 are multiples of the spacing.
    ASSERT_EQ(graph.node(graph.size() - 1).sequence, samples.back().sequence);
    Eigen::Matrix4d over_nodes = Eigen::Matrix4d::Identity();
    for (NodeIndex i = 1; i < graph.size(); ++i) {
      over_nodes = ToMatrix<4>(graph.transition(i)) * over_nodes;
    }
    EXPECT_LT((over_nodes - product).norm(), 1e-12 * product.norm()) << step;
  }
}

}  // namespace
}  // namespace revisit::core
