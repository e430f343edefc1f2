#include "client/formats/restart_watch.h"

#include <array>
#include <cmath>
#include <utility>

#include "client/formats/angles.h"

namespace revisit::client {
namespace {

double MetersBetween(const PlanarPose& a, const PlanarPose& b) {
  return std::hypot(b.x - a.x, b.y - a.y);
}

// The variances of the position and of the heading in a covariance of the
// planar pose.
double OfPosition(const std::array<double, 6>& c) { return c[0] + c[3]; }
double OfHeading(const std::array<double, 6>& c) { return c[5]; }

// The variance of the position after a way, by dead reckoning without noise.
double CarriedVariance(const Sample& from, const PlanarPose& to) {
  const auto& [xx, xy, xh, yy, yh, hh] = *from.covariance;
  const double dx = to.x - from.estimate.x;
  const double dy = to.y - from.estimate.y;
  return xx + yy + 2.0 * (dx * yh - dy * xh) + (dx * dx + dy * dy) * hh;
}

class RestartReader : public SampleReader {
 public:
  explicit RestartReader(std::unique_ptr<SampleReader> reader)
      : reader_(std::move(reader)) {}

  absl::StatusOr<std::optional<Sample>> Next() override {
    auto sample = reader_->Next();
    if (sample.ok() && sample->has_value()) {
      (*sample)->restarts = watch_.Observe(**sample);
    }
    return sample;
  }

  LeftOut left_out() const override { return reader_->left_out(); }

 private:
  const std::unique_ptr<SampleReader> reader_;
  RestartWatch watch_;
};

}  // namespace

bool RestartWatch::Observe(const Sample& sample) {
  const double step =
      last_ ? MetersBetween(last_->estimate, sample.estimate) : 0.0;
  const bool restarts = last_.has_value() && IsRestart(sample, step);
  if (restarts || !first_) first_ = sample.estimate;
  last_step_meters_ = restarts ? 0.0 : step;
  last_ = sample;
  return restarts;
}

bool RestartWatch::IsRestart(const Sample& sample, double step_meters) const {
  const auto is_at = [&](const PlanarPose& place) {
    const double turn =
        std::remainder(sample.estimate.heading - place.heading, kTurn);
    return MetersBetween(place, sample.estimate) <= kReturnMeters &&
           std::abs(turn) <= kReturnRadians;
  };
  if (!is_at(*first_) && !is_at(PlanarPose())) return false;
  const bool has_leapt = step_meters >= kLeapMeters &&
                         step_meters >= kUsualSteps * last_step_meters_;
  if (!last_->covariance || !sample.covariance) return has_leapt;
  const double was = OfPosition(*last_->covariance);
  const double is = OfPosition(*sample.covariance);
  const double heading_was = OfHeading(*last_->covariance);
  const double heading_is = OfHeading(*sample.covariance);
  if (has_leapt) return is <= was && heading_is <= heading_was;
  return kFall * is < was &&
         kFall * is < CarriedVariance(*last_, sample.estimate) &&
         kFall * heading_is < heading_was;
}

std::unique_ptr<SampleReader> MarkRestarts(
    std::unique_ptr<SampleReader> reader) {
  return std::make_unique<RestartReader>(std::move(reader));
}

}  // namespace revisit::client
