#include "client/evaluation/simulation.h"

#include <algorithm>
#include <charconv>
#include <cmath>
#include <set>
#include <string_view>
#include <system_error>

#include "absl/strings/str_cat.h"
#include "client/formats/angles.h"

namespace revisit::client {
namespace {

constexpr double kStandstillMeters = 0.05;

// FNV-1a, whose hash of a name is the same on every machine.
std::uint64_t HashOf(const std::string& name) {
  std::uint64_t hash = 14695981039346656037u;
  for (const char c : name) {
    hash ^= static_cast<unsigned char>(c);
    hash *= 1099511628211u;
  }
  return hash;
}

// The pose that is seen as `step` from `pose`.
PlanarPose Compound(const PlanarPose& pose, const PlanarPose& step) {
  const double c = std::cos(pose.heading);
  const double s = std::sin(pose.heading);
  return {pose.x + c * step.x - s * step.y, pose.y + s * step.x + c * step.y,
          std::remainder(pose.heading + step.heading, kTurn)};
}

// The time from one sample to the next.
double SecondsBetween(const Sample& a, const Sample& b) {
  constexpr double kLongest = 2.0;
  constexpr double kUsual = 0.1;
  if (!a.time_nanoseconds.has_value() || !b.time_nanoseconds.has_value()) {
    return kUsual;
  }
  const double seconds =
      1e-9 * static_cast<double>(*b.time_nanoseconds - *a.time_nanoseconds);
  return seconds >= 0.0 && seconds <= kLongest ? seconds : kUsual;
}

// Makes a sample one of an estimate that states neither covariance nor error
// transition. Its height stays.
void SetEstimate(const PlanarPose& estimate, Sample* sample) {
  sample->estimate = estimate;
  sample->quaternion.reset();
  sample->covariance.reset();
  sample->covariance_36.reset();
  sample->error_transition.reset();
  sample->geodetic.reset();
}

bool ReadSeed(std::string_view text, std::uint64_t* seed) {
  const auto [end, error] =
      std::from_chars(text.data(), text.data() + text.size(), *seed);
  return error == std::errc() && end == text.data() + text.size();
}

}  // namespace

RandomSource::RandomSource(std::uint64_t seed, const std::string& name)
    : random_(seed ^ HashOf(name)) {}

double RandomSource::Uniform() {
  return (static_cast<double>(random_() >> 11) + 1.0) * 0x1p-53;
}

double RandomSource::Next() {
  if (spare_.has_value()) {
    const double value = *spare_;
    spare_.reset();
    return value;
  }
  const double radius = std::sqrt(-2.0 * std::log(Uniform()));
  const double angle = kTurn * Uniform();
  spare_ = radius * std::sin(angle);
  return radius * std::cos(angle);
}

PlanarPose Between(const PlanarPose& a, const PlanarPose& b) {
  const double dx = b.x - a.x;
  const double dy = b.y - a.y;
  const double c = std::cos(a.heading);
  const double s = std::sin(a.heading);
  return {c * dx + s * dy, -s * dx + c * dy,
          std::remainder(b.heading - a.heading, kTurn)};
}

Drive SimulateDeadReckoning(const Drive& drive, const UncertaintyOptions& noise,
                            std::uint64_t seed) {
  RandomSource normal(seed, drive.name);
  // Each draw is a statement of its own: the compiler must not choose their
  // order.
  const auto draw = [&normal](double sigma) { return sigma * normal.Next(); };
  // Heights have draws of their own, so that those of the plane are the same
  // with and without them.
  RandomSource normal_up(~seed, drive.name);
  Drive simulated = drive;
  // The true pose up to which dead reckoning has counted.
  PlanarPose counted = drive.truth[0];
  PlanarPose estimate = counted;
  double z_error = noise.start_position * normal_up.Next();
  estimate.x += draw(noise.start_position);
  estimate.y += draw(noise.start_position);
  estimate.heading += draw(noise.start_heading);
  for (std::size_t i = 0; i < drive.samples.size(); ++i) {
    PlanarPose step = Between(counted, drive.truth[i]);
    const double length = std::hypot(step.x, step.y);
    if (length >= kStandstillMeters) {
      const double root = std::sqrt(length);
      const double along = draw(noise.along * root);
      const double across = draw(noise.across * root);
      const double turn = draw(noise.heading * root);
      const double c = std::cos(0.5 * step.heading);
      const double s = std::sin(0.5 * step.heading);
      step.x += c * along - s * across;
      step.y += s * along + c * across;
      step.heading += turn;
      estimate = Compound(estimate, step);
      counted = drive.truth[i];
      z_error += noise.up * root * normal_up.Next();
    }
    Sample& sample = simulated.samples[i];
    SetEstimate(estimate, &sample);
    sample.z = sample.truth_z.value_or(0.0) + z_error;
  }
  return simulated;
}

void AddGyroBias(double radians_per_second, Drive* drive) {
  PlanarPose recorded;
  PlanarPose biased;
  for (std::size_t i = 0; i < drive->samples.size(); ++i) {
    Sample& sample = drive->samples[i];
    if (i == 0) {
      recorded = biased = sample.estimate;
    } else {
      const double turn =
          radians_per_second * SecondsBetween(drive->samples[i - 1], sample);
      PlanarPose step = Between(recorded, sample.estimate);
      recorded = sample.estimate;
      const double c = std::cos(0.5 * turn);
      const double s = std::sin(0.5 * turn);
      step = {c * step.x - s * step.y, s * step.x + c * step.y,
              step.heading + turn};
      biased = Compound(biased, step);
    }
    SetEstimate(biased, &sample);
  }
}

Drive SimulateFixes(const Drive& drive, const FixNoise& noise,
                    std::uint64_t seed) {
  constexpr double kPeriod = 1.0;
  // Seconds are sums of decimal fractions, which doubles do not hold exactly.
  constexpr double kRounding = 1e-6;
  constexpr double kLeastMotion = 0.5;
  RandomSource normal(seed, drive.name);
  const double position = noise.meters * noise.meters;
  Drive fixes;
  fixes.name = drive.name;
  double error_x = 0.0;
  double error_y = 0.0;
  double seconds = 0.0;
  for (std::size_t i = 0; i < drive.samples.size(); ++i) {
    const PlanarPose& truth = drive.truth[i];
    double kept = 0.0;
    if (i > 0) {
      seconds += SecondsBetween(drive.samples[i - 1], drive.samples[i]);
      const PlanarPose& last = fixes.truth.back();
      if (seconds < kPeriod - kRounding ||
          std::hypot(truth.x - last.x, truth.y - last.y) < kLeastMotion) {
        continue;
      }
      if (noise.correlation_seconds > 0.0) {
        kept = std::exp(-seconds / noise.correlation_seconds);
      }
    }
    const double fresh = noise.meters * std::sqrt(1.0 - kept * kept);
    // Each draw is a statement of its own, as above.
    error_x = kept * error_x + fresh * normal.Next();
    error_y = kept * error_y + fresh * normal.Next();
    const double turn = noise.heading * normal.Next();
    seconds = 0.0;
    Sample sample = drive.samples[i];
    sample.z = 0.0;
    SetEstimate({truth.x + error_x, truth.y + error_y,
                 std::remainder(truth.heading + turn, kTurn)},
                &sample);
    sample.covariance = {position, 0.0, 0.0,
                         position, 0.0, noise.heading * noise.heading};
    fixes.samples.push_back(sample);
    fixes.truth.push_back(truth);
  }
  return fixes;
}

absl::StatusOr<std::vector<std::uint64_t>> ParseSeeds(const std::string& text) {
  constexpr std::uint64_t kMostSeeds = 1000;
  std::vector<std::uint64_t> seeds;
  std::set<std::uint64_t> known;
  std::string_view rest = text;
  for (;;) {
    const std::size_t comma = rest.find(',');
    const std::string_view part = rest.substr(0, comma);
    const std::size_t dash = part.find('-');
    std::uint64_t first = 0;
    std::uint64_t last = 0;
    const bool good = dash == std::string_view::npos
                          ? ReadSeed(part, &first) && ReadSeed(part, &last)
                          : ReadSeed(part.substr(0, dash), &first) &&
                                ReadSeed(part.substr(dash + 1), &last) &&
                                first <= last;
    if (!good) {
      return absl::InvalidArgumentError(absl::StrCat(
          "expected seeds such as 7, 1-5 or 1,4,8-10, got \"", text, "\""));
    }
    if (last - first >= kMostSeeds ||
        seeds.size() + last - first >= kMostSeeds) {
      return absl::InvalidArgumentError(absl::StrCat(
          "expected at most ", kMostSeeds, " seeds, got \"", text, "\""));
    }
    for (std::uint64_t i = 0; i <= last - first; ++i) {
      if (!known.insert(first + i).second) {
        return absl::InvalidArgumentError(absl::StrCat(
            "seed ", first + i, " stands twice in \"", text, "\""));
      }
      seeds.push_back(first + i);
    }
    if (comma == std::string_view::npos) return seeds;
    rest.remove_prefix(comma + 1);
  }
}

PlanarPose DrawDatum(const Drive& drive, double meters, double radians,
                     std::uint64_t seed) {
  // A source of its own, so that an estimate drawn with this seed has others.
  RandomSource normal(seed, drive.name + ", datum");
  PlanarPose start = drive.truth.front();
  start.x += meters * normal.Next();
  start.y += meters * normal.Next();
  start.heading += radians * normal.Next();
  return Compound(start, Between(drive.samples.front().estimate, PlanarPose()));
}

}  // namespace revisit::client
