#include "client/cli/evaluation/simulation.h"

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

constexpr double kTurn = 2.0 * kPi;
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

// Pose b as seen from pose a.
PlanarPose Between(const PlanarPose& a, const PlanarPose& b) {
  const double dx = b.x - a.x;
  const double dy = b.y - a.y;
  const double c = std::cos(a.heading);
  const double s = std::sin(a.heading);
  return {c * dx + s * dy, -s * dx + c * dy,
          std::remainder(b.heading - a.heading, kTurn)};
}

// The pose that is seen as `step` from `pose`.
PlanarPose Compound(const PlanarPose& pose, const PlanarPose& step) {
  const double c = std::cos(pose.heading);
  const double s = std::sin(pose.heading);
  return {pose.x + c * step.x - s * step.y, pose.y + s * step.x + c * step.y,
          std::remainder(pose.heading + step.heading, kTurn)};
}

bool ReadSeed(std::string_view text, std::uint64_t* seed) {
  const auto [end, error] =
      std::from_chars(text.data(), text.data() + text.size(), *seed);
  return error == std::errc() && end == text.data() + text.size();
}

}  // namespace

double NormalSource::Uniform() {
  return (static_cast<double>(random_() >> 11) + 1.0) * 0x1p-53;
}

double NormalSource::Next() {
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

Drive SimulateDeadReckoning(const Drive& drive, const UncertaintyOptions& noise,
                            std::uint64_t seed) {
  NormalSource normal(seed ^ HashOf(drive.name));
  // Each draw is a statement of its own: the compiler must not choose their
  // order.
  const auto draw = [&normal](double sigma) { return sigma * normal.Next(); };
  Drive simulated = drive;
  // The true pose up to which dead reckoning has counted.
  PlanarPose counted = drive.truth[0];
  PlanarPose estimate = counted;
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
    }
    Sample& sample = simulated.samples[i];
    sample.estimate = estimate;
    sample.z = 0.0;
    sample.quaternion.reset();
    sample.covariance.reset();
    sample.covariance_36.reset();
    sample.geodetic.reset();
  }
  return simulated;
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

}  // namespace revisit::client
