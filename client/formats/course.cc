#include "client/formats/course.h"

#include <cmath>
#include <deque>
#include <optional>
#include <utility>

namespace revisit::client {
namespace {

// Variance of `covariance` (ee, en, nn) across the direction (east, north).
double Across(const std::array<double, 3>& covariance, double east,
              double north) {
  const double length = std::hypot(east, north);
  const double left_east = -north / length;
  const double left_north = east / length;
  const auto& [ee, en, nn] = covariance;
  return left_east * left_east * ee + 2.0 * left_east * left_north * en +
         left_north * left_north * nn;
}

void SetCovariance(double heading_variance, Sample* sample) {
  sample->heading_variance = heading_variance;
  if (!sample->position_covariance.has_value()) return;
  const auto& [xx, xy, yy] = *sample->position_covariance;
  sample->covariance = {xx, xy, 0.0, yy, 0.0, heading_variance};
}

double Distance(const Sample& a, const Sample& b) {
  return std::hypot(b.estimate.x - a.estimate.x, b.estimate.y - a.estimate.y);
}

class CourseReader : public SampleReader {
 public:
  explicit CourseReader(std::unique_ptr<SampleReader> reader)
      : reader_(std::move(reader)) {}

  absl::StatusOr<std::optional<Sample>> Next() override {
    while (ready_.empty()) {
      auto sample = reader_->Next();
      if (!sample.ok()) return sample;
      if (!sample->has_value()) {
        FinishPending(nullptr);
        if (ready_.empty()) return std::optional<Sample>();
        break;
      }
      Take(**sample);
    }
    Sample sample = ready_.front();
    ready_.pop_front();
    return sample;
  }

  LeftOut left_out() const override {
    LeftOut all = reader_->left_out();
    all.standing += standing_;
    return all;
  }

 private:
  void Take(const Sample& sample) {
    if (!sample.has_heading && !sample.velocity.has_value()) {
      TakePosition(sample);
      return;
    }
    FinishPending(nullptr);
    kept_.reset();
    last_seen_.reset();
    if (sample.has_heading) {
      ready_.push_back(sample);
    } else {
      TakeWithVelocity(sample);
    }
  }

  void TakeWithVelocity(Sample sample) {
    const double east = sample.velocity->east;
    const double north = sample.velocity->north;
    const double speed = std::hypot(east, north);
    if (!(speed >= kStandstillMetersPerSecond)) {
      ++standing_;
      return;
    }
    constexpr double kVariance = kVelocitySigma * kVelocitySigma;
    const double across =
        sample.velocity->covariance.has_value()
            ? Across(*sample.velocity->covariance, east, north)
            : kVariance;
    sample.estimate.heading = std::atan2(north, east);
    sample.has_heading = true;
    SetCovariance(across / (speed * speed), &sample);
    ready_.push_back(sample);
  }

  void TakePosition(const Sample& sample) {
    const std::optional<Sample> before = std::exchange(last_seen_, sample);
    if (!pending_.has_value()) {
      pending_ = sample;
      return;
    }
    const double distance = Distance(*pending_, sample);
    if (distance < kCourseMeters) {
      ++standing_;
      return;
    }
    if (distance > kLongestCourseMeters) {
      FinishPending(nullptr);
      kept_.reset();
      pending_ = sample;
      return;
    }
    if (before.has_value() && before->time_nanoseconds.has_value() &&
        sample.time_nanoseconds.has_value()) {
      const double seconds = SecondsOf(sample) - SecondsOf(*before);
      if (Distance(*before, sample) < kStandstillMetersPerSecond * seconds) {
        ++standing_;
        return;
      }
    }
    FinishPending(&sample);
    pending_ = sample;
  }

  // Hands the sample on that waits, with the direction to `next`, or to itself
  // if there is none. One that has no neighbour has no course and is left out.
  void FinishPending(const Sample* next) {
    if (!pending_.has_value()) return;
    Sample sample = *std::exchange(pending_, std::nullopt);
    const Sample& from = kept_.has_value() ? *kept_ : sample;
    const Sample& to = next != nullptr ? *next : sample;
    const double east = to.estimate.x - from.estimate.x;
    const double north = to.estimate.y - from.estimate.y;
    const double distance = std::hypot(east, north);
    // Back to where it came from: neither direction is one.
    if (distance > 0.0) {
      constexpr double kVariance =
          kNeighbourSigmaMeters * kNeighbourSigmaMeters;
      const auto across = [&](const Sample& end) {
        return end.position_covariance.has_value()
                   ? Across(*end.position_covariance, east, north)
                   : kVariance;
      };
      sample.estimate.heading = std::atan2(north, east);
      sample.has_heading = true;
      SetCovariance((across(from) + across(to)) / (distance * distance),
                    &sample);
      ready_.push_back(sample);
    } else {
      ++standing_;
    }
    kept_ = sample;
  }

  const std::unique_ptr<SampleReader> reader_;
  std::deque<Sample> ready_;
  // Positions without velocity: the one handed on last, the one that waits for
  // its successor, and the one that was read last.
  std::optional<Sample> kept_;
  std::optional<Sample> pending_;
  std::optional<Sample> last_seen_;
  // Positions that were left out.
  std::int64_t standing_ = 0;
};

}  // namespace

std::unique_ptr<SampleReader> AddCourse(std::unique_ptr<SampleReader> reader) {
  return std::make_unique<CourseReader>(std::move(reader));
}

}  // namespace revisit::client
