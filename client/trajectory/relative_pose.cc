#include "client/trajectory/relative_pose.h"

#include <Eigen/Cholesky>
#include <Eigen/Eigenvalues>
#include <Eigen/Geometry>
#include <algorithm>
#include <cmath>

#include "client/formats/angles.h"

namespace revisit::client {
namespace {

using Matrix4 = Eigen::Matrix<double, 4, 4, Eigen::RowMajor>;
using Eigen::Matrix3d;
using Eigen::Matrix4d;
using Eigen::Vector3d;
using Eigen::Vector4d;

Matrix4d ToMatrix(const StateMatrix& array) {
  return Eigen::Map<const Matrix4>(array.data());
}

StateMatrix ToStateMatrix(const Matrix4d& m) {
  StateMatrix array;
  Eigen::Map<Matrix4>(array.data()) = m;
  return array;
}

Vector3d ToVector(const std::array<double, 3>& v) { return {v[0], v[1], v[2]}; }

Matrix3d TurnBy(double angle) {
  return Eigen::AngleAxisd(angle, Vector3d::UnitZ()).toRotationMatrix();
}

// A state turned about z.
Matrix4d StateTurnBy(double angle) {
  Matrix4d turn = Matrix4d::Identity();
  turn.topLeftCorner<3, 3>() = TurnBy(angle);
  return turn;
}

Matrix3d RotationOf(const LocalPose& pose) {
  const auto& [x, y, z, w] = pose.orientation;
  return Eigen::Quaterniond(w, x, y, z).toRotationMatrix();
}

// Roll and pitch: the orientation, levelled axes taken away.
Matrix3d TiltOf(const LocalPose& pose) {
  return TurnBy(-pose.heading) * RotationOf(pose);
}

RelativePose Between(const LocalPose& from, const LocalPose& to) {
  RelativePose relative;
  const Vector3d ahead =
      TurnBy(-from.heading) * (ToVector(to.position) - ToVector(from.position));
  relative.position = {ahead.x(), ahead.y(), ahead.z()};
  relative.heading = std::remainder(to.heading - from.heading, 2.0 * kPi);
  return relative;
}

// Carries an error of `from` over to `to` as one rigid body.
Matrix4d LeverBetween(const LocalPose& from, const LocalPose& to) {
  Matrix4d lever = Matrix4d::Identity();
  lever(0, 3) = -(to.position[1] - from.position[1]);
  lever(1, 3) = to.position[0] - from.position[0];
  return lever;
}

double Distance(const LocalPose& from, const LocalPose& to) {
  return (ToVector(to.position) - ToVector(from.position)).norm();
}

// The ratio of the geometric to the arithmetic mean.
double RatioOfMeans(double a, double b) {
  return 2.0 * std::sqrt(a * b) / (a + b);
}

// The share of two fixes' covariances that is left in their difference, as the
// searches have it (core/noise/correlated_fixes.h).
double UncorrelatedShare(const Matrix4d& a, const Matrix4d& b, double meters,
                         const v1::VehicleSettings& settings) {
  const auto position = [](const Matrix4d& m) {
    return m.topLeftCorner<2, 2>().trace();
  };
  const double alike = std::min(RatioOfMeans(position(a), position(b)),
                                RatioOfMeans(a(3, 3), b(3, 3)));
  return 1.0 - alike * std::exp(-meters / settings.fix_correlation_meters());
}

// Each model of the API has a case in StepCovariance(): a new one must get its
// own before this compiles again.
static_assert(v1::CorrelationModel_MAX ==
              v1::CORRELATION_MODEL_CORRELATED_FIXES);

// The covariance that the model leaves of the two, in the axes of the local
// frame.
Matrix4d StepCovariance(const LocalPose& from, const LocalPose& to,
                        const v1::VehicleSettings& settings) {
  const Matrix4d lever = LeverBetween(from, to);
  const Matrix4d earlier = ToMatrix(from.covariance);
  const Matrix4d carried = lever * earlier * lever.transpose();
  const Matrix4d later = ToMatrix(to.covariance);
  switch (settings.correlation_model()) {
    case v1::CORRELATION_MODEL_UNSPECIFIED:
    case v1::CORRELATION_MODEL_DEAD_RECKONING:
      return later - carried;
    case v1::CORRELATION_MODEL_FILTER: {
      if (!to.error_transition) return later - carried;
      const Matrix4d common =
          lever * earlier * ToMatrix(*to.error_transition).transpose();
      return later + carried - common - common.transpose();
    }
    case v1::CORRELATION_MODEL_CORRELATED_FIXES:
      return UncorrelatedShare(earlier, later, Distance(from, to), settings) *
             (later + carried);
    case v1::CORRELATION_MODEL_INDEPENDENT:
    default:
      // A newer server may have a model that this client does not know. It is
      // not refused, since poses and closures are as good as ever; it counts as
      // independent, since what the two errors share is unknown and an edge
      // that is too loose misleads an optimiser less than one too tight.
      return later + carried;
  }
}

// Raises a covariance to the least one; answers whether it had to.
bool Raise(bool spatial, Matrix4d* covariance) {
  Vector4d least(kLeastStepMeters, kLeastStepMeters, kLeastStepMeters,
                 kLeastStepRadians);
  // There is nothing to raise where the state has no z.
  if (!spatial) (*covariance)(2, 2) = least(2) * least(2);
  const Vector4d inverse = least.cwiseInverse();
  const Matrix4d scaled =
      inverse.asDiagonal() * *covariance * inverse.asDiagonal();
  const Eigen::SelfAdjointEigenSolver<Matrix4d> solver(
      0.5 * (scaled + scaled.transpose()));
  // Rounding is no raise.
  const bool raised = solver.eigenvalues().minCoeff() < 1.0 - 1e-9;
  const Matrix4d& axes = solver.eigenvectors();
  *covariance = least.asDiagonal() *
                (axes * solver.eigenvalues().cwiseMax(1.0).asDiagonal() *
                 axes.transpose()) *
                least.asDiagonal();
  if (!spatial) {
    covariance->row(2).setZero();
    covariance->col(2).setZero();
  }
  return raised;
}

}  // namespace

Step StepBetween(const LocalPose& from, const LocalPose& to,
                 const v1::VehicleSettings& settings) {
  Step step;
  step.relative = Between(from, to);
  Matrix4d covariance = StepCovariance(from, to, settings);
  step.raised =
      Raise(settings.state_space() == v1::STATE_SPACE_SPATIAL, &covariance);
  const Matrix4d turn = StateTurnBy(-from.heading);
  step.relative.covariance =
      ToStateMatrix(turn * covariance * turn.transpose());
  return step;
}

RelativePose JumpBetween(const LocalPose& from, const LocalPose& to) {
  RelativePose jump = Between(from, to);
  const double squared = ToVector(jump.position).squaredNorm();
  jump.covariance = ToStateMatrix(
      Vector4d(squared, squared, squared, kPi * kPi).asDiagonal());
  return jump;
}

RelativePose GapBefore(const LocalPose& to, const v1::RecordingStart& start,
                       v1::StateSpace state_space) {
  // RecordingStart has what is assumed where it says nothing.
  constexpr double kUsualMeters = 10.0;
  constexpr double kUsualRadians = 0.3;
  const Vector4d usual(kUsualMeters, kUsualMeters, kUsualMeters, kUsualRadians);
  Matrix4d covariance = start.has_after()
                            ? ToMatrix(StateCovariance(start.after()))
                            : Matrix4d(usual.cwiseAbs2().asDiagonal());
  Raise(state_space == v1::STATE_SPACE_SPATIAL, &covariance);
  // The two head the same way, so the axes of the one are those of the other.
  const Matrix4d turn = StateTurnBy(-to.heading);
  RelativePose gap;
  gap.covariance = ToStateMatrix(turn * covariance * turn.transpose());
  return gap;
}

RelativePose DatumsBetween(const LocalPose& from, const v1::Datum& from_datum,
                           const LocalPose& to, const v1::Datum& to_datum,
                           v1::StateSpace state_space) {
  const bool is_same = !to_datum.datum_id().empty() &&
                       to_datum.datum_id() == from_datum.datum_id();
  const auto placed = [is_same](const LocalPose& pose, const v1::Datum& datum) {
    LocalPose shared = InOuterFrame(pose, datum.pose());
    if (!is_same) {
      shared.covariance =
          ToStateMatrix(ToMatrix(shared.covariance) +
                        ToMatrix(StateCovariance(datum.covariance())));
    }
    return shared;
  };
  v1::VehicleSettings unrelated;
  unrelated.set_state_space(state_space);
  unrelated.set_correlation_model(v1::CORRELATION_MODEL_INDEPENDENT);
  return StepBetween(placed(from, from_datum), placed(to, to_datum), unrelated)
      .relative;
}

RelativePose ClosureBetween(const v1::LoopClosure& closure,
                            const LocalPose& matched, const LocalPose& query) {
  // The search takes closures without a measurement to be so uncertain too
  // (kConfirmedTolerance of core/search/alignment/known_drift.h).
  constexpr double kSigmaMeters = 5.0;
  constexpr double kSigmaRadians = 0.15;
  RelativePose relative;
  if (!closure.has_measurement()) {
    if (std::cos(query.heading - matched.heading) < 0.0) relative.heading = kPi;
    Vector4d sigmas(kSigmaMeters, kSigmaMeters, kSigmaMeters, kSigmaRadians);
    relative.covariance = ToStateMatrix(sigmas.cwiseAbs2().asDiagonal());
    return relative;
  }
  const v1::LoopClosureMeasurement& measured = closure.measurement();
  relative.position = {measured.x_meters(), measured.y_meters(),
                       measured.z_meters()};
  relative.heading = measured.heading_radians();
  relative.covariance = StateCovariance(measured.covariance());
  return relative;
}

std::array<double, 6> PlanarInformation(const RelativePose& relative) {
  const Matrix4d turn = StateTurnBy(-relative.heading);
  const Matrix4d turned =
      turn * ToMatrix(relative.covariance) * turn.transpose();
  constexpr int kPlaces[3] = {0, 1, 3};
  Matrix3d covariance;
  for (int r = 0; r < 3; ++r) {
    for (int c = 0; c < 3; ++c) {
      covariance(r, c) = turned(kPlaces[r], kPlaces[c]);
    }
  }
  const Matrix3d m = covariance.llt().solve(Matrix3d::Identity());
  return {m(0, 0), m(0, 1), m(0, 2), m(1, 1), m(1, 2), m(2, 2)};
}

SpatialEdge SpatialEdgeOf(const RelativePose& relative, const LocalPose& from,
                          const LocalPose& to) {
  using Matrix6d = Eigen::Matrix<double, 6, 6>;
  const Matrix3d level = TiltOf(from).transpose();
  const Matrix3d turned = TurnBy(relative.heading) * TiltOf(to);
  const Vector3d position = level * ToVector(relative.position);
  const Eigen::Quaterniond orientation(Matrix3d(level * turned));
  constexpr int kPlaces[4] = {0, 1, 2, 5};
  const Matrix4d state = ToMatrix(relative.covariance);
  Matrix6d covariance = Matrix6d::Zero();
  covariance(3, 3) = covariance(4, 4) = state(3, 3);
  for (int r = 0; r < 4; ++r) {
    for (int c = 0; c < 4; ++c) {
      covariance(kPlaces[r], kPlaces[c]) = state(r, c);
    }
  }
  Matrix6d turn = Matrix6d::Zero();
  turn.topLeftCorner<3, 3>() = turn.bottomRightCorner<3, 3>() =
      turned.transpose();
  const Matrix6d m =
      (turn * covariance * turn.transpose()).llt().solve(Matrix6d::Identity());
  SpatialEdge edge;
  edge.position = {position.x(), position.y(), position.z()};
  edge.orientation = {orientation.x(), orientation.y(), orientation.z(),
                      orientation.w()};
  std::size_t next = 0;
  for (int r = 0; r < 6; ++r) {
    for (int c = r; c < 6; ++c) edge.information[next++] = m(r, c);
  }
  return edge;
}

}  // namespace revisit::client
