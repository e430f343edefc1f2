// The answers of a drive to the poses that were appended to it.
#ifndef REVISIT_CORE_DRIVE_FINDINGS_H_
#define REVISIT_CORE_DRIVE_FINDINGS_H_

#include <cstdint>
#include <optional>

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

// Poses that go on in what looks like another frame (frame_watch.h).
struct NewFrame {
  // Standard deviations of a pose: metres, the mean of x and y, and radians.
  struct Claims {
    double meters = 0.0;
    double radians = 0.0;
  };

  // The first pose in it, at most a node early or late.
  std::uint64_t sequence = 0;
  // From the node before to the node behind the step that leads to it.
  double meters = 0.0;
  Claims before;
  Claims after;
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
};

}  // namespace revisit::core

#endif  // REVISIT_CORE_DRIVE_FINDINGS_H_
