#include "client/formats/gnss_file.h"

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <map>
#include <string_view>

#include "absl/strings/str_cat.h"
#include "client/formats/angles.h"
#include "client/formats/text_lines.h"

namespace revisit::client {
namespace {

// 1980-01-06, where GPS weeks begin.
constexpr double kGpsEpochSeconds = 315'964'800.0;
constexpr double kSecondsPerWeek = 604'800.0;
constexpr double kSecondsPerDay = 86'400.0;

using Columns = std::map<std::string, std::size_t, std::less<>>;

absl::Status RequireColumns(const Columns& columns,
                            const std::vector<const char*>& names,
                            const Lines& lines) {
  for (const char* name : names) {
    if (columns.count(name) == 0) {
      return lines.Error(std::string("expected a column \"") + name + "\"");
    }
  }
  return absl::OkStatus();
}

std::string_view WithoutBlanks(std::string_view text) {
  constexpr std::string_view kBlanks = " \t";
  const std::size_t begin = text.find_first_not_of(kBlanks);
  if (begin == std::string_view::npos) return {};
  return text.substr(begin, text.find_last_not_of(kBlanks) - begin + 1);
}

// Numbers of one line by column; remembers the first error.
class Row {
 public:
  Row(const Columns& columns, const std::vector<std::string_view>& fields,
      const Lines& lines)
      : columns_(columns), fields_(fields), lines_(lines) {}

  double Get(const char* name) {
    const auto value =
        ReadNumber(fields_[columns_.find(name)->second], name, lines_);
    if (value.ok()) return *value;
    status_.Update(value.status());
    return 0.0;
  }

  const absl::Status& status() const { return status_; }

 private:
  const Columns& columns_;
  const std::vector<std::string_view>& fields_;
  const Lines& lines_;
  absl::Status status_;
};

// Days from 1970-01-01 to a date of the Gregorian calendar, years from March.
std::int64_t DaysSince1970(std::int64_t year, std::int64_t month,
                           std::int64_t day) {
  if (month <= 2) {
    --year;
    month += 12;
  }
  return 365 * year + year / 4 - year / 100 + year / 400 +
         (153 * (month - 3) + 2) / 5 + day - 1 - 719'468;
}

// "2023/07/11" and "06:04:30.000".
absl::StatusOr<double> ReadCalendarTime(std::string_view date,
                                        std::string_view time,
                                        const Lines& lines) {
  const auto part = [&](std::string_view text, std::size_t from,
                        std::size_t length) {
    return ReadNumber(text.substr(from, length), "date or time", lines);
  };
  if (date.size() != 10 || date[4] != '/' || date[7] != '/' ||
      time.size() < 8 || time[2] != ':' || time[5] != ':') {
    return lines.Error("expected a time such as 2023/07/11 06:04:30.000, got " +
                       Quoted(std::string(date) + " " + std::string(time)));
  }
  double values[6];
  const absl::StatusOr<double> parts[] = {
      part(date, 0, 4), part(date, 5, 2),
      part(date, 8, 2), part(time, 0, 2),
      part(time, 3, 2), part(time, 6, std::string_view::npos)};
  for (std::size_t i = 0; i < std::size(parts); ++i) {
    if (!parts[i].ok()) return parts[i].status();
    values[i] = *parts[i];
  }
  const auto whole = [](double value) {
    return static_cast<std::int64_t>(value);
  };
  if (values[0] < 0.0 || values[0] > 9999.0 || values[1] < 1.0 ||
      values[1] > 12.0 || values[2] < 1.0 || values[2] > 31.0) {
    return lines.Error("expected a date, got " + Quoted(date));
  }
  return kSecondsPerDay *
             static_cast<double>(DaysSince1970(
                 whole(values[0]), whole(values[1]), whole(values[2]))) +
         3600.0 * values[3] + 60.0 * values[4] + values[5];
}

double SignedSquare(double value) { return value * std::abs(value); }

absl::Status CheckPosition(const GeodeticPosition& position,
                           const Lines& lines) {
  if (std::abs(position.latitude_degrees) <= 90.0 &&
      std::abs(position.longitude_degrees) <= 180.0) {
    return absl::OkStatus();
  }
  return lines.Error(
      "expected a latitude within 90 and a longitude within 180 "
      "degrees, got " +
      std::to_string(position.latitude_degrees) + ", " +
      std::to_string(position.longitude_degrees));
}

// The reference at a time among its own.
PlanarPose Interpolate(const std::vector<ReferencePose>& reference,
                       double time_seconds, const GeodeticPosition& origin) {
  const auto after =
      std::upper_bound(reference.begin(), reference.end(), time_seconds,
                       [](double time, const ReferencePose& p) {
                         return time < p.time_seconds;
                       });
  const ReferencePose& a = after[-1];
  const ReferencePose& b = after == reference.end() ? a : after[0];
  const double span = b.time_seconds - a.time_seconds;
  const double part = span > 0.0 ? (time_seconds - a.time_seconds) / span : 0.0;
  const auto from = EastNorthUp(origin, a.position);
  const auto to = EastNorthUp(origin, b.position);
  const double turn = std::remainder(b.heading - a.heading, 2.0 * kPi);
  return {from[0] + part * (to[0] - from[0]),
          from[1] + part * (to[1] - from[1]),
          std::remainder(a.heading + part * turn, 2.0 * kPi)};
}

}  // namespace

absl::StatusOr<std::vector<GnssFix>> ReadRtklib(std::istream& input,
                                                const std::string& path) {
  Lines lines(input, path);
  std::string line;
  Columns columns;
  std::vector<GnssFix> fixes;
  bool first = true;
  while (lines.Next(&line)) {
    if (first) {
      first = false;
      if (absl::Status status = RefuseCompressed(line, lines); !status.ok()) {
        return status;
      }
    }
    if (!line.empty() && line[0] == '%') {
      const auto names = SplitAtBlanks(std::string_view(line).substr(1));
      if (names.empty() || names[0] != "GPST") continue;
      columns.clear();
      // Time takes two fields.
      for (std::size_t i = 1; i < names.size(); ++i) {
        if (!columns.emplace(names[i], i + 1).second) {
          return lines.Error("column " + Quoted(names[i]) + " stands twice");
        }
      }
      if (absl::Status status =
              RequireColumns(columns,
                             {"latitude(deg)", "longitude(deg)", "height(m)",
                              "sdn(m)", "sde(m)", "sdne(m)", "vn(m/s)",
                              "ve(m/s)", "sdvn", "sdve", "sdvne"},
                             lines);
          !status.ok()) {
        return status;
      }
      continue;
    }
    if (columns.empty()) {
      return lines.Error(
          "expected a line \"% GPST latitude(deg) ...\" that "
          "names the columns before this one");
    }
    const auto fields = SplitAtBlanks(line);
    if (fields.size() != columns.size() + 2) {
      return lines.Error(absl::StrCat("expected ", columns.size() + 2,
                                      " fields, got ", fields.size()));
    }
    const auto time = ReadCalendarTime(fields[0], fields[1], lines);
    if (!time.ok()) return time.status();
    Row row(columns, fields, lines);
    GnssFix fix;
    fix.time_seconds = *time;
    fix.position = {row.Get("latitude(deg)"), row.Get("longitude(deg)"),
                    row.Get("height(m)")};
    fix.position_covariance = {SignedSquare(row.Get("sde(m)")),
                               SignedSquare(row.Get("sdne(m)")),
                               SignedSquare(row.Get("sdn(m)"))};
    fix.east_velocity = row.Get("ve(m/s)");
    fix.north_velocity = row.Get("vn(m/s)");
    fix.velocity_covariance = {SignedSquare(row.Get("sdve")),
                               SignedSquare(row.Get("sdvne")),
                               SignedSquare(row.Get("sdvn"))};
    if (!row.status().ok()) return row.status();
    if (absl::Status status = CheckPosition(fix.position, lines);
        !status.ok()) {
      return status;
    }
    fixes.push_back(fix);
  }
  if (input.bad()) return absl::DataLossError(path + ": cannot be read");
  if (fixes.empty()) {
    return lines.Error("expected at least one epoch after this line");
  }
  return fixes;
}

absl::StatusOr<std::vector<ReferencePose>> ReadReference(
    std::istream& input, const std::string& path) {
  Lines lines(input, path);
  std::string line;
  if (!lines.Next(&line)) return lines.Error("expected a header line");
  if (absl::Status status = RefuseCompressed(line, lines); !status.ok()) {
    return status;
  }
  Columns columns;
  for (const std::string_view name : SplitAtCommas(line)) {
    const std::size_t index = columns.size();
    if (!columns.emplace(WithoutBlanks(name), index).second) {
      return lines.Error("column " + Quoted(name) + " stands twice");
    }
  }
  if (absl::Status status = RequireColumns(
          columns,
          {"GPS TOW (s)", "GPS Week", "Latitude (deg)", "Longitude (deg)",
           "Ellipsoid Height (m)", "Heading (deg)"},
          lines);
      !status.ok()) {
    return status;
  }
  std::vector<ReferencePose> reference;
  while (lines.Next(&line)) {
    auto fields = SplitAtCommas(line);
    if (fields.size() != columns.size()) {
      return lines.Error(absl::StrCat("expected ", columns.size(),
                                      " fields as in the header, got ",
                                      fields.size()));
    }
    for (std::string_view& field : fields) field = WithoutBlanks(field);
    Row row(columns, fields, lines);
    ReferencePose pose;
    pose.time_seconds = kGpsEpochSeconds +
                        kSecondsPerWeek * row.Get("GPS Week") +
                        row.Get("GPS TOW (s)");
    pose.position = {row.Get("Latitude (deg)"), row.Get("Longitude (deg)"),
                     row.Get("Ellipsoid Height (m)")};
    pose.heading = (90.0 - row.Get("Heading (deg)")) * kRadiansPerDegree;
    if (!row.status().ok()) return row.status();
    if (absl::Status status = CheckPosition(pose.position, lines);
        !status.ok()) {
      return status;
    }
    if (!reference.empty() &&
        pose.time_seconds <= reference.back().time_seconds) {
      return lines.Error("expected times that grow");
    }
    reference.push_back(pose);
  }
  if (input.bad()) return absl::DataLossError(path + ": cannot be read");
  if (reference.empty()) {
    return lines.Error("expected at least one pose after this line");
  }
  return reference;
}

absl::StatusOr<Drive> MakeGnssDrive(const std::string& name,
                                    const std::vector<GnssFix>& fixes,
                                    const std::vector<ReferencePose>& reference,
                                    const GeodeticPosition& origin) {
  Drive drive;
  drive.name = name;
  double last_time = 0.0;
  for (const GnssFix& fix : fixes) {
    if (&fix != &fixes.front() && fix.time_seconds <= last_time) {
      return absl::InvalidArgumentError(name + ": expected times that grow");
    }
    last_time = fix.time_seconds;
    const double speed = std::hypot(fix.east_velocity, fix.north_velocity);
    if (speed < kGnssStandstillMetersPerSecond) continue;
    if (fix.time_seconds < reference.front().time_seconds ||
        fix.time_seconds > reference.back().time_seconds) {
      return absl::InvalidArgumentError(
          absl::StrCat(name, ": an epoch at ", std::to_string(fix.time_seconds),
                       " s lies outside the reference's times, ",
                       std::to_string(reference.front().time_seconds), " to ",
                       std::to_string(reference.back().time_seconds), " s"));
    }
    // The unit vector to the left of the velocity.
    const double left_east = -fix.north_velocity / speed;
    const double left_north = fix.east_velocity / speed;
    const auto& [ee, en, nn] = fix.velocity_covariance;
    const double across = left_east * left_east * ee +
                          2.0 * left_east * left_north * en +
                          left_north * left_north * nn;
    const auto local = EastNorthUp(origin, fix.position);
    DriveSample sample;
    sample.time_seconds = fix.time_seconds;
    sample.estimate = {local[0], local[1],
                       std::atan2(fix.north_velocity, fix.east_velocity)};
    sample.estimate_z = local[2];
    sample.geodetic = fix.position;
    const auto& [xx, xy, yy] = fix.position_covariance;
    sample.covariance = {xx, xy, 0.0, yy, 0.0, across / (speed * speed)};
    drive.samples.push_back(sample);
    drive.truth.push_back(Interpolate(reference, fix.time_seconds, origin));
  }
  if (drive.samples.empty()) {
    return absl::InvalidArgumentError(name + ": the vehicle never moves");
  }
  return drive;
}

}  // namespace revisit::client
