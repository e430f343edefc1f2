#include "client/cli/evaluation/dead_reckoning.h"

#include <cmath>

#include "client/formats/angles.h"

namespace revisit::client {
namespace {

// Symmetric 3x3 matrix as xx, xy, xh, yy, yh, hh.
using Symmetric = std::array<double, 6>;

// F P F^T for a step (dx, dy).
Symmetric Carry(const Symmetric& p, double dx, double dy) {
  const auto& [xx, xy, xh, yy, yh, hh] = p;
  return {xx - 2.0 * dy * xh + dy * dy * hh,
          xy + dx * xh - dy * yh - dx * dy * hh,
          xh - dy * hh,
          yy + 2.0 * dx * yh + dx * dx * hh,
          yh + dx * hh,
          hh};
}

Symmetric Sum(const Symmetric& a, const Symmetric& b) {
  Symmetric sum;
  for (std::size_t i = 0; i < sum.size(); ++i) sum[i] = a[i] + b[i];
  return sum;
}

// G Q G^T for a step of this length in this direction.
Symmetric StepNoise(double length, double direction,
                    const UncertaintyOptions& options) {
  const double along = options.along * options.along * length;
  const double across = options.across * options.across * length;
  const double c = std::cos(direction);
  const double s = std::sin(direction);
  return {c * c * along + s * s * across,
          c * s * (along - across),
          0.0,
          s * s * along + c * c * across,
          0.0,
          options.heading * options.heading * length};
}

}  // namespace

absl::StatusOr<std::vector<ClaimedUncertainty>> ClaimUncertainty(
    const Drive& drive, const UncertaintyOptions& options) {
  using Source = UncertaintyOptions::Source;
  const bool from_file = options.source != Source::kModel;
  const double scale = options.claimed_scale * options.claimed_scale;
  const double position_variance =
      options.start_position * options.start_position;
  Symmetric carried = {
      position_variance, 0.0, 0.0,
      position_variance, 0.0, options.start_heading * options.start_heading};
  double distance = 0.0;
  std::vector<ClaimedUncertainty> claims;
  claims.reserve(drive.samples.size());
  const DriveSample* previous = nullptr;
  for (const DriveSample& sample : drive.samples) {
    if (previous != nullptr) {
      const PlanarPose& from = previous->estimate;
      const PlanarPose& to = sample.estimate;
      const double dx = to.x - from.x;
      const double dy = to.y - from.y;
      const double length = std::hypot(dx, dy);
      distance += length;
      carried = Carry(carried, dx, dy);
      if (!from_file) {
        const double turn =
            std::remainder(to.heading - from.heading, 2.0 * kPi);
        carried =
            Sum(carried, StepNoise(length, from.heading + 0.5 * turn, options));
      }
    }
    ClaimedUncertainty claim;
    claim.planar = carried;
    if (from_file) {
      if (!sample.covariance.has_value()) {
        return absl::InvalidArgumentError(
            drive.name +
            ": has no covariance columns (pxx, pxy, pxt, pyy, pyt, ptt)");
      }
      claim.planar = options.source == Source::kFixes
                         ? *sample.covariance
                         : Sum(carried, *sample.covariance);
    }
    claim.z_variance = position_variance + options.up * options.up * distance;
    for (double& entry : claim.planar) entry *= scale;
    claim.z_variance *= scale;
    claims.push_back(claim);
    previous = &sample;
  }
  return claims;
}

}  // namespace revisit::client
