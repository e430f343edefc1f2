#include "server/conversion/pose_inspection.h"

#include <algorithm>
#include <cmath>
#include <initializer_list>
#include <string>
#include <utility>

#include "absl/strings/str_cat.h"
#include "core/base/number_text.h"
#include "core/geometry/heading.h"

namespace revisit::server {
namespace {

using absl::StrCat;
using core::NumberText;

// Numbers that are shown to people need no more digits than these.
std::string Short(double value) { return StrCat(value == 0.0 ? 0.0 : value); }

void Warn(v1::WarningReason reason, std::uint64_t sequence,
          const std::string& message,
          std::initializer_list<std::pair<const char*, double>> numbers,
          PoseInspector::Warnings* warnings) {
  v1::Warning* const warning = warnings->Add();
  warning->set_reason(reason);
  warning->set_message(message);
  auto& metadata = *warning->mutable_metadata();
  metadata["sequence"] = StrCat(sequence);
  for (const auto& [name, value] : numbers) metadata[name] = NumberText(value);
}

// REQUIRES: not empty.
double Median(std::vector<double> values) {
  const auto middle =
      values.begin() + static_cast<std::ptrdiff_t>(values.size() / 2);
  std::nth_element(values.begin(), middle, values.end());
  return *middle;
}

std::optional<double> SecondsBetween(const core::PoseSample& from,
                                     const core::PoseSample& to) {
  if (!from.stamp_ns || !to.stamp_ns) return std::nullopt;
  return (static_cast<double>(*to.stamp_ns) -
          static_cast<double>(*from.stamp_ns)) *
         1e-9;
}

double MetersBetween(const core::PoseSample& from, const core::PoseSample& to) {
  return std::hypot(to.pose.x - from.pose.x, to.pose.y - from.pose.y,
                    to.pose.z - from.pose.z);
}

// The least length of a step between these poses: 5 standard deviations, so
// that a vehicle at rest makes none, but within [1 m, 20 m].
double LeastStep(const core::PoseSample& from, const core::PoseSample& to) {
  double variance = 0.0;
  for (const core::PoseSample* sample : {&from, &to}) {
    variance += std::max(sample->covariance(0, 0), sample->covariance(1, 1));
  }
  return std::clamp(5.0 * std::sqrt(variance), 1.0, 20.0);
}

}  // namespace

void PoseInspector::Look(const std::vector<core::PoseSample>& samples,
                         Warnings* warnings) {
  for (const core::PoseSample& sample : samples) {
    if (done()) return;
    ++looked_;
    LookAtHeading(sample, warnings);
    if (!first_ || sample.recording_start) {
      BeginFrame(sample);
      continue;
    }
    path_meters_ += MetersBetween(last_, sample);
    LookAtStamps(sample, warnings);
    LookAtMotion(sample, warnings);
    LookForDegrees(sample, warnings);
    last_ = sample;
  }
}

// Nothing of a way can be told across two frames.
void PoseInspector::BeginFrame(const core::PoseSample& sample) {
  first_ = last_ = step_start_ = sample;
  first_looked_ = looked_;
  path_meters_ = 0.0;
  steps_.clear();
  step_meters_ = 0.0;
}

void PoseInspector::LookAtHeading(const core::PoseSample& sample,
                                  Warnings* warnings) {
  const double heading = sample.pose.heading;
  if (warned_of_heading_ || std::abs(heading) <= 2.0 * core::kPi) return;
  warned_of_heading_ = true;
  Warn(v1::WARNING_REASON_HEADING_BEYOND_TURN, sample.sequence,
       StrCat("the heading of sequence ", sample.sequence, " is ",
              Short(heading),
              ", more than a full turn in radians; headings in degrees have to "
              "be multiplied by pi / 180"),
       {{"heading_radians", heading}}, warnings);
}

void PoseInspector::LookAtStamps(const core::PoseSample& sample,
                                 Warnings* warnings) {
  const std::optional<double> seconds = SecondsBetween(last_, sample);
  if (warned_of_stamps_ || !seconds || *seconds >= 0.0) return;
  warned_of_stamps_ = true;
  Warn(v1::WARNING_REASON_STAMPS_BACKWARDS, sample.sequence,
       StrCat("the stamp of sequence ", sample.sequence, " is ",
              Short(-*seconds), " s before that of the pose before it"),
       {{"seconds", *seconds}}, warnings);
}

void PoseInspector::LookAtMotion(const core::PoseSample& sample,
                                 Warnings* warnings) {
  if (motion_is_judged_) return;
  const double length = MetersBetween(step_start_, sample);
  if (length < LeastStep(step_start_, sample)) return;
  const core::Pose apart = core::Difference(sample.pose, step_start_.pose);
  Step step;
  step.end = sample.pose;
  if (std::hypot(apart.x, apart.y) >= std::abs(apart.z)) {
    // On an arc, the chord has the mean of the headings at its ends.
    const double heading =
        step_start_.pose.heading + 0.5 * core::WrapHeading(apart.heading);
    step.off_course = core::WrapHeading(heading - std::atan2(apart.y, apart.x));
  }
  const std::optional<double> seconds = SecondsBetween(step_start_, sample);
  if (seconds && *seconds > 0.0) step.meters_per_second = length / *seconds;
  steps_.push_back(step);
  step_meters_ += length;
  step_start_ = sample;
  if (steps_.size() < kLeastSteps || step_meters_ < kLeastMeters) return;
  JudgeMotion(sample.sequence, warnings);
  motion_is_judged_ = true;
  steps_ = {};
}

void PoseInspector::JudgeMotion(std::uint64_t sequence,
                                Warnings* warnings) const {
  std::vector<double> speeds;
  for (const Step& step : steps_) {
    if (step.meters_per_second) speeds.push_back(*step.meters_per_second);
  }
  const double horizontal =
      std::hypot(Extent(&core::Pose::x), Extent(&core::Pose::y));
  const double vertical = Extent(&core::Pose::z);
  if (vertical >= kLeastSteepMeters && vertical > horizontal) {
    Warn(v1::WARNING_REASON_STEEP_PATH, sequence,
         StrCat("the path reaches ", Short(vertical),
                " m up and down, and only ", Short(horizontal),
                " m sideways; z has to point up, as it does not in the axes of "
                "a camera"),
         {{"vertical_meters", vertical}, {"horizontal_meters", horizontal}},
         warnings);
  }
  if (speeds.size() >= kLeastSteps && Median(speeds) > kMostMetersPerSecond) {
    Warn(v1::WARNING_REASON_IMPLAUSIBLE_SPEED, sequence,
         StrCat("the median speed by stamps is ", Short(Median(speeds)),
                " m/s; positions have to be in metres, and stamps are seconds "
                "and nanoseconds"),
         {{"meters_per_second", Median(speeds)}}, warnings);
  }
  JudgeCourse(sequence, warnings);
}

double PoseInspector::Extent(double core::Pose::*coordinate) const {
  const auto [least, most] = std::minmax_element(
      steps_.begin(), steps_.end(), [&](const Step& a, const Step& b) {
        return a.end.*coordinate < b.end.*coordinate;
      });
  return most->end.*coordinate - least->end.*coordinate;
}

void PoseInspector::JudgeCourse(std::uint64_t sequence,
                                Warnings* warnings) const {
  std::vector<double> angles;
  double sine = 0.0;
  double cosine = 0.0;
  for (const Step& step : steps_) {
    if (!step.off_course) continue;
    angles.push_back(std::abs(*step.off_course));
    sine += std::sin(*step.off_course);
    cosine += std::cos(*step.off_course);
  }
  if (angles.size() < kLeastSteps) return;
  const double degrees = 180.0 / core::kPi;
  const double median = degrees * Median(angles);
  if (median <= kMostCourseDegrees) return;
  std::string message =
      StrCat("the heading differs from the direction of motion by ",
             Short(median), " degrees, the median over ", angles.size(),
             " steps; it has to be the direction of the body's forward axis, "
             "counter-clockwise from +x");
  const double turned = degrees * std::atan2(sine, cosine);
  const bool is_turned =
      std::hypot(sine, cosine) > 0.9 * static_cast<double>(angles.size());
  if (is_turned) {
    absl::StrAppend(&message, "; all headings seem to be turned by ",
                    Short(turned), " degrees");
  }
  Warn(v1::WARNING_REASON_HEADING_OFF_COURSE, sequence, message,
       {{"median_degrees", median}}, warnings);
  if (is_turned) {
    (*warnings->rbegin()->mutable_metadata())["turned_degrees"] =
        NumberText(turned);
  }
}

// A vehicle that drives covers in degrees what an estimate creeps by in metres,
// but steadily.
void PoseInspector::LookForDegrees(const core::PoseSample& sample,
                                   Warnings* warnings) {
  if (warned_of_degrees_ || frame_ != CoordinateFrame::kLocal ||
      looked_ - first_looked_ + 1 < kLeastCreepingPoses) {
    return;
  }
  const core::Pose& pose = sample.pose;
  const bool in_range = std::abs(pose.x) <= 180.0 && std::abs(pose.y) <= 90.0 &&
                        std::max(std::abs(pose.x), std::abs(pose.y)) > 1.0;
  const std::optional<double> seconds = SecondsBetween(*first_, sample);
  if (!in_range || !seconds || *seconds < kLeastCreepingSeconds) return;
  const double moved =
      std::hypot(pose.x - first_->pose.x, pose.y - first_->pose.y);
  const double speed = moved / *seconds;
  if (speed > kMostCreepingMetersPerSecond ||
      speed < kLeastCreepingMetersPerSecond || moved < 0.9 * path_meters_) {
    return;
  }
  warned_of_degrees_ = true;
  Warn(v1::WARNING_REASON_POSITIONS_LIKE_DEGREES, sample.sequence,
       StrCat("positions near (", Short(pose.x), ", ", Short(pose.y),
              ") move on steadily by ", Short(speed),
              " m/s; if they are longitude and latitude, make the vehicle "
              "GEODETIC and send Pose.geodetic"),
       {{"meters_per_second", speed}}, warnings);
}

}  // namespace revisit::server
