#include "client/formats/drive_file.h"

#include <cmath>
#include <map>
#include <string_view>

#include "absl/strings/str_cat.h"
#include "client/formats/text_lines.h"

namespace revisit::client {
namespace {

// Stamps must fit the proto's years 1678 to 2261.
constexpr double kMaxTimeSeconds = 9.2e9;
constexpr double kQuaternionTolerance = 1e-3;

constexpr const char* kEstimateColumns[] = {"t_s", "est_x", "est_y", "est_yaw"};
constexpr const char* kTruthColumns[] = {"gt_x", "gt_y", "gt_yaw"};
constexpr const char* kCovarianceColumns[] = {"pxx", "pxy", "pxt",
                                              "pyy", "pyt", "ptt"};

absl::Status CheckTime(double seconds, const Lines& lines) {
  if (std::abs(seconds) <= kMaxTimeSeconds) return absl::OkStatus();
  return lines.Error(
      "expected a time within 9.2e9 seconds of the Unix epoch, got " +
      std::to_string(seconds));
}

using Columns = std::map<std::string, std::size_t, std::less<>>;

bool IsKnown(std::string_view name) {
  for (const char* known : kEstimateColumns) {
    if (name == known) return true;
  }
  for (const char* known : kTruthColumns) {
    if (name == known) return true;
  }
  for (const char* known : kCovarianceColumns) {
    if (name == known) return true;
  }
  return name == "frame";
}

absl::StatusOr<Columns> ReadHeader(const std::string& line,
                                   const Lines& lines) {
  if (absl::Status status = RefuseCompressed(line, lines); !status.ok()) {
    return status;
  }
  Columns columns;
  const auto names = SplitAtCommas(line);
  for (std::size_t i = 0; i < names.size(); ++i) {
    if (!IsKnown(names[i])) {
      return lines.Error(
          "expected a header line of the columns frame, t_s, gt_x, gt_y, "
          "gt_yaw, est_x, est_y, est_yaw, pxx, pxy, pxt, pyy, pyt, ptt, got " +
          Quoted(names[i]));
    }
    if (!columns.emplace(names[i], i).second) {
      return lines.Error("column " + std::string(names[i]) + " stands twice");
    }
  }
  for (const char* name : kEstimateColumns) {
    if (columns.count(name) == 0) {
      return lines.Error(std::string("expected a column ") + name);
    }
  }
  return columns;
}

// Whether a group of columns is there; an error if only a part of it is.
template <std::size_t N>
absl::StatusOr<bool> HasGroup(const Columns& columns,
                              const char* const (&names)[N],
                              const Lines& lines) {
  std::size_t found = 0;
  const char* missing = nullptr;
  for (const char* name : names) {
    if (columns.count(name) > 0) {
      ++found;
    } else {
      missing = name;
    }
  }
  if (found > 0 && missing != nullptr) {
    return lines.Error(std::string("expected a column ") + missing +
                       ", since others of its group are there");
  }
  return found > 0;
}

absl::StatusOr<Drive> ReadCommaSeparated(Lines& lines) {
  std::string line;
  if (!lines.Next(&line)) return lines.Error("expected a header line");
  const auto columns = ReadHeader(line, lines);
  if (!columns.ok()) return columns.status();
  const auto has_truth = HasGroup(*columns, kTruthColumns, lines);
  if (!has_truth.ok()) return has_truth.status();
  const auto has_covariance = HasGroup(*columns, kCovarianceColumns, lines);
  if (!has_covariance.ok()) return has_covariance.status();

  Drive drive;
  while (lines.Next(&line)) {
    const auto fields = SplitAtCommas(line);
    if (fields.size() != columns->size()) {
      return lines.Error(absl::StrCat("expected ", columns->size(),
                                      " fields as in the header, got ",
                                      fields.size()));
    }
    std::map<std::string, double, std::less<>> values;
    for (const auto& [name, index] : *columns) {
      const auto value = ReadNumber(fields[index], name, lines);
      if (!value.ok()) return value.status();
      values.emplace(name, *value);
    }
    DriveSample sample;
    sample.time_seconds = values["t_s"];
    if (absl::Status status = CheckTime(sample.time_seconds, lines);
        !status.ok()) {
      return status;
    }
    sample.estimate = {values["est_x"], values["est_y"], values["est_yaw"]};
    if (*has_covariance) {
      sample.covariance = {values["pxx"], values["pxy"], values["pxt"],
                           values["pyy"], values["pyt"], values["ptt"]};
    }
    drive.samples.push_back(sample);
    if (*has_truth) {
      drive.truth.push_back({values["gt_x"], values["gt_y"], values["gt_yaw"]});
    }
  }
  return drive;
}

absl::StatusOr<Drive> ReadTum(Lines& lines) {
  constexpr const char* kNames[] = {"t", "x", "y", "z", "qx", "qy", "qz", "qw"};
  constexpr std::size_t kFields = std::size(kNames);
  Drive drive;
  std::string line;
  while (lines.Next(&line)) {
    const auto fields = SplitAtBlanks(line);
    if (!fields.empty() && fields[0][0] == '#') continue;
    if (fields.size() != kFields) {
      return lines.Error(absl::StrCat(
          "expected 8 fields \"t x y z qx qy qz qw\", got ", fields.size()));
    }
    double values[kFields];
    for (std::size_t i = 0; i < kFields; ++i) {
      const auto value = ReadNumber(fields[i], kNames[i], lines);
      if (!value.ok()) return value.status();
      values[i] = *value;
    }
    if (absl::Status status = CheckTime(values[0], lines); !status.ok()) {
      return status;
    }
    const auto [qx, qy, qz, qw] =
        std::array<double, 4>{values[4], values[5], values[6], values[7]};
    const double norm = std::sqrt(qx * qx + qy * qy + qz * qz + qw * qw);
    if (std::abs(norm - 1.0) > kQuaternionTolerance) {
      return lines.Error("expected a quaternion of norm 1, got one of norm " +
                         std::to_string(norm));
    }
    // Where body x points in the local x-y plane.
    const double forward_x = qw * qw + qx * qx - qy * qy - qz * qz;
    const double forward_y = 2.0 * (qx * qy + qw * qz);
    DriveSample sample;
    sample.time_seconds = values[0];
    sample.estimate = {values[1], values[2], std::atan2(forward_y, forward_x)};
    sample.estimate_z = values[3];
    sample.quaternion = {qx, qy, qz, qw};
    drive.samples.push_back(sample);
  }
  return drive;
}

}  // namespace

absl::StatusOr<Drive> ReadDrive(std::istream& input, const std::string& path,
                                DriveFormat format) {
  Lines lines(input, path);
  auto drive =
      format == DriveFormat::kTum ? ReadTum(lines) : ReadCommaSeparated(lines);
  if (!drive.ok()) return drive.status();
  if (input.bad()) return absl::DataLossError(path + ": cannot be read");
  if (drive->samples.empty()) {
    return lines.Error("expected at least one pose after this line");
  }
  drive->name = StemOf(path);
  return drive;
}

absl::StatusOr<Drive> ReadDriveFile(const std::string& path,
                                    DriveFormat format) {
  const auto input = OpenText(path);
  if (!input.ok()) return input.status();
  return ReadDrive(**input, path, format);
}

}  // namespace revisit::client
