#include "core/noise/noise_model.h"

#include <gtest/gtest.h>

#include <random>
#include <set>

#include "core/geometry/state_matrix.h"
#include "core/noise/covariances.h"
#include "tests/core/graphs.h"
#include "tests/random.h"

namespace revisit::core {
namespace {

constexpr CorrelationModel kAllModels[] = {
    CorrelationModel::kDeadReckoning, CorrelationModel::kIndependent,
    CorrelationModel::kFilter, CorrelationModel::kCorrelatedFixes};

PathPair<4> RandomPair(std::mt19937_64& random) {
  PathPair<4> pair;
  pair.later_pose = {Uniform(random, -50.0, 50.0), Uniform(random, -50.0, 50.0),
                     1.0, Uniform(random, -3.0, 3.0)};
  pair.earlier = ToMatrix<4>(RandomCovariance(random, 2.0));
  pair.later = ToMatrix<4>(RandomCovariance(random, 3.0));
  pair.meters_apart = Uniform(random, 0.0, 100.0);
  for (int k = 0; k < 16; ++k) pair.transition(k) += Normal(random, 0.1);
  return pair;
}

TEST(NoiseModelTest, EveryModelHasARowOfItsOwn) {
  std::set<const NoiseModel*> rows;
  for (const CorrelationModel model : kAllModels) rows.insert(&NoiseOf(model));
  EXPECT_EQ(rows.size(), std::size(kAllModels));
}

TEST(NoiseModelTest, TheParameterCountsOnlyWhereErrorsDecorrelateOverTheWay) {
  for (const CorrelationModel model : kAllModels) {
    EXPECT_EQ(Correlation(model, 10.0) != Correlation(model, 20.0),
              NoiseOf(model).decorrelates_over_way);
    EXPECT_EQ(Correlation(model, 10.0), Correlation(model, 10.0));
  }
  EXPECT_NE(Correlation(CorrelationModel::kFilter),
            Correlation(CorrelationModel::kIndependent));
}

// Cov(e_j - e_i) = S_i + S_j - C - C^T with C = Cov(e_j, e_i).
TEST(NoiseModelTest, DifferenceAndCrossCovarianceAreOfOneProcess) {
  std::mt19937_64 random = SeededRandom();
  for (const CorrelationModel model : kAllModels) {
    for (int trial = 0; trial < 20; ++trial) {
      const PathPair<4> pair = RandomPair(random);
      const StateMatrix<4> cross = CrossCovariance<4>(model, pair);
      const StateMatrix<4> expected =
          pair.earlier + pair.later - cross - cross.transpose();
      const double size =
          expected.lpNorm<Eigen::Infinity>() + cross.lpNorm<Eigen::Infinity>();
      EXPECT_LT((DifferenceCovariance<4>(model, pair) - expected)
                    .lpNorm<Eigen::Infinity>(),
                1e-12 * size);
    }
  }
}

TEST(NoiseModelTest, GammaHasTheFormThatTheRowSays) {
  std::mt19937_64 random = SeededRandom();
  for (const CorrelationModel model : kAllModels) {
    const NoiseModel& noise = NoiseOf(model);
    for (int trial = 0; trial < 20; ++trial) {
      const PathPair<4> pair = RandomPair(random);
      const StateMatrix<4> gamma = DifferenceCovariance<4>(model, pair);
      if (noise.form == DifferenceForm::kGrown) {
        const Eigen::Vector2d along(pair.later_pose.x - pair.earlier_pose.x,
                                    pair.later_pose.y - pair.earlier_pose.y);
        const Eigen::Vector2d u = along.normalized();
        const Eigen::Matrix2d taken =
            (pair.later - pair.earlier).topLeftCorner<2, 2>();
        EXPECT_NEAR(u.dot(gamma.topLeftCorner<2, 2>() * u), u.dot(taken * u),
                    1e-9);
      }
      if (noise.form == DifferenceForm::kSummed) {
        const StateMatrix<4> sum = pair.earlier + pair.later;
        const double share = gamma(0, 0) / sum(0, 0);
        EXPECT_LE(share, 1.0);
        EXPECT_LT((gamma - share * sum).lpNorm<Eigen::Infinity>(), 1e-9);
      }
      if (noise.exceeds_either) {
        EXPECT_GE(gamma(0, 0), std::max(pair.earlier(0, 0), pair.later(0, 0)));
      }
    }
  }
}

TEST(NoiseModelTest, DriftAndJitterAreAllOfAStep) {
  std::mt19937_64 random = SeededRandom();
  for (const CorrelationModel model : kAllModels) {
    const StateMatrix<4> step = StepCovariance<4>(model, RandomPair(random));
    const StepNoise<4> noise = SplitStepCovariance<4>(model, step);
    EXPECT_EQ(noise.drift + noise.jitter, step);
  }
}

}  // namespace
}  // namespace revisit::core
