// A pose of the vehicle, its covariance, and the rules for valid ones.
//
// The state of a pose is (x, y, z, heading), in this order: metres and radians
// in the vehicle's local frame, right-handed with z up, heading
// counter-clockwise from +x. SPATIAL uses all four coordinates; PLANAR leaves z
// out, wherever it appears.
#ifndef REVISIT_CORE_GEOMETRY_POSE_H_
#define REVISIT_CORE_GEOMETRY_POSE_H_

#include <array>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <limits>
#include <memory>
#include <optional>
#include <string>

#include "core/geometry/state_space.h"

namespace revisit::core {

struct Pose {
  double x = 0.0;
  double y = 0.0;
  double z = 0.0;
  double heading = 0.0;
};

// a - b, heading wrapped to (-pi, pi].
Pose Difference(const Pose& a, const Pose& b);

// Distance between the positions, in the state space: PLANAR ignores z.
double Distance(const Pose& a, const Pose& b, StateSpace space);

// Covariance of a pose's error, in the fixed axes of the local frame: the upper
// triangle by rows, xx xy xz xh yy yz yh zz zh hh.
struct Covariance {
  std::array<double, 10> upper{};

  double operator()(int row, int column) const {
    return upper[Index(row, column)];
  }
  double& operator()(int row, int column) { return upper[Index(row, column)]; }

  static constexpr std::size_t Index(int row, int column) {
    const int r = row < column ? row : column;
    const int c = row < column ? column : row;
    return static_cast<std::size_t>(r * (7 - r) / 2 + c);
  }
};

// The least and the greatest variance in any direction of the plane: the
// eigenvalues of the covariance ((xx, xy), (xy, yy)).
struct VarianceRange {
  double least = 0.0;
  double most = 0.0;
};
inline VarianceRange VariancesInAnyDirection(double xx, double xy, double yy) {
  const double mean = 0.5 * (xx + yy);
  const double spread = std::hypot(0.5 * (xx - yy), xy);
  return {mean - spread, mean + spread};
}

// The matrix that carries the error of one pose into the error of the next:
// row-major 4x4 over (x, y, z, heading). For PLANAR, the row and column of z
// are not used.
struct ErrorTransition {
  std::array<double, 16> values{1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1};
};

struct RecordingStart;

// One pose of the stream, as the estimator reports it.
struct PoseSample {
  // 1, 2, 3, ... without a gap.
  std::uint64_t sequence = 0;
  // Nanoseconds of any clock; carried along, never compared.
  std::optional<std::int64_t> stamp_ns;
  Pose pose;
  Covariance covariance;
  // The transition from the pose before to this one. For the FILTER correlation
  // model only.
  std::optional<ErrorTransition> transition;
  // Where the pose is the first of a recording (recording_start.h); else null.
  std::shared_ptr<const RecordingStart> recording_start = nullptr;
};

// Why a pose is refused.
enum class DefectKind {
  kNotFinite,
  kOutOfRange,
  kNotSymmetric,
  kNotPositiveDefinite,
};

struct Defect {
  DefectKind kind;
  // "position", "heading", "covariance" or "error_transition".
  std::string part;
  // The value that was given and those that are allowed: a sentence without a
  // full stop.
  std::string description;
};

// Limits of the values of a valid pose.
inline constexpr double kMaxCoordinateMeters = 1e8;
inline constexpr double kMaxHeadingRadians = 1e6;
inline constexpr double kMaxStandardDeviation = 1e9;
inline constexpr double kMaxTransitionEntry = 1e9;
// Largest difference of mirrored entries, relative to the largest entry.
inline constexpr double kSymmetryTolerance = 1e-9;
// Smallest pivot of the correlation matrix that counts as positive definite.
inline constexpr double kPivotTolerance = 1e-12;

// The first defect of a sample in this state space, or nothing: all values must
// be finite and in range, and the covariance positive definite.
std::optional<Defect> FindDefect(const PoseSample& sample, StateSpace space);

// Whether FindDefect() finds none in this covariance; faster.
bool IsSound(const Covariance& covariance, StateSpace space);

// The defect of a size x size row-major matrix that is not finite or not
// symmetric, or nothing.
std::optional<Defect> FindAsymmetry(const double* matrix, int size);

}  // namespace revisit::core

#endif  // REVISIT_CORE_GEOMETRY_POSE_H_
