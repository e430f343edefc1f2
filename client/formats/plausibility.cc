#include "client/formats/plausibility.h"

#include <algorithm>
#include <cmath>

#include "absl/strings/str_cat.h"
#include "client/formats/angles.h"

namespace revisit::client {
namespace {

constexpr double kLargestMedianDegrees = 20.0;
constexpr double kFastMetersPerSecond = 100.0;
constexpr double kCrawlMetersPerSecond = 0.005;
// A longer step is a jump, not travel.
constexpr double kLongestStepMeters = 100.0;
constexpr std::int64_t kFirstSteps = 50;
constexpr std::int64_t kLeastSteps = 20;
constexpr std::int64_t kDegreesLook = 500;
// Steps of 20 m after which the given reading is taken for right: the others
// cost as much each.
constexpr std::int64_t kLastLookAtOthers = 200;
// A vehicle at 126 km/h, in kilometres.
constexpr double kFastKilometersPerSecond = 0.035;
constexpr double kLeastSlowSeconds = 60.0;
constexpr double kLongestSlowStepSeconds = 2.0;
constexpr std::int64_t kCoarseSamples = 10;
// How much better than another convention a turned body has to fit.
constexpr double kClearlyDegrees = 3.0;

double SecondsBetween(const Sample& a, const Sample& b) {
  if (!a.time_nanoseconds.has_value() || !b.time_nanoseconds.has_value()) {
    return 0.0;
  }
  // They may lie centuries apart, more than their type counts.
  return SecondsOf(b) - SecondsOf(a);
}

std::vector<Reading> MakeReadings(const Conventions& given) {
  std::vector<Reading> readings;
  const auto add = [&](const Conventions& conventions, const char* flag,
                       const char* words) {
    Reading reading;
    reading.conventions = conventions;
    reading.flag = flag;
    reading.words = words;
    readings.push_back(std::move(reading));
  };
  add(given, "", "");
  const auto other = [&](auto Conventions::*field, auto value, const char* flag,
                         const char* words) {
    if (given.*field == value) return;
    Conventions conventions = given;
    conventions.*field = value;
    add(conventions, flag, words);
  };
  const auto quaternion = &Conventions::quaternion;
  const auto angles = &Conventions::angles;
  const auto axes = &Conventions::axes;
  other(quaternion, QuaternionOrder::kXyzw, "--quaternion xyzw", "w last");
  other(quaternion, QuaternionOrder::kWxyz, "--quaternion wxyz", "w first");
  other(angles, Angles::kRadians, "--angles radians", "yaw in radians");
  other(angles, Angles::kDegrees, "--angles degrees", "yaw in degrees");
  other(angles, Angles::kCompassRadians, "--angles compass-radians",
        "radians clockwise from north");
  other(angles, Angles::kCompassDegrees, "--angles compass-degrees",
        "degrees clockwise from north");
  other(axes, Axes::kForwardLeftUp, "--axes flu", "x forward, y left, z up");
  other(axes, Axes::kCamera, "--axes camera", "x right, y down, z forward");
  other(axes, Axes::kNorthEastDown, "--axes ned", "x north, y east, z down");
  return readings;
}

// With the body as in the file.
Conventions Unturned(Conventions conventions) {
  conventions.body = BodyAxes{'f', 'l', 'u'};
  conventions.body_yaw = 0.0;
  return conventions;
}

bool IsWrongAt(const CourseStatistics& scale) {
  return scale.IsSteep() ||
         scale.Median().value_or(0.0) > kLargestMedianDegrees;
}

std::string Degrees(double value) {
  return absl::StrCat(static_cast<int>(std::lround(value)));
}

}  // namespace

void CourseStatistics::Add(const Sample& sample) {
  if (!anchor_.has_value()) {
    anchor_ = sample;
    return;
  }
  const double dx = sample.estimate.x - anchor_->estimate.x;
  const double dy = sample.estimate.y - anchor_->estimate.y;
  // Heights of receivers are worse than their positions, and never turned.
  const double dz = sample.geodetic.has_value() ? 0.0 : sample.z - anchor_->z;
  const double along = std::hypot(dx, dy);
  const double length = std::hypot(along, dz);
  if (length < step_meters_) return;
  const Sample anchor = *std::exchange(anchor_, sample);
  if (length > kLongestStepMeters) return;
  ++steps_;
  if (const double seconds = SecondsBetween(anchor, sample); seconds > 0.0) {
    ++timed_;
    if (length < kCrawlMetersPerSecond * seconds) ++crawling_;
  }
  if (along < std::abs(dz)) {
    ++steep_;
    return;
  }
  if (!sample.has_heading || !anchor.has_heading) return;
  const double turn = std::remainder(
      sample.estimate.heading - anchor.estimate.heading, 2.0 * kPi);
  const double heading = anchor.estimate.heading + 0.5 * turn;
  const double angle =
      std::abs(std::remainder(std::atan2(dy, dx) - heading, 2.0 * kPi));
  if (!std::isfinite(angle)) return;
  ++compared_;
  ++by_degree_[static_cast<std::size_t>(
      std::clamp(angle / kRadiansPerDegree, 0.0, 180.0))];
}

std::optional<double> CourseStatistics::Median() const {
  if (compared_ == 0) return std::nullopt;
  std::int64_t below = 0;
  std::size_t degree = 0;
  while (2 * (below + by_degree_[degree]) < compared_) {
    below += by_degree_[degree++];
  }
  return static_cast<double>(degree);
}

void Reading::Add(const Sample& raw) {
  if (!possible) return;
  const auto sample = Convert(raw, conventions);
  if (!sample.ok()) {
    possible = false;
    return;
  }
  near.Add(*sample);
  far.Add(*sample);
  if (seeks_turn) {
    if (const auto unturned = Convert(raw, Unturned(conventions));
        unturned.ok()) {
      near_turn.Add(*unturned);
      far_turn.Add(*unturned);
    }
  }
  if (sample->quaternion.has_value()) {
    ++oriented;
    if (UprightCosine(*sample) < std::sqrt(0.5)) ++leaning;
  }
}

bool Reading::IsWrong(bool complete) const {
  if (near.steps() < (complete ? kLeastSteps : kFirstSteps)) return false;
  if (!IsWrongAt(near)) return false;
  // A short recording has few long steps.
  return complete && far.steps() < 3 ? true : IsWrongAt(far);
}

std::optional<BodyTurn::Finding> Reading::Turn() const {
  if (!possible || near.IsSteep()) return std::nullopt;
  const auto at_near = near_turn.Find();
  const auto at_far = far_turn.Find();
  if (!at_near.has_value() || !at_far.has_value()) {
    return at_near.has_value() ? at_near : at_far;
  }
  return at_near->spread_degrees <= at_far->spread_degrees ? at_near : at_far;
}

bool Reading::Fits() const {
  if (!possible || near.steps() < kLeastSteps || IsLeaning()) return false;
  if (near.IsSteep() || far.IsSteep()) return false;
  // Positions alone have no heading that could disagree.
  const double at_near = near.Median().value_or(0.0);
  return std::min(at_near, far.Median().value_or(at_near)) <=
         kLargestMedianDegrees;
}

Plausibility::Plausibility(const Conventions& conventions,
                           const std::string& path)
    : path_(path), readings_(MakeReadings(conventions)) {}

absl::Status Plausibility::Suspicious(const std::string& seen,
                                      const std::string& mend) const {
  return absl::InvalidArgumentError(
      absl::StrCat(path_, ":", line_, ": ", seen, "; ", mend,
                   "; --accept-suspicious takes the file as it is"));
}

const Reading* Plausibility::BestReading() const {
  const Reading* best = nullptr;
  for (const Reading& reading : readings_) {
    if (&reading == &readings_.front() || !reading.Fits()) continue;
    if (best == nullptr || reading.near.Median().value_or(0.0) <
                               best->near.Median().value_or(0.0)) {
      best = &reading;
    }
  }
  return best;
}

std::string Plausibility::BestTurn(double* spread_degrees) const {
  std::string advice;
  for (const Reading& reading : readings_) {
    const auto turn = reading.Turn();
    if (!turn.has_value()) continue;
    if (!advice.empty() &&
        turn->spread_degrees + kClearlyDegrees > *spread_degrees) {
      continue;
    }
    *spread_degrees = turn->spread_degrees;
    advice = absl::StrCat(reading.flag, reading.flag.empty() ? "" : " ",
                          turn->flags, " (", reading.words,
                          reading.words.empty() ? "" : "; ", turn->words, ")");
  }
  return advice;
}

// Advises the flags that make heading and course agree.
std::string Plausibility::MendOf() const {
  if (readings_.size() == 1) {
    return "they agreed until here: the file's axes, units or order change";
  }
  const Reading* const best = BestReading();
  double spread_degrees = 0.0;
  const std::string turned = BestTurn(&spread_degrees);
  if (!turned.empty() &&
      (best == nullptr ||
       spread_degrees + kClearlyDegrees < best->near.Median().value_or(0.0))) {
    return absl::StrCat("they agree with ", turned);
  }
  if (best == nullptr) {
    return "expected x forward, y left and z up of the vehicle, in metres and "
           "radians; no --axes, --body-axes, --angles or --quaternion makes "
           "them agree";
  }
  return absl::StrCat("they agree with ", best->flag, " (", best->words, ")");
}

absl::Status Plausibility::CheckTime(const Sample& raw) {
  if (previous_.has_value() && SecondsBetween(*previous_, raw) < 0.0) {
    return Suspicious(
        absl::StrCat("the time runs back by ", -SecondsBetween(*previous_, raw),
                     " s"),
        "expected samples in the order of their times: sort the file, or give "
        "each recording as a FILE of its own");
  }
  return absl::OkStatus();
}

absl::Status Plausibility::CheckSpeeds() {
  if (timed_ >= 10 && 2 * fast_ > timed_) {
    return Suspicious(
        absl::StrCat("the vehicle moves at more than ", kFastMetersPerSecond,
                     " m/s most of the time"),
        "expected positions in metres and times in seconds; --time-unit ms|us|"
        "ns names another unit of time");
  }
  if (readings_[0].near.IsCrawling()) {
    return Suspicious(
        absl::StrCat("the vehicle moves at less than ", kCrawlMetersPerSecond,
                     " m/s most of the time"),
        "expected positions in metres and times in seconds; --time-unit ms|us|"
        "ns names another unit of time");
  }
  return absl::OkStatus();
}

absl::Status Plausibility::CheckKilometers() {
  // A vehicle that stands shakes: its path is no smooth one.
  if (geodetic_ || slow_seconds_ < kLeastSlowSeconds ||
      10 * slow_ < 9 * timed_ || 2 * moved_ < samples_ ||
      !(path_length_ < 1.2 * coarse_length_)) {
    return absl::OkStatus();
  }
  return Suspicious(
      absl::StrCat("the vehicle moves steadily, but at less than ",
                   kFastKilometersPerSecond,
                   " m/s, as one does whose positions are in kilometres"),
      "expected metres");
}

absl::Status Plausibility::CheckEarthCentred() {
  if (geodetic_ || !(least_radius_ > 6.33e6) || !(largest_radius_ < 6.4e6)) {
    return absl::OkStatus();
  }
  return Suspicious(
      absl::StrCat("positions lie ", std::llround(least_radius_ / 1000.0),
                   " km from the origin, as earth-centred ones (ECEF) do: "
                   "their z is not up"),
      "expected metres of a local frame, or latitude and longitude (--columns "
      "lat=NAME,lon=NAME)");
}

absl::Status Plausibility::CheckDegrees() {
  // From a few hundred metres to a few hundred kilometres, if it is degrees.
  constexpr double kSmallest = 2e-3;
  constexpr double kLargest = 3.0;
  if (geodetic_) return absl::OkStatus();
  const double extent = std::max(high_[0] - low_[0], high_[1] - low_[1]);
  const auto largest = [&](int axis) {
    return std::max(std::abs(low_[axis]), std::abs(high_[axis]));
  };
  const double x = largest(0);
  const double y = largest(1);
  const bool are_degrees =
      extent > kSmallest && extent < kLargest && std::max(x, y) <= 180.0 &&
      std::min(x, y) <= 90.0 && std::max(x, y) > 20.0 * extent &&
      // A vehicle that stands shakes, or does not move at all.
      2 * moved_ > samples_ && path_length_ < 20.0 * extent;
  if (!are_degrees) return absl::OkStatus();
  return Suspicious(
      absl::StrCat("all positions lie within ", extent, " of (", low_[0], ", ",
                   low_[1], "), as longitude and latitude would"),
      y > 90.0 ? "expected metres; for degrees --columns lat=NAME,lon=NAME "
                 "says which is which"
               : "expected metres; --frame geodetic takes x as longitude and y "
                 "as latitude in degrees");
}

absl::Status Plausibility::CheckYaw(bool complete) {
  const Reading& given = readings_[0];
  if (given.conventions.angles != Angles::kRadians ||
      largest_yaw_ <= 2.0 * kPi) {
    return absl::OkStatus();
  }
  const std::string seen =
      absl::StrCat("a yaw of ", largest_yaw_, " is more than a turn");
  const std::string mend =
      "expected radians; --angles degrees takes it as degrees";
  if (given.near.steps() < kLeastSteps) {
    return complete ? Suspicious(seen, mend) : absl::OkStatus();
  }
  // Yaw that counts turns is in line with the course, as it stands.
  for (const Reading& reading : readings_) {
    if (reading.conventions.angles == Angles::kDegrees && reading.Fits() &&
        reading.near.Median().value_or(180.0) + 5.0 <
            given.near.Median().value_or(180.0)) {
      return Suspicious(seen, mend);
    }
  }
  return absl::OkStatus();
}

absl::Status Plausibility::CheckReadings(bool complete) {
  const Reading& given = readings_[0];
  if (absl::Status status = CheckYaw(complete); !status.ok()) return status;
  if (given.near.IsSteep() && given.IsWrong(complete)) {
    return Suspicious("z often changes more than x and y: it is no height",
                      MendOf());
  }
  if (given.IsWrong(complete)) {
    return Suspicious(absl::StrCat("heading and direction of travel are ",
                                   Degrees(given.near.Median().value_or(0.0)),
                                   " degrees apart (median of ",
                                   given.near.steps(), " steps)"),
                      MendOf());
  }
  if (given.IsLeaning()) {
    return Suspicious(
        "the vehicle's up axis leans more than 45 degrees from z most of the "
        "time",
        MendOf());
  }
  return absl::OkStatus();
}

void Plausibility::CountStep(const Sample& raw) {
  const double length = std::hypot(raw.estimate.x - previous_->estimate.x,
                                   raw.estimate.y - previous_->estimate.y,
                                   geodetic_ ? 0.0 : raw.z - previous_->z);
  path_length_ += length;
  const double seconds = SecondsBetween(*previous_, raw);
  if (length > 0.0) ++moved_;
  if (length > 0.0 && seconds > 0.0) {
    ++timed_;
    if (length > kFastMetersPerSecond * seconds) ++fast_;
    if (length < kFastKilometersPerSecond * seconds) {
      ++slow_;
      // A gap between two recordings says nothing.
      slow_seconds_ += std::min(seconds, kLongestSlowStepSeconds);
    }
  }
}

void Plausibility::Count(const Sample& raw) {
  const bool first = samples_ == 0;
  const double position[] = {raw.estimate.x, raw.estimate.y};
  for (int axis = 0; axis < 2; ++axis) {
    low_[axis] = first ? position[axis] : std::min(low_[axis], position[axis]);
    high_[axis] =
        first ? position[axis] : std::max(high_[axis], position[axis]);
  }
  // Projected coordinates are as large, but not upwards.
  const double radius = std::abs(raw.z) > 2e4
                            ? std::hypot(raw.estimate.x, raw.estimate.y, raw.z)
                            : 0.0;
  least_radius_ = first ? radius : std::min(least_radius_, radius);
  largest_radius_ = std::max(largest_radius_, radius);
  if (samples_ % kCoarseSamples == 0) {
    if (coarse_.has_value()) {
      coarse_length_ += std::hypot(raw.estimate.x - coarse_->estimate.x,
                                   raw.estimate.y - coarse_->estimate.y);
    }
    coarse_ = raw;
  }
  ++samples_;
  if (previous_.has_value()) CountStep(raw);
  if (raw.has_heading && !raw.quaternion.has_value()) {
    largest_yaw_ = std::max(largest_yaw_, std::abs(raw.estimate.heading));
  }
  previous_ = raw;
}

absl::Status Plausibility::CheckPositions() {
  if (absl::Status status = CheckEarthCentred(); !status.ok()) return status;
  if (absl::Status status = CheckDegrees(); !status.ok()) return status;
  if (absl::Status status = CheckSpeeds(); !status.ok()) return status;
  return CheckKilometers();
}

absl::Status Plausibility::Observe(const Sample& raw) {
  line_ = raw.line;
  geodetic_ = raw.geodetic.has_value();
  if (absl::Status status = CheckTime(raw); !status.ok()) return status;
  Count(raw);
  for (Reading& reading : readings_) reading.Add(raw);
  if (samples_ % kDegreesLook == 0) {
    if (absl::Status status = CheckPositions(); !status.ok()) return status;
  }
  if (readings_[0].far.steps() < next_look_) return absl::OkStatus();
  next_look_ *= 2;
  if (absl::Status status = CheckEarthCentred(); !status.ok()) return status;
  if (absl::Status status = CheckSpeeds(); !status.ok()) return status;
  const absl::Status status = CheckReadings(false);
  if (next_look_ > kLastLookAtOthers) {
    readings_.resize(1);
    readings_[0].seeks_turn = false;
  }
  return status;
}

absl::Status Plausibility::Finish() {
  if (absl::Status status = CheckSpeeds(); !status.ok()) return status;
  if (samples_ >= kLeastSteps) {
    if (absl::Status status = CheckPositions(); !status.ok()) return status;
  }
  return CheckReadings(true);
}

}  // namespace revisit::client
