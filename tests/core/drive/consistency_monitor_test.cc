#include "core/drive/consistency_monitor.h"

#include <gtest/gtest.h>

#include <Eigen/Cholesky>
#include <cmath>
#include <limits>
#include <vector>

#include "core/drive/confirmed_loop.h"
#include "core/drive/pose_graph.h"
#include "core/geometry/heading.h"
#include "core/geometry/state_matrix.h"
#include "core/noise/similarity_model.h"
#include "core/search/candidates/gate.h"
#include "tests/core/graphs.h"
#include "tests/oracle/inflation_by_quadrature.h"
#include "tests/random.h"

namespace revisit::core {
namespace {

Consistency EstimateConsistency(const PoseGraph& graph,
                                const ConsistencyOptions& options,
                                const std::vector<ConfirmedLoop>& confirmed) {
  ConsistencyMonitor monitor(options);
  for (const ConfirmedLoop& loop : confirmed) monitor.Confirm(graph, loop);
  return monitor.consistency();
}

// Pairs of nodes with independent errors. The second node's pose is the first's
// plus a draw from the pair's covariances, with standard deviations multiplied
// by `inflation`, and the tolerance.
class Pairs {
 public:
  Pairs(const SimilarityModel& model, double inflation, double scale)
      : model_(model), inflation_(inflation), scale_(scale) {}

  ConfirmedLoop Draw(std::mt19937_64& random) {
    return model_.state_space == StateSpace::kPlanar ? Draw<3>(random)
                                                     : Draw<4>(random);
  }

  const PoseGraph& graph() const { return graph_; }

 private:
  template <int D>
  ConfirmedLoop Draw(std::mt19937_64& random) {
    Node matched;
    matched.pose = RandomPose(random, 100.0);
    matched.covariance = RandomCovariance(random, scale_);
    Node query = matched;
    query.covariance = RandomCovariance(random, scale_);
    StateMatrix<D> spread =
        inflation_ * inflation_ *
        (ToMatrix<D>(matched.covariance) + ToMatrix<D>(query.covariance));
    AddTolerance<D>(model_.tolerance, &spread);
    StateVector<D> unit;
    for (int k = 0; k < D; ++k) unit(k) = Normal(random, 1.0);
    const StateVector<D> d = StateMatrix<D>(spread.llt().matrixL()) * unit;
    query.pose.x += d(0);
    query.pose.y += d(1);
    if constexpr (D == 4) query.pose.z += d(2);
    query.pose.heading = WrapHeading(query.pose.heading + d(D - 1));
    graph_.AddNode(matched, true, std::nullopt);
    graph_.AddNode(query, true, std::nullopt);
    return {graph_.size() - 1, graph_.size() - 2, nullptr};
  }

  const SimilarityModel model_;
  const double inflation_;
  const double scale_;
  PoseGraph graph_;
};

ConsistencyOptions Independent(StateSpace space = StateSpace::kPlanar) {
  ConsistencyOptions options;
  options.similarity.state_space = space;
  options.similarity.correlation = CorrelationModel::kIndependent;
  return options;
}

// Confirms `count` pairs that pass the gate in force, as a caller does who
// looks at nothing else, and returns the final estimate of the inflation.
double InflationFound(std::mt19937_64& random, double inflation, int count,
                      const ConsistencyOptions& options) {
  Pairs pairs(options.similarity, inflation, 5.0);
  const Gate gate(options.similarity.state_space, options.gate_probability);
  std::vector<ConfirmedLoop> confirmed;
  double found = EstimateConsistency(pairs.graph(), options, {}).inflation;
  while (static_cast<int>(confirmed.size()) < count) {
    const ConfirmedLoop loop = pairs.Draw(random);
    SimilarityModel model = options.similarity;
    model.inflation = options.applied ? found : 1.0;
    if (DecideAt({pairs.graph(), loop.query}, {pairs.graph(), loop.query},
                 model, gate, loop.matched, 0)
            ->gate.verdict != GateVerdict::kAccepted) {
      continue;
    }
    confirmed.push_back(loop);
    found = EstimateConsistency(pairs.graph(), options, confirmed).inflation;
  }
  return found;
}

// Measures the pair that was drawn last: the true offset is one within the
// tolerance, of which the difference shows a part.
ConfirmedLoop WithMeasurement(std::mt19937_64& random, const PoseGraph& graph,
                              ConfirmedLoop loop) {
  loop.measured = RandomMeasurement(random, EstimateAt(graph, loop.query),
                                    EstimateAt(graph, loop.matched),
                                    Uniform(random, 0.5, 3.0));
  return loop;
}

TEST(ConsistencyTest, IsThePosteriorWithTheGateByQuadrature) {
  std::mt19937_64 random = SeededRandom();
  for (int trial = 0; trial < 24; ++trial) {
    ConsistencyOptions options =
        Independent(trial % 2 ? StateSpace::kPlanar : StateSpace::kSpatial);
    options.gate_probability = trial % 3 ? 0.95 : 0.8;
    options.max_inflation = trial % 4 ? 10.0 : 3.0;
    Pairs pairs(options.similarity, Uniform(random, 1.0, 2.5),
                Uniform(random, 1.0, 20.0));
    std::vector<ConfirmedLoop> confirmed;
    for (int k = UniformInt(random, 0, 6); k > 0; --k) {
      const ConfirmedLoop loop = pairs.Draw(random);
      confirmed.push_back(UniformInt(random, 0, 1)
                              ? WithMeasurement(random, pairs.graph(), loop)
                              : loop);
    }
    const Consistency actual =
        EstimateConsistency(pairs.graph(), options, confirmed);
    const double expected =
        oracle::InflationByQuadrature(pairs.graph(), options, confirmed);
    // The approximation of the pass probability costs some 3 % of f at most.
    EXPECT_NEAR(actual.inflation, expected, 0.05 * expected)
        << confirmed.size() << " pairs";
  }
}

TEST(ConsistencyTest, BeforeAnyPairIsTheMeanOfThePrior) {
  for (const double most : {2.0, 10.0}) {
    ConsistencyOptions options = Independent();
    options.max_inflation = most;
    // The mean of ln f, a normal distribution about 0 that is cut off at 0 and
    // at ln max, has a closed form.
    const double end = std::log(most) / kInflationPrior;
    const double mean = kInflationPrior * std::sqrt(2.0 / kPi) *
                        (1.0 - std::exp(-0.5 * end * end)) /
                        std::erf(end / std::sqrt(2.0));
    // The steps of the grid leave an error of at most a thousandth.
    EXPECT_NEAR(
        std::log(EstimateConsistency(PoseGraph(), options, {}).inflation), mean,
        1e-3);
  }
}

TEST(ConsistencyTest, AnHonestEstimatorIsLeftNearlyAsItIs) {
  std::mt19937_64 random = SeededRandom();
  for (const bool applied : {false, true}) {
    for (int trial = 0; trial < 5; ++trial) {
      ConsistencyOptions options = Independent();
      options.applied = applied;
      const double found = InflationFound(random, 1.0, 60, options);
      EXPECT_GE(found, 1.0);
      EXPECT_LT(found, 1.35) << (applied ? "applied" : "not applied");
    }
  }
}

TEST(ConsistencyTest, AFactorOfTwoIsFoundWhereItIsApplied) {
  std::mt19937_64 random = SeededRandom();
  for (int trial = 0; trial < 5; ++trial) {
    ConsistencyOptions options = Independent();
    options.applied = true;
    const double found = InflationFound(random, 2.0, 60, options);
    EXPECT_GT(found, 1.45);
    EXPECT_LT(found, 3.1);
  }
}

TEST(ConsistencyTest, AFactorOfTwoIsSeenThroughAGateThatIsTooNarrow) {
  // Pairs outside the gate are never confirmed; pairs inside fill it too evenly
  // for an honest estimator.
  std::mt19937_64 random = SeededRandom();
  for (int trial = 0; trial < 5; ++trial) {
    const double found = InflationFound(random, 2.0, 60, Independent());
    EXPECT_GT(found, 1.1);
    EXPECT_LT(found, 4.0);
  }
}

TEST(ConsistencyTest, IsBoundedByTheMaximum) {
  std::mt19937_64 random = SeededRandom();
  ConsistencyOptions options = Independent();
  Pairs pairs(options.similarity, 50.0, 20.0);
  std::vector<ConfirmedLoop> confirmed;
  for (int k = 0; k < 30; ++k) confirmed.push_back(pairs.Draw(random));
  for (const double most : {1.0, 2.0, 10.0}) {
    options.max_inflation = most;
    const double found =
        EstimateConsistency(pairs.graph(), options, confirmed).inflation;
    EXPECT_LE(found, most * (1.0 + 1e-12));
    EXPECT_GT(found, 0.95 * most);
  }
}

TEST(ConsistencyTest, TellsTheMeanOfTheSquaresAsClaimed) {
  std::mt19937_64 random = SeededRandom();
  const ConsistencyOptions options = Independent(StateSpace::kSpatial);
  Pairs pairs(options.similarity, 1.5, 3.0);
  EXPECT_EQ(EstimateConsistency(pairs.graph(), options, {})
                .mean_normalized_innovation_squared,
            std::nullopt);
  std::vector<ConfirmedLoop> confirmed;
  double sum = 0.0;
  for (int k = 0; k < 7; ++k) {
    confirmed.push_back(pairs.Draw(random));
    const ConfirmedLoop& loop = confirmed.back();
    sum += DecideAt({pairs.graph(), loop.query}, {pairs.graph(), loop.query},
                    options.similarity, Gate(StateSpace::kSpatial, 0.95),
                    loop.matched, 0)
               ->gate.squared_mahalanobis;
  }
  const Consistency consistency =
      EstimateConsistency(pairs.graph(), options, confirmed);
  EXPECT_EQ(consistency.confirmed, 7);
  EXPECT_EQ(consistency.degrees_of_freedom, 4);
  EXPECT_NEAR(*consistency.mean_normalized_innovation_squared, sum / 7.0,
              1e-12 * sum);
}

TEST(ConsistencyTest, APassTheOtherWayIsHeldAgainstTheTurnedHeading) {
  std::mt19937_64 random = SeededRandom();
  const ConsistencyOptions options = Independent();
  Pairs pairs(options.similarity, 1.0, 1.0);
  const ConfirmedLoop loop = pairs.Draw(random);
  PoseGraph turned;
  for (NodeIndex i : {loop.matched, loop.query}) {
    Node node = pairs.graph().node(i);
    if (i == loop.query) {
      node.pose.heading = WrapHeading(node.pose.heading + kPi);
    }
    turned.AddNode(node, true, std::nullopt);
  }
  const Consistency same = EstimateConsistency(pairs.graph(), options, {loop});
  const Consistency opposite = EstimateConsistency(turned, options, {{1, 0}});
  EXPECT_NEAR(*same.mean_normalized_innovation_squared,
              *opposite.mean_normalized_innovation_squared, 1e-9);
  EXPECT_NEAR(same.inflation, opposite.inflation, 1e-9);
}

TEST(ConsistencyTest, LeavesOutPairsWithoutAWellConditionedCovariance) {
  // Dead reckoning whose covariance shrinks makes that of a difference
  // indefinite.
  PoseGraph graph;
  for (int i = 0; i < 2; ++i) {
    Node node;
    for (int k : {0, 1, 3}) node.covariance(k, k) = i == 0 ? 400.0 : 0.01;
    graph.AddNode(node, i == 0, std::nullopt);
  }
  ConsistencyOptions options;
  const Consistency none = EstimateConsistency(graph, options, {});
  const Consistency one = EstimateConsistency(graph, options, {{1, 0}});
  EXPECT_EQ(one.confirmed, 0);
  EXPECT_EQ(one.inflation, none.inflation);
  EXPECT_EQ(one.mean_normalized_innovation_squared, std::nullopt);
}

}  // namespace
}  // namespace revisit::core
