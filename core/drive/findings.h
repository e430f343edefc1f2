// The answers of a drive to the poses that were appended to it.
#ifndef REVISIT_CORE_DRIVE_FINDINGS_H_
#define REVISIT_CORE_DRIVE_FINDINGS_H_

#include <cmath>
#include <cstdint>
#include <optional>

#include "core/geometry/pose.h"

namespace revisit::core {

// A step that is too long for a vehicle (distance_resampler.h).
struct Jump {
  // The pose after the jump.
  std::uint64_t sequence = 0;
  double distance_meters = 0.0;
};

// A step forward of the stamps that is longer than the greatest age: once it is
// believed, all that came before is too old (stamps.h).
struct StampLeap {
  // The pose at or after the node behind the step.
  std::uint64_t sequence = 0;
  std::int64_t nanoseconds = 0;
};

// Standard deviations of a pose: metres, the mean of x and y, and radians.
struct Deviations {
  double meters = 0.0;
  double radians = 0.0;
};
// The variances of x and y together.
inline double PositionVariance(const Covariance& covariance) {
  return covariance(0, 0) + covariance(1, 1);
}
inline Deviations DeviationsOf(const Covariance& covariance) {
  return {std::sqrt(0.5 * PositionVariance(covariance)),
          std::sqrt(covariance(3, 3))};
}

// Claims that were given up where the pose went on (carried_claim.h).
struct ClaimsReset {
  // The first pose behind.
  std::uint64_t sequence = 0;
  Deviations before;
  Deviations after;
};

// Poses that go on in what looks like another frame (frame_watch.h).
struct NewFrame {
  // The first pose in it, at most a node early or late.
  std::uint64_t sequence = 0;
  // From the node before to the node behind the step that leads to it.
  double meters = 0.0;
  Deviations before;
  Deviations after;
  // Whether that shows by the claims; if not, by a return to the start.
  bool claims_fall = false;
  // Nothing without stamps.
  std::optional<std::int64_t> nanoseconds;
};

// By what poses contradict their settings (model_check.h).
enum class FindingCode {
  // Claims are to grow (NoiseModel), but few stretches do.
  kCovariancesDoNotGrow,
  // Claims are not to grow, but nearly all stretches do.
  kCovariancesGrow,
  // Errors are to be white, but most triples are smooth, and stretches do not
  // grow.
  kErrorsCorrelated,
  // The stamps go forward by more than the greatest age that is kept, whatever
  // the model.
  kStampsLeap,
  // Claims are to grow (NoiseModel), but from one pose on they, or the
  // positions, are those of another frame.
  kNewFrame,
  // Errors are to be carried on, but nearly no claim has what the swing of the
  // heading makes of them (carried_claim.h).
  kCovariancesWithoutLever,
  // Claims are to grow, but were given up where the pose went on.
  kCovariancesReset,
};

struct Finding {
  FindingCode code = FindingCode::kCovariancesDoNotGrow;
  // The share of growing stretches.
  double growing = 0.0;
  // How many times less than independent errors of the claimed covariances the
  // poses stray: the ratio of standard deviations that makes the share of
  // smooth triples what it is. At least 1; nothing where too few were seen.
  std::optional<double> smoother;
  // For kStampsLeap only.
  std::optional<StampLeap> leap;
  // For kNewFrame only.
  std::optional<NewFrame> frame;
  // For kCovariancesReset only.
  std::optional<ClaimsReset> reset;
};

}  // namespace revisit::core

#endif  // REVISIT_CORE_DRIVE_FINDINGS_H_
