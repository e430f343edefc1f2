// Paths for the tests of drives and searches.
#ifndef REVISIT_TESTS_CORE_DRIVE_DRIVES_H_
#define REVISIT_TESTS_CORE_DRIVE_DRIVES_H_

#include <cmath>
#include <cstdint>
#include <vector>

#include "core/geometry/heading.h"
#include "core/geometry/pose.h"

namespace revisit::core {

// A pose every metre.
class Trip {
 public:
  explicit Trip(const Pose& start = {}) : pose_(start), poses_{start} {}

  Trip& Straight(double meters) {
    for (double s = 0.0; s + 0.5 < meters; s += 1.0) Step(0.0);
    return *this;
  }

  // Turns left if positive.
  Trip& Turn(double degrees, double radius) {
    const double angle = degrees * kPi / 180.0;
    const int steps = static_cast<int>(std::ceil(std::abs(angle) * radius));
    for (int i = 0; i < steps; ++i) Step(angle / steps);
    return *this;
  }

  // A winding road, which is the same at the same place along it.
  Trip& Winding(double from, double to) {
    for (double s = from; s + 0.5 < to; s += 1.0) {
      Step(0.03 * std::sin(s / 17.0) + 0.02 * std::sin(s / 7.3));
    }
    return *this;
  }

  // Jumps to another place without driving there.
  Trip& JumpTo(const Pose& pose) {
    pose_ = pose;
    poses_.push_back(pose);
    return *this;
  }

  const Pose& pose() const { return pose_; }
  const std::vector<Pose>& poses() const { return poses_; }

 private:
  void Step(double turn) {
    pose_.heading += 0.5 * turn;
    pose_.x += std::cos(pose_.heading);
    pose_.y += std::sin(pose_.heading);
    pose_.heading = WrapHeading(pose_.heading + 0.5 * turn);
    poses_.push_back(pose_);
  }

  Pose pose_;
  std::vector<Pose> poses_;
};

// The same standard deviations everywhere.
inline std::vector<PoseSample> WithDeviations(const std::vector<Pose>& poses,
                                              double position_meters,
                                              double heading_radians) {
  std::vector<PoseSample> samples;
  for (const Pose& pose : poses) {
    PoseSample sample;
    sample.sequence = samples.size() + 1;
    sample.pose = pose;
    for (int k : {0, 1, 2}) {
      sample.covariance(k, k) = position_meters * position_meters;
    }
    sample.covariance(3, 3) = heading_radians * heading_radians;
    samples.push_back(sample);
  }
  return samples;
}

// A closed course without symmetry, of about 1150 m.
inline std::vector<Pose> Ring(double meters) {
  const auto at = [](double angle) {
    const double radius =
        150.0 + 30.0 * std::cos(3.0 * angle) + 20.0 * std::sin(5.0 * angle);
    return Pose{radius * std::cos(angle), radius * std::sin(angle), 0.0, 0.0};
  };
  std::vector<Pose> poses;
  double travelled = 0.0;
  double due = 0.0;
  const double step = 1e-5;
  Pose before = at(0.0);
  for (double angle = 0.0; travelled <= meters; angle += step) {
    Pose pose = at(angle);
    travelled += std::hypot(pose.x - before.x, pose.y - before.y);
    if (travelled >= due) {
      const Pose next = at(angle + step);
      pose.heading = std::atan2(next.y - pose.y, next.x - pose.x);
      poses.push_back(pose);
      due += 1.0;
    }
    before = pose;
  }
  return poses;
}

}  // namespace revisit::core

#endif  // REVISIT_TESTS_CORE_DRIVE_DRIVES_H_
