#include "core/search/alignment/similarity_kernel.h"

#include <gtest/gtest.h>

#include <Eigen/Cholesky>
#include <algorithm>
#include <cmath>
#include <vector>

#include "core/drive/confirmed_loop.h"
#include "core/drive/node_noise.h"
#include "core/drive/pose_graph.h"
#include "core/geometry/heading.h"
#include "core/geometry/quadratic_form.h"
#include "core/geometry/state_matrix.h"
#include "core/noise/similarity_model.h"
#include "core/search/alignment/known_drift.h"
#include "core/search/alignment/log_similarity.h"
#include "tests/core/graphs.h"
#include "tests/core/vector_targets.h"
#include "tests/random.h"

namespace revisit::core {
namespace {

// The entries of node i of a block.
template <int D>
StateVector<D> DifferenceAt(const DifferenceBlock& differences, std::size_t i) {
  StateVector<D> difference;
  for (int r = 0; r < D; ++r) {
    difference(r) = differences.difference[static_cast<std::size_t>(r)][i];
  }
  return difference;
}

template <int D>
StateMatrix<D> CovarianceAt(const DifferenceBlock& differences, std::size_t i) {
  StateMatrix<D> covariance;
  std::size_t entry = 0;
  for (int r = 0; r < D; ++r) {
    for (int c = 0; c <= r; ++c) {
      covariance(r, c) = covariance(c, r) = differences.covariance[entry++][i];
    }
  }
  return covariance;
}

template <int D>
void Put(const StateVector<D>& difference, const StateMatrix<D>& covariance,
         std::size_t i, DifferenceBlock* differences) {
  std::size_t entry = 0;
  for (int r = 0; r < D; ++r) {
    differences->difference[static_cast<std::size_t>(r)][i] = difference(r);
    for (int c = 0; c <= r; ++c) {
      differences->covariance[entry++][i] = covariance(r, c);
    }
  }
}

// Compares in units of the standard deviations, and headings up to whole turns.
template <int D>
void ExpectNear(const DifferenceBlock& differences, std::size_t i,
                const StateVector<D>& difference,
                const StateMatrix<D>& covariance, double tolerance) {
  const StateVector<D> off = DifferenceAt<D>(differences, i) - difference;
  for (int r = 0; r < D; ++r) {
    const double unit = std::max(1.0, std::abs(difference(r)));
    EXPECT_NEAR((r == D - 1 ? WrapHeading(off(r)) : off(r)) / unit, 0.0,
                tolerance)
        << "coordinate " << r;
  }
  EXPECT_LE(std::abs(DifferenceAt<D>(differences, i)(D - 1)), kPi + 1e-12);
  const StateMatrix<D> actual = CovarianceAt<D>(differences, i);
  for (int r = 0; r < D; ++r) {
    for (int c = 0; c <= r; ++c) {
      const double unit =
          std::sqrt(std::abs(covariance(r, r) * covariance(c, c)));
      EXPECT_NEAR(actual(r, c), covariance(r, c), tolerance * unit)
          << "entry " << r << "," << c;
    }
  }
}

// A drive by dead reckoning with honest covariances, except for some nodes that
// claim anything. Some drives lie in the plane.
template <int D>
PoseGraph RandomDrive(std::mt19937_64& random, NodeIndex size,
                      const std::vector<NodeIndex>& honest) {
  PoseGraph graph;
  const bool flat = D == 3 && UniformInt(random, 0, 1);
  Pose pose = RandomPose(random, 50.0);
  if (flat) pose.z = 0.0;
  StateMatrix<4> covariance = ToMatrix<4>(RandomCovariance(random, 1.0));
  for (NodeIndex i = 0; i < size; ++i) {
    Node node;
    node.sequence = static_cast<std::uint64_t>(i) + 1;
    node.pose = pose;
    node.covariance = ToCovariance<4>(covariance);
    if (UniformInt(random, 0, 9) == 0 &&
        std::find(honest.begin(), honest.end(), i) == honest.end()) {
      node.covariance =
          RandomCovariance(random, std::pow(10.0, Uniform(random, -2.0, 3.0)));
    }
    if (flat) {
      for (int k = 0; k < 4; ++k) node.covariance(2, k) = 0.0;
    }
    graph.AddNode(node, i == 0, std::nullopt);
    const Pose before = pose;
    pose.heading = WrapHeading(pose.heading + Normal(random, 0.3));
    pose.x += 2.0 * std::cos(pose.heading);
    pose.y += 2.0 * std::sin(pose.heading);
    if (!flat) pose.z += Normal(random, 0.1);
    const StateMatrix<4> f = DeadReckoningTransition<4>(before, pose);
    covariance = (f * covariance * f.transpose()).eval() +
                 ToMatrix<4>(RandomCovariance(random, 0.1));
  }
  return graph;
}

// How often each case has occurred in the trials.
struct ValuesSeen {
  int before_closure = 0;
  int between = 0;
  int after_closure = 0;
  int unchanged = 0;
};

template <int D>
void ExpectDifferencesOfPairs(std::mt19937_64& random, ValuesSeen* seen) {
  const NodeIndex size = UniformInt(random, 4, 300);
  const auto any = [&](NodeIndex last) {
    return static_cast<NodeIndex>(
        UniformInt(random, 0, static_cast<int>(last)));
  };
  const NodeIndex query = size - 1 - any(std::min<NodeIndex>(size - 3, 2));
  ConfirmedLoop loop{any(query), any(query), nullptr};
  if (loop.query == loop.matched) return;
  const PoseGraph graph =
      RandomDrive<D>(random, size, {query, loop.query, loop.matched});
  SCOPED_TRACE(::testing::Message()
               << "query " << query << " of " << size << ", closure "
               << loop.query << "-" << loop.matched);
  if (loop.matched < loop.query && UniformInt(random, 0, 1)) {
    loop.measured = RandomMeasurement(random, EstimateAt(graph, loop.query),
                                      EstimateAt(graph, loop.matched), 0.5);
  }
  SimilarityModel model;
  model.state_space = D == 3 ? StateSpace::kPlanar : StateSpace::kSpatial;
  constexpr CorrelationModel kModels[] = {
      CorrelationModel::kIndependent, CorrelationModel::kCorrelatedFixes,
      CorrelationModel::kDeadReckoning, CorrelationModel::kDeadReckoning,
      CorrelationModel::kDeadReckoning};
  model.correlation = {kModels[UniformInt(random, 0, 4)],
                       Uniform(random, 1.0, 300.0)};
  model.direction =
      UniformInt(random, 0, 1) ? Direction::kSame : Direction::kOpposite;
  model.inflation = UniformInt(random, 0, 1) ? Uniform(random, 1.0, 3.0) : 1.0;
  model.tolerance = {Uniform(random, 0.1, 4.0), Uniform(random, 0.01, 0.3)};
  const auto known = model.correlation == CorrelationModel::kDeadReckoning
                         ? KnownDrift<D>::Make({graph, query}, model, loop)
                         : std::nullopt;
  const KernelQuery kernel_query = MakeKernelQuery(graph, model, query);

  const std::size_t blocks = BlocksOf(query);
  for (std::size_t k = 0; k < blocks; ++k) {
    const auto first = static_cast<NodeIndex>(k * NodeBlock::kSize);
    const std::size_t count =
        std::min(NodeBlock::kSize, static_cast<std::size_t>(query - first));
    alignas(64) BlockShares shares;
    const bool shared =
        FindUncorrelatedShares(graph, model.correlation, query, k, &shares);
    DifferenceBlock differences;
    FindDifferences(kernel_query, graph.block(k),
                    graph.block(UniformInt(random, 0, 1) ? k : 0),
                    shared ? &shares : nullptr, &differences);
    DifferenceBlock conditioned = differences;
    if (known) {
      BlockColumn indices;
      std::iota(indices.begin(), indices.end(), static_cast<double>(first));
      TakeKnownDrift(known->Terms(), model.state_space, graph.block(k), indices,
                     &conditioned);
    }
    for (std::size_t i = 0; i < count; ++i) {
      const NodeIndex j = first + static_cast<NodeIndex>(i);
      SCOPED_TRACE(::testing::Message() << "node " << j);
      StateVector<D> difference = ToVector<D>(
          PassDifference(model, graph.node(query).pose, graph.node(j).pose));
      StateMatrix<D> covariance = ToleratedCovariance<D>(
          model, DifferenceCovariance<D>(graph, model.correlation, query, j));
      ExpectNear<D>(differences, i, difference, covariance, 1e-12);
      if (!known) continue;
      const StateVector<D> difference_before = difference;
      const StateMatrix<D> covariance_before = covariance;
      known->Apply(j, &difference, &covariance);
      if (Evaluate<D>(covariance, difference)) {
        ExpectNear<D>(conditioned, i, difference, covariance, 1e-9);
        const auto [earlier, later] = std::minmax(loop.query, loop.matched);
        seen->before_closure += j < earlier;
        seen->between += earlier < j && j < later;
        seen->after_closure += j > later;
      } else {
        ExpectNear<D>(conditioned, i, difference_before, covariance_before,
                      1e-12);
        ++seen->unchanged;
      }
    }
  }
}

TEST(SimilarityKernelTest, DifferencesAreThoseOfPairsGivenAClosureOrNot) {
  std::mt19937_64 random = SeededRandom();
  ValuesSeen seen;
  ForEachVectorTarget([&] {
    for (int trial = 0; trial < 60 && !::testing::Test::HasFailure(); ++trial) {
      SCOPED_TRACE(trial);
      ExpectDifferencesOfPairs<3>(random, &seen);
      ExpectDifferencesOfPairs<4>(random, &seen);
    }
  });
  EXPECT_GT(seen.before_closure, 1000);
  EXPECT_GT(seen.between, 1000);
  EXPECT_GT(seen.after_closure, 1000);
  EXPECT_GT(seen.unchanged, 20);
}

// How many of the evaluated differences were changed.
struct KernelTally {
  int changed = 0;
  int as_it_was = 0;
  int impossible = 0;
};

template <int D>
void ExpectEvaluatedAsPairs(std::mt19937_64& random, KernelTally* tally) {
  constexpr StateSpace kSpace =
      D == 3 ? StateSpace::kPlanar : StateSpace::kSpatial;
  const auto draw = [&random](double scale) {
    return ToMatrix<D>(RandomCovariance(random, scale));
  };
  constexpr std::size_t kRows = 20;
  std::vector<StateMatrix<D>> taken(kRows);
  std::vector<double> certainties(kRows * kMostEntries);
  for (std::size_t row = 0; row < kRows; ++row) {
    taken[row] =
        row == 0 ? StateMatrix<D>::Zero() : draw(Uniform(random, 0.0, 1.0));
    std::size_t entry = row * kMostEntries;
    for (int r = 0; r < D; ++r) {
      for (int c = 0; c <= r; ++c) certainties[entry++] = taken[row](r, c);
    }
  }
  DifferenceBlock differences;
  DifferenceChange change;
  const double angle = Uniform(random, -kPi, kPi);
  change.certainty = certainties.data();
  change.cosine = std::cos(angle);
  change.sine = std::sin(angle);
  change.least_left = UniformInt(random, 0, 1) ? 1e-3 : 0.2;
  for (std::size_t i = 0; i < NodeBlock::kSize; ++i) {
    StateMatrix<D> covariance = draw(std::exp(Uniform(random, -3.0, 3.0)));
    AddTolerance<D>({Uniform(random, 0.0, 2.0), Uniform(random, 0.0, 0.3)},
                    &covariance);
    // Not positive definite, or nothing at all.
    const int kind = UniformInt(random, 0, 9);
    if (kind == 0) covariance(0, 0) = -covariance(0, 0);
    if (kind == 1) covariance.setZero();
    Put<D>(ToVector<D>(RandomPose(random, 10.0)), covariance, i, &differences);
    change.row[i] = UniformInt(random, 0, kRows - 1);
    for (auto& column : change.shift) column[i] = Normal(random, 1.0);
  }

  const auto expect = [](const BlockSimilarity& similarity, std::size_t i,
                         const std::optional<QuadraticForm>& form) {
    if (!form) {
      EXPECT_EQ(similarity.log_similarity[i], kImpossible);
      return;
    }
    const double value =
        -0.5 * (form->log_determinant + form->squared_mahalanobis);
    EXPECT_NEAR(similarity.log_similarity[i], value,
                1e-12 * std::max(1.0, std::abs(value)));
    EXPECT_NEAR(similarity.squared_mahalanobis[i], form->squared_mahalanobis,
                1e-12 * std::max(1.0, form->squared_mahalanobis));
  };
  BlockSimilarity similarity;
  EvaluateDifferences(kSpace, differences, &similarity);
  const BlockSimilarity before = similarity;
  EvaluateChanged(kSpace, differences, change, &similarity);
  for (std::size_t i = 0; i < NodeBlock::kSize; ++i) {
    SCOPED_TRACE(::testing::Message() << "entry " << i);
    const StateVector<D> difference = DifferenceAt<D>(differences, i);
    const StateMatrix<D> covariance = CovarianceAt<D>(differences, i);
    const auto unchanged = Evaluate<D>(covariance, difference);
    expect(before, i, unchanged);
    if (!unchanged) {
      // Nothing is required of the change here.
      ++tally->impossible;
      continue;
    }
    StateVector<D> shift;
    for (int r = 0; r < D; ++r) {
      shift(r) = change.shift[static_cast<std::size_t>(r)][i];
    }
    const StateMatrix<D>& certainty =
        taken[static_cast<std::size_t>(change.row[i])];
    const auto changed = Evaluate<D>(covariance - certainty,
                                     difference + TurnAbout<D>(angle) * shift);
    const bool enough_left =
        Evaluate<D>((1.0 - change.least_left) * covariance - certainty,
                    StateVector<D>::Zero())
            .has_value();
    if (changed && enough_left) {
      expect(similarity, i, changed);
      ++tally->changed;
    } else {
      EXPECT_EQ(similarity.log_similarity[i], before.log_similarity[i]);
      EXPECT_EQ(similarity.squared_mahalanobis[i],
                before.squared_mahalanobis[i]);
      ++tally->as_it_was;
    }
  }
}

TEST(SimilarityKernelTest, EvaluatesDifferencesAsTheyAreAndChanged) {
  std::mt19937_64 random = SeededRandom();
  KernelTally tally;
  ForEachVectorTarget([&] {
    for (int trial = 0; trial < 50 && !::testing::Test::HasFailure(); ++trial) {
      SCOPED_TRACE(trial);
      ExpectEvaluatedAsPairs<3>(random, &tally);
      ExpectEvaluatedAsPairs<4>(random, &tally);
    }
  });
  EXPECT_GT(tally.changed, 1000);
  EXPECT_GT(tally.as_it_was, 1000);
  EXPECT_GT(tally.impossible, 1000);
}

// A random change within a bound.
template <int D>
void ExpectBounded(std::mt19937_64& random, double* least_slack,
                   std::int64_t* changed) {
  constexpr StateSpace kSpace =
      D == 3 ? StateSpace::kPlanar : StateSpace::kSpatial;
  const auto draw = [&random](double scale) {
    return ToMatrix<D>(RandomCovariance(random, scale));
  };
  const auto pack = [](const StateMatrix<D>& matrix, double* entries) {
    for (int r = 0; r < D; ++r) {
      for (int c = 0; c <= r; ++c) *entries++ = matrix(r, c);
    }
  };
  const StateMatrix<D> shift = draw(std::exp(Uniform(random, -2.0, 2.0)));
  const StateMatrix<D> certainty = draw(std::exp(Uniform(random, -3.0, 1.0)));
  ChangeBound bound;
  bound.least_left = UniformInt(random, 0, 1) ? 1e-3 : 0.2;
  pack(shift, bound.shift);
  pack(certainty, bound.certainty);
  DifferenceBlock differences;
  for (std::size_t i = 0; i < NodeBlock::kSize; ++i) {
    StateMatrix<D> covariance =
        draw(std::exp(Uniform(random, -3.0, 3.0))) +
        (UniformInt(random, 0, 1) ? 1.1 : 0.0) * certainty;
    AddTolerance<D>({0.5, 0.05}, &covariance);
    Put<D>(ToVector<D>(RandomPose(random, 10.0)), covariance, i, &differences);
  }
  BlockSimilarity before;
  EvaluateDifferences(kSpace, differences, &before);
  BlockColumn most;
  BlockColumn unshifted;
  BoundChanged(kSpace, differences, bound, before, &most, &unshifted);

  constexpr std::size_t kRows = 8;
  std::vector<double> certainties(kRows * kMostEntries);
  const Eigen::LLT<StateMatrix<D>> of_shift(shift);
  DifferenceChange change;
  change.certainty = certainties.data();
  change.least_left = bound.least_left;
  for (int trial = 0; trial < 10; ++trial) {
    for (std::size_t row = 0; row < kRows; ++row) {
      // Once all of it is taken: then the bound is as near as it can be.
      pack((row == 0 ? 1.0 : Uniform(random, 0.0, 1.0)) * certainty,
           certainties.data() + row * kMostEntries);
    }
    const double angle = Uniform(random, -kPi, kPi);
    change.cosine = std::cos(angle);
    change.sine = std::sin(angle);
    std::vector<double> costs(NodeBlock::kSize);
    for (std::size_t i = 0; i < NodeBlock::kSize; ++i) {
      change.row[i] = UniformInt(random, 0, kRows - 1);
      StateVector<D> drawn;
      for (int r = 0; r < D; ++r) drawn(r) = Normal(random, 1.0);
      StateVector<D> shifted = of_shift.matrixL() * drawn;
      const StateMatrix<D> covariance = CovarianceAt<D>(differences, i);
      if (UniformInt(random, 0, 1)) {
        // The best shift for this difference.
        shifted = -shift * (covariance - certainty + shift)
                               .ldlt()
                               .solve(DifferenceAt<D>(differences, i));
      }
      costs[i] = 0.5 * shifted.dot(of_shift.solve(shifted));
      const StateVector<D> turned_back = TurnAbout<D>(-angle) * shifted;
      for (int r = 0; r < D; ++r) {
        change.shift[static_cast<std::size_t>(r)][i] = turned_back(r);
      }
    }
    BlockSimilarity similarity = before;
    EvaluateChanged(kSpace, differences, change, &similarity);
    for (std::size_t i = 0; i < NodeBlock::kSize; ++i) {
      if (before.log_similarity[i] == kImpossible) continue;
      *changed += similarity.log_similarity[i] != before.log_similarity[i];
      const double slack = most[i] + costs[i] - similarity.log_similarity[i];
      ASSERT_GE(slack, -1e-9 * std::max(1.0, std::abs(most[i])))
          << "entry " << i;
      *least_slack = std::min(*least_slack, slack);
      ASSERT_GE(unshifted[i] - similarity.log_similarity[i] -
                    0.5 * similarity.squared_mahalanobis[i],
                -1e-9 * std::max(1.0, std::abs(unshifted[i])))
          << "entry " << i;
    }
  }
}

TEST(SimilarityKernelTest, NoChangeWithinABoundSaysMoreThanItsBound) {
  std::mt19937_64 random = SeededRandom();
  double least_slack = 1e300;
  std::int64_t changed = 0;
  ForEachVectorTarget([&] {
    for (int trial = 0; trial < 50 && !::testing::Test::HasFailure(); ++trial) {
      SCOPED_TRACE(trial);
      ExpectBounded<3>(random, &least_slack, &changed);
      ExpectBounded<4>(random, &least_slack, &changed);
    }
  });
  std::cout << changed << " changed, " << least_slack << " nats to spare\n";
  EXPECT_GT(changed, 10000);
  // The bound is not far from what can be reached.
  EXPECT_LT(least_slack, 0.5);
}

TEST(SimilarityKernelTest, ABlockHoldsWhatLiesNearByItsOwnCovariance) {
  std::mt19937_64 random = SeededRandom();
  ForEachVectorTarget([&] {
    int near = 0;
    int far = 0;
    for (int trial = 0; trial < 500 && !::testing::Test::HasFailure();
         ++trial) {
      SCOPED_TRACE(trial);
      const bool less = UniformInt(random, 0, 1) == 0;
      PoseGraph graph;
      for (std::size_t i = 0; i < NodeBlock::kSize; ++i) {
        Node node;
        node.pose = RandomPose(random, 50.0);
        node.covariance = RandomCovariance(random, 1.0);
        graph.AddNode(node, i == 0, std::nullopt);
      }
      NodeRegion region;
      region.x = Uniform(random, -400.0, 400.0);
      region.y = Uniform(random, -400.0, 400.0);
      region.squared_per_variance = Uniform(random, 1.0, 100.0);
      region.variance = Uniform(random, 0.0, 10.0);
      const Covariance query = RandomCovariance(random, 20.0);
      region.xx = query(0, 0);
      region.xy = query(0, 1);
      region.yy = query(1, 1);
      region.node_scale = less ? -1.0 : 1.0;
      // By how much the nearest node lies within the region, and the margin
      // that rounding leaves undecided.
      double most_within = -1e300;
      for (NodeIndex i = 0; i < graph.size(); ++i) {
        const Eigen::Vector2d way(region.x - graph.pose(i).x,
                                  region.y - graph.pose(i).y);
        const Eigen::Matrix2d c =
            ToMatrix<4>(query).topLeftCorner<2, 2>() +
            region.node_scale *
                ToMatrix<4>(graph.covariance(i)).topLeftCorner<2, 2>();
        const Eigen::Vector2d direction = way.normalized();
        const double variance = direction.dot(c * direction) + region.variance;
        most_within = std::max(
            most_within,
            region.squared_per_variance * variance / way.squaredNorm() - 1.0);
      }
      if (std::abs(most_within) < 1e-9) continue;
      EXPECT_EQ(HoldsNear(region, graph.block(0)), most_within > 0.0);
      ++(most_within > 0.0 ? near : far);
    }
    EXPECT_GT(near, 60);
    EXPECT_GT(far, 300);
  });
}

TEST(SimilarityKernelTest, WhatIsNotANumberIsNear) {
  PoseGraph graph;
  for (std::size_t i = 0; i < NodeBlock::kSize; ++i) {
    graph.AddNode(Node(), i == 0, std::nullopt);
  }
  NodeRegion region;
  region.x = 1e3;
  region.squared_per_variance = 1.0;
  ForEachVectorTarget([&] {
    region.variance = 1.0;
    EXPECT_FALSE(HoldsNear(region, graph.block(0)));
    region.variance = std::nan("");
    EXPECT_TRUE(HoldsNear(region, graph.block(0)));
  });
}

}  // namespace
}  // namespace revisit::core
