// The covariances by which a drive goes where errors are carried on: its poses'
// own claims, as long as they can be those of dead reckoning.
//
// Drivers of odometry often send claims of another shape, and comparing two
// passes takes the difference of such covariances for that of their errors.
// Two kinds can be told by the claims alone, step by step:
//
// - Claims without a lever. An error of the heading swings all that follows, so
//   dead reckoning makes the errors of heading and position depend on each
//   other. A driver that sends a diagonal has left that out, whatever its
//   variances are: those of a filter, a share of the way, or constants.
// - Claims that are given up. The variances of position and heading fall at
//   once, but the pose goes on as before. An error that is taken back moves the
//   pose by about its own size; here only the claim was begun anew. (Claims
//   that fall where the pose leaps count as they are: frame_watch.h.)
//
// From there on the covariance before is carried on by dead reckoning, and the
// claims say how much noise each step adds:
//
// - Heading: by how much its variance exceeds all that was claimed before.
//   Where it does not, as where it stays the same or goes up and down, nobody
//   has claimed anything of the step: then it adds that of kUsualReckoning.
// - Position: as much as its variance is larger than what was carried on,
//   which is all that the noise of the headings has made of it; at least what
//   goes with the noise of the heading, and at most four times that.
//
// The first claim of each recording counts as it is. Claims that become those
// of dead reckoning count again once they are no surer than what was carried.
// Over a jump, and over poses that are not there, the step is the straight line
// between the two poses.
#ifndef REVISIT_CORE_DRIVE_CARRIED_CLAIM_H_
#define REVISIT_CORE_DRIVE_CARRIED_CLAIM_H_

#include <optional>

#include "core/geometry/heading.h"
#include "core/geometry/pose.h"
#include "core/geometry/state_space.h"

namespace revisit::core {

// The noise of a road vehicle's odometry, standard deviations per square root
// of a metre: 0.1 m along the path, 0.05 m across and 0.1 degree.
struct ReckoningNoise {
  double along = 0.1;
  double across = 0.05;
  double heading = 0.1 * kPi / 180.0;
};
inline constexpr ReckoningNoise kUsualReckoning;

// A pose with what it claims.
struct ClaimedPose {
  Pose pose;
  Covariance claim;
};

// Whether a claim leaves out what the swing of the heading's error makes of it:
// it has next to no covariance of heading and position, and a pose that is
// carried on would have this much (the covariances of x and y with heading).
bool LacksLever(const Covariance& claim, double carried_xh, double carried_yh);

// Whether the claim of the pose before was given up on the step to this one.
bool IsGivenUp(const ClaimedPose& before, const ClaimedPose& after);

// A covariance that counts in place of a claim.
struct CarriedCovariance {
  Covariance covariance;
  // The greatest variance of the heading that was claimed since claims have not
  // counted.
  double greatest_heading = 0.0;
};

// The covariance in force after a step from a pose where `in_force` was; null
// stands for the claim itself. Nothing, again for the claim itself, where that
// can be one of dead reckoning. REQUIRES: both poses are of one recording;
// covariances are positive definite.
std::optional<CarriedCovariance> CarriedClaim(StateSpace space,
                                              const ClaimedPose& before,
                                              const CarriedCovariance* in_force,
                                              const ClaimedPose& after);

}  // namespace revisit::core

#endif  // REVISIT_CORE_DRIVE_CARRIED_CLAIM_H_
