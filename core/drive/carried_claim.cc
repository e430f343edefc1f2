#include "core/drive/carried_claim.h"

#include <algorithm>
#include <cmath>

#include "core/drive/findings.h"
#include "core/drive/frame_watch.h"
#include "core/geometry/quadratic_form.h"
#include "core/geometry/state_matrix.h"
#include "core/noise/dead_reckoning.h"

namespace revisit::core {
namespace {

// Correlations of heading and position below this are none.
constexpr double kNoCorrelation = 1e-3;
// A covariance of heading and position that is less than this share of what
// would be carried on was left out, and not taken back by other noise.
constexpr double kLeftOut = 0.1;
// A step that is shorter than this share of the standard deviation that is
// given up takes no error back: a normal error in the plane is as small once in
// thirty times.
constexpr double kUnmoved = 0.25;

// Noise of the position is at most so many times its least variance. A claim
// that grows with the square of the way, or as it would without turns, is not
// noise of single steps, which would never leave the path again.
constexpr double kMostOfPosition = 4.0;

double MetersBetween(const ClaimedPose& a, const ClaimedPose& b) {
  return std::hypot(b.pose.x - a.pose.x, b.pose.y - a.pose.y);
}

// Whether the variances of position and heading both fall, as for FrameWatch.
// Where the pose leaps, the heading's need not, since a compass lets it stay.
bool Falls(const ClaimedPose& before, const ClaimedPose& after) {
  constexpr double kFall = FrameWatch::kFall;
  if (!(kFall * PositionVariance(after.claim) <
        PositionVariance(before.claim))) {
    return false;
  }
  const double was = before.claim(3, 3);
  const double is = after.claim(3, 3);
  return kFall * is < was ||
         (is <= was && MetersBetween(before, after) >= FrameWatch::kLeapMeters);
}

// Whether the pose moves so little that the step takes no error back of the
// claim that falls on it.
bool IsUnmoved(const ClaimedPose& before, const ClaimedPose& after) {
  const double given_up =
      PositionVariance(before.claim) - PositionVariance(after.claim);
  const double meters = MetersBetween(before, after);
  return meters * meters < kUnmoved * kUnmoved * 0.5 * given_up;
}

// The covariance that a straight step of so many metres adds. An error of the
// heading that comes evenly over its length swings half of it, on average.
template <int D>
StateMatrix<D> NoiseOfStep(const Pose& from, const Pose& to, double meters,
                           double along, double across, double heading) {
  StateMatrix<D> noise = StateMatrix<D>::Zero();
  noise(0, 0) = along;
  noise(1, 1) = across + heading * meters * meters / 3.0;
  noise(1, D - 1) = noise(D - 1, 1) = 0.5 * heading * meters;
  noise(D - 1, D - 1) = heading;
  return Turned<D>(noise, std::atan2(to.y - from.y, to.x - from.x));
}

// The noise of a step whose claims tell of it by their variances alone.
template <int D>
StateMatrix<D> NoiseByVariances(const ClaimedPose& before,
                                const ClaimedPose& after,
                                double greatest_heading,
                                const StateMatrix<D>& carried) {
  constexpr ReckoningNoise kUsual = kUsualReckoning;
  constexpr double kAlong = kUsual.along * kUsual.along;
  constexpr double kAcross = kUsual.across * kUsual.across;
  const double meters = MetersBetween(before, after);
  const double usual_heading = kUsual.heading * kUsual.heading * meters;
  const double grown = after.claim(3, 3) - greatest_heading;
  const double heading = grown > 0.0 ? grown : usual_heading;
  // An odometer that is better than usual in heading may be so in position.
  const double share = heading < usual_heading ? heading / usual_heading : 1.0;
  const double least = share * (kAlong + kAcross) * meters;
  const double missing =
      PositionVariance(after.claim) - (carried(0, 0) + carried(1, 1));
  const double position = std::clamp(missing, least, kMostOfPosition * least);
  constexpr double kAhead = kAlong / (kAlong + kAcross);
  StateMatrix<D> noise =
      NoiseOfStep<D>(before.pose, after.pose, meters, kAhead * position,
                     (1.0 - kAhead) * position, heading);
  if constexpr (D == 4) {
    noise(2, 2) = std::max(0.0, after.claim(2, 2) - before.claim(2, 2));
  }
  return noise;
}

template <int D>
std::optional<CarriedCovariance> CarriedIn(const ClaimedPose& before,
                                           const CarriedCovariance* in_force,
                                           const ClaimedPose& after) {
  const Covariance& source =
      in_force == nullptr ? before.claim : in_force->covariance;
  const bool falls = Falls(before, after);
  const bool is_given_up = falls && IsUnmoved(before, after);
  // Claims that do not count as they are may go up and down without any reason.
  if (falls && !is_given_up &&
      (in_force == nullptr ||
       MetersBetween(before, after) >= FrameWatch::kLeapMeters)) {
    return std::nullopt;
  }
  const double lever_x = -(after.pose.y - before.pose.y);
  const double lever_y = after.pose.x - before.pose.x;
  const bool lacks_lever =
      LacksLever(after.claim, source(0, 3) + lever_x * source(3, 3),
                 source(1, 3) + lever_y * source(3, 3));
  // Most claims count, and nothing more is made of them.
  if (in_force == nullptr && !lacks_lever && !is_given_up) return std::nullopt;
  const StateMatrix<D> carried =
      Swung<D>(ToMatrix<D>(source), lever_x, lever_y);
  const double greatest_heading =
      in_force == nullptr ? before.claim(3, 3) : in_force->greatest_heading;
  const auto with = [&](const StateMatrix<D>& noise) {
    return CarriedCovariance{ToCovariance<D>(Symmetric<D>(carried + noise)),
                             std::max(greatest_heading, after.claim(3, 3))};
  };
  if (lacks_lever) {
    return with(NoiseByVariances<D>(before, after, greatest_heading, carried));
  }
  if (is_given_up) return with(StateMatrix<D>::Zero());
  const StateMatrix<D> claimed = ToMatrix<D>(after.claim);
  if (IsPositiveDefinite<D>(claimed - carried)) return std::nullopt;
  StateMatrix<D> noise =
      claimed - Swung<D>(ToMatrix<D>(before.claim), before.pose, after.pose);
  if (!IsPositiveDefinite<D>(noise)) noise.setZero();
  return with(noise);
}

}  // namespace

bool LacksLever(const Covariance& claim, double carried_xh, double carried_yh) {
  const double xh = claim(0, 3);
  const double yh = claim(1, 3);
  const double squared = xh * xh + yh * yh;
  return squared <= kNoCorrelation * kNoCorrelation * PositionVariance(claim) *
                        claim(3, 3) &&
         squared < kLeftOut * kLeftOut *
                       (carried_xh * carried_xh + carried_yh * carried_yh);
}

bool IsGivenUp(const ClaimedPose& before, const ClaimedPose& after) {
  return Falls(before, after) && IsUnmoved(before, after);
}

std::optional<CarriedCovariance> CarriedClaim(StateSpace space,
                                              const ClaimedPose& before,
                                              const CarriedCovariance* in_force,
                                              const ClaimedPose& after) {
  return space == StateSpace::kPlanar ? CarriedIn<3>(before, in_force, after)
                                      : CarriedIn<4>(before, in_force, after);
}

}  // namespace revisit::core
