#include "client/trajectory/dead_reckoning.h"

#include <cmath>
#include <utility>

#include "absl/strings/str_cat.h"
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

Symmetric StartCovariance(const UncertaintyOptions& options) {
  const double position = options.start_position * options.start_position;
  return {position, 0.0, 0.0,
          position, 0.0, options.start_heading * options.start_heading};
}

void Scale(double factor, ClaimedUncertainty* claim) {
  const double squared = factor * factor;
  for (double& entry : claim->planar) entry *= squared;
  for (double& entry : claim->z_mixed) entry *= squared;
  claim->z_variance *= squared;
}

}  // namespace

UncertaintyClaims::UncertaintyClaims(const UncertaintyOptions& options,
                                     std::string name)
    : options_(options),
      name_(std::move(name)),
      carried_(StartCovariance(options)) {}

void UncertaintyClaims::ContinueFrom(const PlanarPose& pose,
                                     const std::array<double, 6>& covariance) {
  is_first_ = true;
  previous_ = pose;
  carried_ = covariance;
  // Scaled once more when it is claimed.
  const double scale = options_.claimed_scale * options_.claimed_scale;
  for (double& entry : carried_) entry /= scale;
}

void UncertaintyClaims::BeginRecording(const std::string& name) {
  name_ = name;
  if (!previous_.has_value()) return;
  is_first_ = true;
  // The columns of a file begin with certainty.
  if (options_.source == UncertaintyOptions::Source::kFile) carried_ = claimed_;
}

void UncertaintyClaims::BeginFrame() {
  is_first_ = false;
  previous_.reset();
  carried_ = StartCovariance(options_);
  claimed_ = {};
  distance_ = 0.0;
}

std::string UncertaintyClaims::PlaceOf(const Sample& sample) const {
  return sample.line > 0 ? absl::StrCat(name_, ":", sample.line) : name_;
}

absl::StatusOr<Symmetric> UncertaintyClaims::StatedBy(
    const Sample& sample) const {
  if (sample.covariance.has_value()) return *sample.covariance;
  const bool fixes = options_.source == UncertaintyOptions::Source::kFixes;
  if (fixes &&
      (sample.heading_variance.has_value() || sample.geodetic.has_value())) {
    const double position = options_.fix_position * options_.fix_position;
    const double heading = options_.start_heading * options_.start_heading;
    return Symmetric{position, 0.0, 0.0,
                     position, 0.0, sample.heading_variance.value_or(heading)};
  }
  return absl::InvalidArgumentError(absl::StrCat(
      PlaceOf(sample),
      ": has no covariance (columns pxx, pxy, pxt, pyy, pyt, ptt, or what "
      "the format has in their place); --uncertainty model makes one"));
}

absl::Status UncertaintyClaims::FromFile(const Sample& sample,
                                         ClaimedUncertainty* claim) const {
  const bool fixes = options_.source == UncertaintyOptions::Source::kFixes;
  const auto covariance = StatedBy(sample);
  if (!covariance.ok()) return covariance.status();
  if (!sample.covariance.has_value()) claim->z_variance = (*covariance)[0];
  const auto& [xx, xy, xh, yy, yh, hh] = *covariance;
  if (fixes && !(xx > 0.0 && yy > 0.0 && hh > 0.0)) {
    return absl::InvalidArgumentError(absl::StrCat(
        PlaceOf(sample), ": expected positive variances of a fix, got ", xx,
        ", ", yy, " and ", hh,
        "; --uncertainty file adds those of the start, --uncertainty model "
        "makes all"));
  }
  claim->planar = fixes ? *covariance : Sum(carried_, *covariance);
  if (sample.covariance_36.has_value()) {
    const auto& c = *sample.covariance_36;
    const double zz = c[14];
    if (zz > 0.0) claim->z_variance = zz + (fixes ? 0.0 : claim->z_variance);
    if (zz > 0.0) claim->z_mixed = {c[2], c[8], c[17]};
  }
  if (fixes && sample.height_covariance.has_value()) {
    const auto& [xz, yz, zz] = *sample.height_covariance;
    claim->z_variance = zz;
    claim->z_mixed = {xz, yz, 0.0};
  }
  return absl::OkStatus();
}

absl::StatusOr<ClaimedUncertainty> UncertaintyClaims::Next(
    const Sample& sample) {
  const bool from_file = options_.source != UncertaintyOptions::Source::kModel;
  if (previous_.has_value()) {
    const PlanarPose& from = *previous_;
    const PlanarPose& to = sample.estimate;
    const double dx = to.x - from.x;
    const double dy = to.y - from.y;
    const double length = std::hypot(dx, dy);
    distance_ += length;
    carried_ = Carry(carried_, dx, dy);
    if (!from_file) {
      const double turn = std::remainder(to.heading - from.heading, 2.0 * kPi);
      carried_ =
          Sum(carried_, StepNoise(length, from.heading + 0.5 * turn, options_));
    }
  }
  if (is_first_ && options_.start_is_given) {
    carried_ = Sum(carried_, StartCovariance(options_));
  }
  is_first_ = false;
  previous_ = sample.estimate;
  ClaimedUncertainty claim;
  claim.planar = carried_;
  claim.z_variance = options_.start_position * options_.start_position +
                     options_.up * options_.up * distance_;
  if (from_file) {
    if (absl::Status status = FromFile(sample, &claim); !status.ok()) {
      return status;
    }
  }
  claimed_ = claim.planar;
  Scale(options_.claimed_scale, &claim);
  return claim;
}

void ScaleClaims(double factor, std::vector<ClaimedUncertainty>* claims) {
  for (ClaimedUncertainty& claim : *claims) Scale(factor, &claim);
}

absl::StatusOr<std::vector<ClaimedUncertainty>> ClaimUncertainty(
    const Drive& drive, const UncertaintyOptions& options) {
  UncertaintyClaims source(options, drive.name);
  std::vector<ClaimedUncertainty> claims;
  claims.reserve(drive.samples.size());
  for (const Sample& sample : drive.samples) {
    const auto claim = source.Next(sample);
    if (!claim.ok()) return claim.status();
    claims.push_back(*claim);
  }
  return claims;
}

}  // namespace revisit::client
