#include "core/drive/confirmed_loop.h"

#include <gtest/gtest.h>

#include <cmath>

#include "core/drive/agreement.h"
#include "core/drive/pose_graph.h"
#include "core/geometry/state_matrix.h"
#include "core/noise/chi_squared.h"
#include "core/noise/similarity_model.h"
#include "tests/core/graphs.h"
#include "tests/oracle/wide_state.h"
#include "tests/random.h"

namespace revisit::core {
namespace {

constexpr CorrelationModel kEveryModel[] = {
    CorrelationModel::kDeadReckoning, CorrelationModel::kIndependent,
    CorrelationModel::kFilter, CorrelationModel::kCorrelatedFixes};

// Holds innovation and agreement against their definitions, in long numbers.
template <int D>
void ExpectInnovation(std::mt19937_64& random, CorrelationModel correlation,
                      int* agreements) {
  const PoseGraph graph =
      RandomGraph(random, 12, 0.1, 0, correlation == CorrelationModel::kFilter);
  const NodeIndex query = UniformInt(random, 1, 11);
  const NodeIndex matched = UniformInt(random, 0, static_cast<int>(query) - 1);
  ConfirmedLoop loop{query, matched};
  loop.measured =
      RandomMeasurement(random, EstimateAt(graph, query),
                        EstimateAt(graph, matched), Uniform(random, 0.1, 5.0));

  const oracle::WideClosure closure = oracle::WideMeasured(*loop.measured, D);
  const oracle::WideMatrix back = closure.lever.transpose();
  const oracle::WideMatrix mixed =
      oracle::WideCross(graph, correlation, query, matched, D) * back;
  const oracle::WideMatrix of_query =
      oracle::WideCovarianceOf(graph.covariance(query), D);
  const oracle::WideMatrix carried =
      closure.lever * oracle::WideCovarianceOf(graph.covariance(matched), D) *
      back;
  oracle::WideMatrix gamma = of_query + carried - mixed - mixed.transpose();
  if (correlation == CorrelationModel::kCorrelatedFixes) {
    gamma = (1.0L - oracle::WideShared(of_query, carried,
                                       graph.MetersApart(query, matched),
                                       correlation)) *
            (of_query + carried);
  }
  const Innovation<D> innovation = InnovationOf<D>(graph, correlation, loop);
  const double unit = static_cast<double>(gamma.norm());
  for (int r = 0; r < D; ++r) {
    EXPECT_NEAR(innovation.difference(r), static_cast<double>(closure.y(r)),
                1e-9);
    for (int c = 0; c < D; ++c) {
      EXPECT_NEAR(innovation.gamma(r, c), static_cast<double>(gamma(r, c)),
                  1e-9 * unit);
    }
  }

  SimilarityModel model;
  model.state_space = D == 3 ? StateSpace::kPlanar : StateSpace::kSpatial;
  model.correlation = correlation;
  model.inflation = Uniform(random, 1.0, 3.0);
  const auto form = oracle::EvaluateWide(
      static_cast<oracle::Wide>(model.inflation) * model.inflation * gamma +
          closure.tolerance,
      closure.y);
  const std::optional<Agreement> agreement = AgreementOf(graph, model, loop);
  if (!form || !agreement) return;
  ++*agreements;
  EXPECT_NEAR(
      agreement->squared_mahalanobis / static_cast<double>(form->squared), 1.0,
      1e-5);
  EXPECT_EQ(agreement->degrees_of_freedom, D);
  EXPECT_EQ(agreement->p_value,
            ChiSquaredAbove(D, agreement->squared_mahalanobis));
  EXPECT_EQ(agreement->inflation, model.inflation);
}

TEST(ConfirmedLoopTest, InnovationIsThatOfTheDefinitionInEveryModel) {
  std::mt19937_64 random = SeededRandom();
  for (const CorrelationModel model : kEveryModel) {
    int agreements = 0;
    for (int trial = 0; trial < 200; ++trial) {
      ExpectInnovation<3>(random, model, &agreements);
      ExpectInnovation<4>(random, model, &agreements);
    }
    EXPECT_GT(agreements, 20);
  }
}

TEST(ConfirmedLoopTest, ExactMeasurementOfExactPosesLeavesNothing) {
  MeasuredLoop loop;
  loop.matched.pose = {10.0, 20.0, 1.0, 0.5 * kPi};
  loop.query.pose = {7.0, 24.0, 3.0, -0.75 * kPi};
  // 4 m ahead of a vehicle that faces +y, and 3 m to its left.
  loop.measurement.relative = {4.0, 3.0, 2.0, 0.75 * kPi};
  const PoseEstimate carried = CarriedToQuery<4>(loop);
  EXPECT_NEAR(carried.pose.x, 7.0, 1e-12);
  EXPECT_NEAR(carried.pose.y, 24.0, 1e-12);
  EXPECT_NEAR(carried.pose.z, 3.0, 1e-12);
  EXPECT_NEAR(WrapHeading(carried.pose.heading - loop.query.pose.heading), 0.0,
              1e-12);
}

TEST(ConfirmedLoopTest, ErrorOfTheMatchedHeadingSwingsTheQuery) {
  // 100 m ahead of a vehicle that faces +x, known to 0.01 rad: 1 m in y.
  MeasuredLoop loop;
  loop.matched.covariance(3, 3) = 1e-4;
  loop.measurement.relative.x = 100.0;
  const PoseEstimate carried = CarriedToQuery<3>(loop);
  EXPECT_NEAR(carried.covariance(0, 0), 0.0, 1e-12);
  EXPECT_NEAR(carried.covariance(1, 1), 1.0, 1e-9);
  EXPECT_NEAR(carried.covariance(1, 3), 0.01, 1e-9);
  // The axes of the measurement turn with the vehicle.
  loop.measurement.covariance(0, 0) = 9.0;
  loop.measurement.covariance(1, 1) = 4.0;
  loop.matched.pose.heading = 0.5 * kPi;
  const StateMatrix<3> turned = MeasurementCovariance<3>(loop);
  EXPECT_NEAR(turned(0, 0), 4.0, 1e-12);
  EXPECT_NEAR(turned(1, 1), 9.0, 1e-12);
}

}  // namespace
}  // namespace revisit::core
