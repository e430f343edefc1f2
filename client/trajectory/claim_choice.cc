#include "client/trajectory/claim_choice.h"

#include <algorithm>
#include <cmath>
#include <cstddef>

#include "absl/strings/str_cat.h"

namespace revisit::client {
namespace {

using Source = UncertaintyOptions::Source;

// Path over which covariances of dead reckoning have to grow.
constexpr double kGrowthMeters = 20.0;

enum class Growth { kNone, kUnknown, kGrows };

// Whether the samples may state covariances of dead reckoning: these grow along
// the path, though less on a way back to the start. The covariances that a
// driver writes into every message stay the same, and those of a receiver go up
// and down.
Growth GrowthOf(const std::deque<Sample>& samples) {
  const auto size = [](const Sample& sample) {
    return (*sample.covariance)[0] + (*sample.covariance)[3];
  };
  double length = 0.0;
  std::size_t decreases = 0;
  for (std::size_t i = 1; i < samples.size(); ++i) {
    const Sample& before = samples[i - 1];
    const Sample& after = samples[i];
    length += std::hypot(after.estimate.x - before.estimate.x,
                         after.estimate.y - before.estimate.y);
    if (size(after) < size(before)) ++decreases;
  }
  if (length < kGrowthMeters) return Growth::kUnknown;
  const double first = size(samples.front());
  const double last = size(samples.back());
  const bool grows =
      last > 2.0 * first || (last > first && 3 * decreases < samples.size());
  return grows ? Growth::kGrows : Growth::kNone;
}

bool HaveCovariances(const std::deque<Sample>& samples) {
  return std::all_of(samples.begin(), samples.end(), [](const Sample& sample) {
    return sample.covariance.has_value();
  });
}

}  // namespace

absl::Status CheckThatErrorsAreKnown(const std::string& file,
                                     const Sample& first, Frame frame) {
  // Latitudes and longitudes are a receiver's, and so is what states how good a
  // position is.
  if (first.geodetic.has_value() || !first.heading_variance.has_value() ||
      first.covariance.has_value() || frame == Frame::kLocal) {
    return absl::OkStatus();
  }
  return absl::InvalidArgumentError(absl::StrCat(
      file,
      ": has positions without a heading, and does not say what errors they "
      "have: --uncertainty fixes if each has its own, as a receiver's "
      "(--fix-sigma M says how large), --uncertainty model if they add up "
      "along the drive, as those of odometry (--sigma-along and so on)"));
}

Source ChooseSource(const std::deque<Sample>& first, bool is_filter) {
  if (first.front().heading_variance.has_value() || is_filter) {
    return Source::kFixes;
  }
  return HaveCovariances(first) && GrowthOf(first) == Growth::kGrows
             ? Source::kFile
             : Source::kModel;
}

std::string ChoiceText(const std::deque<Sample>& first, Source chosen) {
  if (!HaveCovariances(first) || chosen == Source::kFixes) return "";
  switch (GrowthOf(first)) {
    case Growth::kGrows:
      return "its covariances are claimed (--uncertainty file; model claims "
             "those of --sigma-along and so on)";
    case Growth::kNone:
      return "its covariances do not grow along the drive, as errors of dead "
             "reckoning do, and are not claimed; --uncertainty file claims "
             "them, fixes if each pose has errors of its own";
    case Growth::kUnknown:
      return "has covariances, of which the first poses do not show whether "
             "they grow along the drive; they are not claimed without "
             "--uncertainty file";
  }
  return "";
}

}  // namespace revisit::client
