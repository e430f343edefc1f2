#include "client/formats/truth_file.h"

#include <algorithm>
#include <cmath>
#include <map>
#include <string_view>
#include <utility>

#include "absl/strings/str_cat.h"
#include "absl/strings/str_replace.h"
#include "client/formats/angles.h"
#include "client/formats/plain_readers.h"
#include "client/formats/text_lines.h"
#include "client/formats/times.h"

namespace revisit::client {
namespace {

using Columns = std::map<std::string, std::size_t, std::less<>>;

absl::StatusOr<Columns> ReadHeader(std::string_view line, const Lines& lines) {
  Columns columns;
  for (const std::string_view name : SplitAt(',', line)) {
    const std::size_t index = columns.size();
    if (!columns.emplace(WithoutBlanks(name), index).second) {
      return lines.Error("column " + Quoted(name) + " stands twice");
    }
  }
  for (const char* name :
       {"GPS TOW (s)", "GPS Week", "Latitude (deg)", "Longitude (deg)",
        "Ellipsoid Height (m)", "Heading (deg)"}) {
    if (columns.count(name) == 0) {
      return lines.Error(std::string("expected a column \"") + name + "\"");
    }
  }
  return columns;
}

// One line, with its geodetic position; x and y are not set.
absl::StatusOr<Sample> ReadPose(const Columns& columns,
                                const std::vector<std::string_view>& fields,
                                const Lines& lines) {
  absl::Status error;
  const auto field = [&](const char* name) {
    return WithoutBlanks(fields[columns.find(name)->second]);
  };
  const auto number = [&](const char* name) {
    const auto value = ReadNumber(field(name), name, lines);
    if (value.ok()) return *value;
    error.Update(value.status());
    return 0.0;
  };
  const double week = number("GPS Week");
  const auto seconds =
      ReadTime(field("GPS TOW (s)"), TimeUnit::kSeconds, lines);
  if (!seconds.ok()) return seconds.status();
  Sample sample;
  sample.geodetic = {number("Latitude (deg)"), number("Longitude (deg)"),
                     number("Ellipsoid Height (m)")};
  sample.estimate.heading =
      (90.0 - number("Heading (deg)")) * kRadiansPerDegree;
  if (!error.ok()) return error;
  const std::optional<std::int64_t> stamp = TimeOfGpsWeek(week, *seconds);
  if (!stamp.has_value()) {
    return lines.Error(
        "expected a GPS week from 0 to 10000 and seconds of a week, got " +
        Quoted(field("GPS Week")) + " and " + Quoted(field("GPS TOW (s)")));
  }
  sample.time_nanoseconds = *stamp;
  if (absl::Status status = CheckPose(sample, lines); !status.ok()) {
    return status;
  }
  return sample;
}

// The truth at a time among its own.
PlanarPose Interpolate(const std::vector<TruthPose>& truth, std::int64_t time) {
  const auto after = std::upper_bound(truth.begin(), truth.end(), time,
                                      [](std::int64_t t, const TruthPose& p) {
                                        return t < p.time_nanoseconds;
                                      });
  const TruthPose& a = after[-1];
  const TruthPose& b = after == truth.end() ? a : after[0];
  // The two may lie centuries apart, more than their type counts.
  const auto begin = static_cast<long double>(*a.time_nanoseconds);
  const long double span =
      static_cast<long double>(*b.time_nanoseconds) - begin;
  const auto part = static_cast<double>(
      span > 0.0L ? (static_cast<long double>(time) - begin) / span : 0.0L);
  const double turn =
      std::remainder(b.pose.heading - a.pose.heading, 2.0 * kPi);
  return {a.pose.x + part * (b.pose.x - a.pose.x),
          a.pose.y + part * (b.pose.y - a.pose.y),
          std::remainder(a.pose.heading + part * turn, 2.0 * kPi)};
}

std::string SecondsText(std::int64_t nanoseconds) {
  return std::to_string(static_cast<double>(nanoseconds) * 1e-9);
}

absl::Status TimesMustGrow(const std::string& name) {
  return absl::InvalidArgumentError(name + ": expected times that grow");
}

// Names the flags in a message as those of the truth.
absl::Status WithTruthFlags(const absl::Status& status) {
  std::vector<std::pair<std::string, std::string>> names;
  for (const char* word :
       {"format", "columns", "times", "rate", "time-unit", "axes", "body-axes",
        "body-yaw", "angles", "quaternion", "frame", "accept-suspicious"}) {
    names.emplace_back(absl::StrCat("--", word),
                       absl::StrCat("--truth-", word));
  }
  return absl::Status(status.code(),
                      absl::StrReplaceAll(status.message(), names));
}

// The poses of a drive, whose times grow, outside the truth's times.
WithoutTruth FindWithoutTruth(const std::vector<TruthPose>& truth,
                              const std::vector<Sample>& samples) {
  const auto before = [](const Sample& sample, std::int64_t time) {
    return *sample.time_nanoseconds < time;
  };
  const auto after = [](std::int64_t time, const Sample& sample) {
    return time < *sample.time_nanoseconds;
  };
  const std::int64_t first = *truth.front().time_nanoseconds;
  const std::int64_t last = *truth.back().time_nanoseconds;
  const auto begin =
      std::lower_bound(samples.begin(), samples.end(), first, before);
  const auto end = std::upper_bound(begin, samples.end(), last, after);
  const auto seconds = [](std::int64_t a, std::int64_t b) {
    return 1e-9 * (static_cast<double>(b) - static_cast<double>(a));
  };
  WithoutTruth without;
  without.poses_before = static_cast<std::size_t>(begin - samples.begin());
  without.poses_after = static_cast<std::size_t>(samples.end() - end);
  if (without.poses_before > 0) {
    without.seconds_before = seconds(*samples.front().time_nanoseconds, first);
  }
  if (without.poses_after > 0) {
    without.seconds_after = seconds(last, *samples.back().time_nanoseconds);
  }
  return without;
}

absl::Status CheckTimes(const std::vector<TruthPose>& truth,
                        const Drive& drive) {
  for (std::size_t i = 1; i < truth.size(); ++i) {
    if (!(truth[i].time_nanoseconds > truth[i - 1].time_nanoseconds)) {
      return TimesMustGrow(drive.name + ", truth");
    }
  }
  for (std::size_t i = 1; i < drive.samples.size(); ++i) {
    if (!(drive.samples[i].time_nanoseconds >
          drive.samples[i - 1].time_nanoseconds)) {
      return TimesMustGrow(drive.name);
    }
  }
  return absl::OkStatus();
}

absl::Status TruthIsElsewhere(const std::vector<TruthPose>& truth,
                              const Drive& drive, const WithoutTruth& without) {
  return absl::InvalidArgumentError(
      absl::StrCat(drive.name, ": ", without.poses_before + without.poses_after,
                   " of ", drive.samples.size(), " poses, whose times are ",
                   SecondsText(*drive.samples.front().time_nanoseconds), " to ",
                   SecondsText(*drive.samples.back().time_nanoseconds),
                   " s, lie outside the truth's times, ",
                   SecondsText(*truth.front().time_nanoseconds), " to ",
                   SecondsText(*truth.back().time_nanoseconds), " s"));
}

absl::Status AddByIndex(const std::vector<TruthPose>& truth, Drive* drive) {
  if (truth.size() != drive->samples.size()) {
    return absl::InvalidArgumentError(absl::StrCat(
        drive->name, ": expected a true pose for each of the ",
        drive->samples.size(), " without times, got ", truth.size()));
  }
  drive->truth.clear();
  for (const TruthPose& one : truth) drive->truth.push_back(one.pose);
  return absl::OkStatus();
}

}  // namespace

absl::StatusOr<std::vector<TruthPose>> ReadReference(
    std::unique_ptr<ByteSource> source, const std::string& path,
    const std::optional<GeodeticPosition>& origin) {
  Lines lines(std::move(source), path);
  std::string_view line;
  if (!lines.Next(&line)) {
    return lines.status().ok() ? lines.Error("expected a header line")
                               : lines.status();
  }
  const auto columns = ReadHeader(line, lines);
  if (!columns.ok()) return columns.status();
  std::vector<TruthPose> truth;
  std::optional<GeodeticPosition> from = origin;
  while (lines.Next(&line)) {
    const auto fields = SplitAt(',', line);
    if (fields.size() != columns->size()) {
      return lines.Error(absl::StrCat("expected ", columns->size(),
                                      " fields as in the header, got ",
                                      fields.size()));
    }
    const auto sample = ReadPose(*columns, fields, lines);
    if (!sample.ok()) return sample.status();
    if (!truth.empty() &&
        *sample->time_nanoseconds <= *truth.back().time_nanoseconds) {
      return lines.Error("expected times that grow");
    }
    if (!from.has_value()) from = sample->geodetic;
    const auto local = EastNorthUp(*from, *sample->geodetic);
    truth.push_back({sample->time_nanoseconds,
                     {local[0], local[1], sample->estimate.heading}});
  }
  if (!lines.status().ok()) return lines.status();
  if (truth.empty()) {
    return lines.Error("expected at least one pose after this line");
  }
  return truth;
}

absl::StatusOr<std::vector<TruthPose>> ReadTruth(
    const std::string& path, const ReaderOptions& options,
    const std::optional<GeodeticPosition>& origin) {
  if (options.format == Format::kByContent && options.columns.empty()) {
    auto source = OpenBytes(path, nullptr);
    if (!source.ok()) return source.status();
    Lines lines(*std::move(source), path);
    const bool reference =
        lines.PeekFirstLine().find("GPS TOW (s)") != std::string_view::npos;
    if (!lines.status().ok()) return lines.status();
    if (reference) {
      auto again = OpenBytes(path, nullptr);
      if (!again.ok()) return again.status();
      return ReadReference(*std::move(again), path, origin);
    }
  }
  ReaderOptions from_origin = options;
  from_origin.origin = origin;
  const auto drive = ReadDriveFile(path, from_origin);
  if (!drive.ok()) return WithTruthFlags(drive.status());
  std::vector<TruthPose> truth;
  for (const Sample& sample : drive->samples) {
    truth.push_back({sample.time_nanoseconds, sample.estimate});
  }
  return truth;
}

absl::StatusOr<WithoutTruth> AddTruth(const std::vector<TruthPose>& truth,
                                      Drive* drive) {
  std::vector<Sample>& samples = drive->samples;
  const bool timed = samples[0].time_nanoseconds.has_value();
  if (truth.empty() || truth[0].time_nanoseconds.has_value() != timed) {
    return absl::InvalidArgumentError(
        drive->name +
        ": expected times in both the file and its truth, or in neither "
        "(--rate and --times, --truth-rate and --truth-times give them)");
  }
  if (!timed) {
    if (absl::Status status = AddByIndex(truth, drive); !status.ok()) {
      return status;
    }
    return WithoutTruth();
  }
  if (absl::Status status = CheckTimes(truth, *drive); !status.ok()) {
    return status;
  }
  const WithoutTruth without = FindWithoutTruth(truth, samples);
  if (2 * (without.poses_before + without.poses_after) > samples.size()) {
    return TruthIsElsewhere(truth, *drive, without);
  }
  samples.erase(
      samples.end() - static_cast<std::ptrdiff_t>(without.poses_after),
      samples.end());
  samples.erase(samples.begin(), samples.begin() + static_cast<std::ptrdiff_t>(
                                                       without.poses_before));
  drive->truth.clear();
  for (const Sample& sample : samples) {
    drive->truth.push_back(Interpolate(truth, *sample.time_nanoseconds));
  }
  return without;
}

}  // namespace revisit::client
