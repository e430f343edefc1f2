#include "core/search/alignment/log_similarity.h"

#include <gtest/gtest.h>

#include <cmath>
#include <vector>

#include "core/drive/node_noise.h"
#include "core/drive/pose_graph.h"
#include "core/geometry/heading.h"
#include "core/geometry/pose.h"
#include "core/geometry/quadratic_form.h"
#include "core/geometry/state_matrix.h"
#include "core/noise/dead_reckoning.h"
#include "core/noise/similarity_model.h"
#include "tests/core/graphs.h"
#include "tests/oracle/dead_reckoning.h"
#include "tests/oracle/long_double_density.h"
#include "tests/oracle/wide_state.h"
#include "tests/random.h"

namespace revisit::core {
namespace {

template <int D>
void ExpectMatchesLongDouble(const PoseGraph& graph,
                             const SimilarityModel& model, NodeIndex i,
                             NodeIndex j) {
  const NodeIndex earlier = std::min(i, j);
  const NodeIndex later = std::max(i, j);
  const bool fixes = model.correlation == CorrelationModel::kCorrelatedFixes;
  StateMatrix<D> psi = StateMatrix<D>::Zero();
  if (model.correlation == CorrelationModel::kDeadReckoning) {
    psi = DeadReckoningTransition<D>(graph.pose(earlier), graph.pose(later));
  } else if (model.correlation == CorrelationModel::kFilter) {
    psi = CarriedTransition<D>(graph, earlier, later);
  }
  const long double share =
      fixes ? 1.0L - oracle::WideShared(
                         oracle::WideCovarianceOf(graph.covariance(earlier), D),
                         oracle::WideCovarianceOf(graph.covariance(later), D),
                         graph.MetersApart(i, j), model.correlation)
            : 1.0L;
  oracle::Matrix gamma(D, std::vector<long double>(D));
  const StateMatrix<D> a = ToMatrix<D>(graph.node(earlier).covariance);
  const StateMatrix<D> b = ToMatrix<D>(graph.node(later).covariance);
  for (int r = 0; r < D; ++r) {
    for (int c = 0; c < D; ++c) {
      long double sum = share * (static_cast<long double>(a(r, c)) + b(r, c));
      for (int k = 0; k < D; ++k) {
        sum -= static_cast<long double>(a(r, k)) * psi(c, k) +
               static_cast<long double>(a(c, k)) * psi(r, k);
      }
      if (r == c) {
        const long double tolerance = r == D - 1
                                          ? model.tolerance.heading_radians
                                          : model.tolerance.position_meters;
        sum += tolerance * tolerance;
      }
      gamma[static_cast<std::size_t>(r)][static_cast<std::size_t>(c)] = sum;
    }
  }
  const StateVector<D> d =
      ToVector<D>(Difference(graph.node(i).pose, graph.node(j).pose));
  std::vector<long double> wide(d.data(), d.data() + D);
  const double c = model.form == LikelihoodForm::kAsPrinted ? 1.0 : 0.5;
  const double actual = LogSimilarity(graph, model, i, j);
  if (!(oracle::Determinant(gamma) > 0)) return;  // Other tests' business.
  if (actual == kImpossible) return;
  const auto expected =
      static_cast<double>(oracle::LogSimilarity(gamma, wide, c));
  EXPECT_NEAR(actual, expected, 1e-9 * std::max(1.0, std::abs(expected)));
}

TEST(LogSimilarityTest, AgreesWithTheDensityInLongDouble) {
  std::mt19937_64 random = SeededRandom();
  int possible = 0;
  for (int trial = 0; trial < 300; ++trial) {
    const PoseGraph graph = RandomGraph(random, 10, 0.0, 0, true);
    for (StateSpace space : {StateSpace::kPlanar, StateSpace::kSpatial}) {
      for (CorrelationModel correlation :
           {CorrelationModel::kDeadReckoning, CorrelationModel::kIndependent,
            CorrelationModel::kFilter, CorrelationModel::kCorrelatedFixes}) {
        for (LikelihoodForm form :
             {LikelihoodForm::kGaussian, LikelihoodForm::kAsPrinted}) {
          SimilarityModel model{space, correlation, form, {}};
          const NodeIndex i = UniformInt(random, 0, 9);
          const NodeIndex j = (i + UniformInt(random, 1, 9)) % 10;
          possible += LogSimilarity(graph, model, i, j) != kImpossible;
          if (space == StateSpace::kPlanar) {
            ExpectMatchesLongDouble<3>(graph, model, i, j);
          } else {
            ExpectMatchesLongDouble<4>(graph, model, i, j);
          }
        }
      }
    }
  }
  // Unrelated covariances make dead-reckoned differences indefinite now and
  // then.
  EXPECT_GT(possible, 300 * 16 / 2);
}

TEST(LogSimilarityTest, IsSymmetricInItsNodes) {
  std::mt19937_64 random = SeededRandom();
  const PoseGraph graph = RandomGraph(random, 20, 0.0, 0, true);
  for (CorrelationModel correlation :
       {CorrelationModel::kDeadReckoning, CorrelationModel::kIndependent,
        CorrelationModel::kFilter, CorrelationModel::kCorrelatedFixes}) {
    SimilarityModel model;
    model.correlation = correlation;
    for (int trial = 0; trial < 50; ++trial) {
      const NodeIndex i = UniformInt(random, 0, 19);
      const NodeIndex j = UniformInt(random, 0, 19);
      EXPECT_EQ(LogSimilarity(graph, model, i, j),
                LogSimilarity(graph, model, j, i));
    }
  }
}

TEST(LogSimilarityTest, AColumnHoldsThePairs) {
  std::mt19937_64 random = SeededRandom();
  const PoseGraph graph = RandomGraph(random, 40, 0.1, 0, true);
  for (StateSpace space : {StateSpace::kPlanar, StateSpace::kSpatial}) {
    for (CorrelationModel correlation :
         {CorrelationModel::kDeadReckoning, CorrelationModel::kIndependent,
          CorrelationModel::kFilter, CorrelationModel::kCorrelatedFixes}) {
      SimilarityModel model;
      model.state_space = space;
      model.correlation = correlation;
      std::vector<double> column;
      LogSimilarityColumn(graph, model, 35, 20, &column);
      ASSERT_EQ(column.size(), 20u);
      for (NodeIndex i = 0; i < 20; ++i) {
        const double pair = LogSimilarity(graph, model, 35, i);
        const double in_column = column[static_cast<std::size_t>(i)];
        if (pair == kImpossible) {
          EXPECT_EQ(in_column, kImpossible);
        } else {
          EXPECT_NEAR(in_column, pair, 1e-12 * std::abs(pair)) << i;
        }
      }
    }
  }
}

// Random nodes at every scale that is allowed for a pose. Some occur twice, and
// some headings lie where they wrap.
PoseGraph ExtremeGraph(std::mt19937_64& random, NodeIndex size) {
  PoseGraph graph;
  Node node;
  for (NodeIndex i = 0; i < size; ++i) {
    if (UniformInt(random, 0, 9) > 0) {
      node.pose =
          RandomPose(random, std::pow(10.0, Uniform(random, -3.0, 8.0)));
      node.covariance =
          RandomCovariance(random, std::pow(10.0, Uniform(random, -8.0, 8.0)));
      const double headings[] = {kPi, std::nextafter(-kPi, 0.0), 0.0};
      const int which = UniformInt(random, 0, 5);
      if (which < 3) node.pose.heading = headings[which];
    }
    node.sequence = static_cast<std::uint64_t>(i) + 1;
    graph.AddNode(node, i == 0, std::nullopt);
  }
  return graph;
}

// How often each case was compared with the kernel.
struct Tally {
  std::int64_t possible = 0;
  std::int64_t impossible = 0;
};

void ExpectColumnHoldsPairs(const PoseGraph& graph,
                            const SimilarityModel& model, NodeIndex query,
                            NodeIndex count, Tally* tally) {
  std::vector<double> column;
  LogSimilarityColumn(graph, model, query, count, &column);
  ASSERT_EQ(column.size(), static_cast<std::size_t>(count));
  for (NodeIndex i = 0; i < count; ++i) {
    const double pair = LogSimilarity(graph, model, query, i);
    const double in_column = column[static_cast<std::size_t>(i)];
    if (pair == kImpossible) {
      ASSERT_EQ(in_column, kImpossible) << i;
      ++tally->impossible;
    } else {
      ASSERT_NEAR(in_column, pair, 1e-12 * std::abs(pair)) << i;
      ++tally->possible;
    }
  }
}

TEST(LogSimilarityTest, TheKernelHoldsThePairsOfEveryModelAtEveryScale) {
  std::mt19937_64 random = SeededRandom();
  Tally tally;
  for (int trial = 0; trial < 400; ++trial) {
    const NodeIndex size = UniformInt(random, 2, 300);
    const PoseGraph graph = trial % 2 == 0
                                ? RandomGraph(random, size, 0.0, 0, false)
                                : ExtremeGraph(random, size);
    for (StateSpace space : {StateSpace::kPlanar, StateSpace::kSpatial}) {
      for (CorrelationModel correlation :
           {CorrelationModel::kDeadReckoning, CorrelationModel::kIndependent,
            CorrelationModel::kCorrelatedFixes}) {
        for (LikelihoodForm form :
             {LikelihoodForm::kGaussian, LikelihoodForm::kAsPrinted}) {
          for (Direction direction : {Direction::kSame, Direction::kOpposite}) {
            SimilarityModel model;
            model.state_space = space;
            model.correlation = correlation;
            model.form = form;
            model.direction = direction;
            model.inflation = trial % 3 == 0 ? 1.0 : Uniform(random, 1.0, 10.0);
            if (trial % 5 == 0) {
              model.tolerance = {0.0, 0.0};
            } else if (trial % 5 == 1) {
              model.tolerance = {Uniform(random, 0.0, 1e3),
                                 Uniform(random, 0.0, 3.0)};
            }
            const NodeIndex query =
                UniformInt(random, 1, static_cast<int>(size) - 1);
            const NodeIndex count =
                UniformInt(random, 0, static_cast<int>(query));
            ASSERT_NO_FATAL_FAILURE(
                ExpectColumnHoldsPairs(graph, model, query, count, &tally))
                << "trial " << trial;
          }
        }
      }
    }
  }
  EXPECT_GT(tally.possible, 100000);
  EXPECT_GT(tally.impossible, 10000);
}

TEST(LogSimilarityTest, TheKernelTakesALogarithmAPivotWhereTheirProductIsNone) {
  for (double deviation : {1e-100, 1e100}) {
    PoseGraph graph;
    for (int i = 0; i < 130; ++i) {
      Node node;
      node.sequence = static_cast<std::uint64_t>(i) + 1;
      const double variance = deviation * deviation * (1.0 + 0.01 * i);
      for (int k = 0; k < 4; ++k) node.covariance(k, k) = variance;
      graph.AddNode(node, i == 0, std::nullopt);
    }
    SimilarityModel model;
    model.correlation = CorrelationModel::kIndependent;
    model.tolerance = {0.0, 0.0};
    Tally tally;
    for (StateSpace space : {StateSpace::kPlanar, StateSpace::kSpatial}) {
      model.state_space = space;
      ExpectColumnHoldsPairs(graph, model, 129, 129, &tally);
    }
    EXPECT_EQ(tally.possible, 2 * 129);
  }
}

TEST(LogSimilarityTest, DoesNotDependOnTheFrame) {
  std::mt19937_64 random = SeededRandom();
  const double angle = 1.1;
  const double c = std::cos(angle);
  const double s = std::sin(angle);
  StateMatrix<4> rotation = StateMatrix<4>::Identity();
  rotation.topLeftCorner<2, 2>() << c, -s, s, c;
  // A drive with the covariances of its path, once as it is and once turned and
  // moved.
  std::vector<Pose> path(100);
  for (std::size_t i = 1; i < path.size(); ++i) {
    path[i].heading = path[i - 1].heading + Normal(random, 0.1);
    path[i].x = path[i - 1].x + 2.0 * std::cos(path[i].heading);
    path[i].y = path[i - 1].y + 2.0 * std::sin(path[i].heading);
  }
  PoseGraph here;
  PoseGraph there;
  for (const PoseSample& sample : oracle::WithCovariances(path, {})) {
    Node node;
    node.pose = sample.pose;
    node.covariance = sample.covariance;
    here.AddNode(node, sample.sequence == 1, std::nullopt);
    node.pose = {c * sample.pose.x - s * sample.pose.y + 300.0,
                 s * sample.pose.x + c * sample.pose.y - 700.0, 0.0,
                 sample.pose.heading + angle};
    node.covariance = ToCovariance<4>(
        rotation * ToMatrix<4>(sample.covariance) * rotation.transpose());
    there.AddNode(node, sample.sequence == 1, std::nullopt);
  }
  const SimilarityModel model;
  for (NodeIndex i = 0; i < 100; i += 7) {
    const double expected = LogSimilarity(here, model, i, 99);
    EXPECT_NEAR(LogSimilarity(there, model, i, 99), expected,
                1e-8 * std::abs(expected));
  }
}

TEST(EvaluateTest, RefusesWhatIsNotPositiveDefinite) {
  StateMatrix<3> gamma = StateMatrix<3>::Identity();
  const StateVector<3> d(1, 2, 3);
  ASSERT_TRUE(Evaluate<3>(gamma, d));
  EXPECT_DOUBLE_EQ(Evaluate<3>(gamma, d)->squared_mahalanobis, 14.0);
  EXPECT_DOUBLE_EQ(Evaluate<3>(gamma, d)->log_determinant, 0.0);
  gamma(0, 1) = gamma(1, 0) = 1.0;
  EXPECT_FALSE(Evaluate<3>(gamma, d));
  gamma(0, 1) = gamma(1, 0) = 0.0;
  gamma(2, 2) = -1.0;
  EXPECT_FALSE(Evaluate<3>(gamma, d));
  gamma(2, 2) = std::nan("");
  EXPECT_FALSE(Evaluate<3>(gamma, d));
}

TEST(EvaluateTest, SurvivesDeterminantsOutsideDoubleRange) {
  for (double scale : {1e-200, 1e200}) {
    const StateMatrix<4> gamma = scale * StateMatrix<4>::Identity();
    const auto terms = Evaluate<4>(gamma, StateVector<4>::Zero());
    ASSERT_TRUE(terms);
    EXPECT_NEAR(terms->log_determinant, 4.0 * std::log(scale), 1e-9);
  }
}

}  // namespace
}  // namespace revisit::core
