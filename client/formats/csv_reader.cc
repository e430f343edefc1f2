#include "client/formats/csv_reader.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <string>
#include <utility>
#include <vector>

#include "absl/strings/str_cat.h"
#include "client/formats/csv_layout.h"
#include "client/formats/plain_readers.h"

namespace revisit::client {
namespace {

bool IsComment(std::string_view line) {
  line = WithoutBlanks(line);
  return line.empty() || line[0] == '#' || line[0] == '%';
}

class CsvReader : public SampleReader {
 public:
  CsvReader(std::unique_ptr<Lines> lines, CsvLayout layout)
      : lines_(std::move(lines)), layout_(std::move(layout)) {}

  // Reads lines without names. `first` is the one that was read last: a sample,
  // or names nevertheless.
  CsvReader(std::unique_ptr<Lines> lines, CsvLayout layout, std::string first)
      : CsvReader(std::move(lines), std::move(layout)) {
    has_comments_ = true;
    first_ = std::move(first);
  }

  absl::StatusOr<std::optional<Sample>> Next() override {
    if (first_.has_value()) {
      const std::string first = *std::exchange(first_, std::nullopt);
      if (HasNumbers(first)) return ReadLine(first);
    }
    std::string_view line;
    do {
      if (!lines_->Next(&line)) return EndOf(*lines_);
    } while (has_comments_ ? IsComment(line) : WithoutBlanks(line).empty());
    return ReadLine(line);
  }

 private:
  // Whether some value that is read is a number, which no name is.
  bool HasNumbers(std::string_view line) const {
    const auto fields = FieldsOf(layout_.separator, line);
    return std::any_of(layout_.index.begin(), layout_.index.end(),
                       [&](std::size_t i) {
                         return i < fields.size() && !fields[i].empty() &&
                                ReadNumber(fields[i], "", *lines_).ok();
                       });
  }

  absl::StatusOr<std::optional<Sample>> ReadLine(std::string_view line) {
    fields_ = FieldsOf(layout_.separator, line);
    if (fields_.size() != layout_.fields) {
      return lines_->Error(absl::StrCat("expected ", layout_.fields,
                                        " fields as before, got ",
                                        fields_.size()));
    }
    error_ = absl::OkStatus();
    Sample sample = Read();
    if (!error_.ok()) return error_;
    if (absl::Status status = CheckPose(sample, *lines_); !status.ok()) {
      return status;
    }
    return sample;
  }

  double Number(std::size_t key) {
    const auto value =
        ReadNumber(fields_[layout_.index[key]], layout_.name[key], *lines_);
    if (value.ok()) return *value;
    error_.Update(value.status());
    return 0.0;
  }

  double NumberOrZero(std::size_t key) {
    return layout_.Has(key) ? Number(key) : 0.0;
  }

  template <std::size_t N>
  std::optional<std::array<double, N>> Group(std::size_t first) {
    if (!layout_.Has(first)) return std::nullopt;
    std::array<double, N> values;
    for (std::size_t i = 0; i < N; ++i) values[i] = Number(first + i);
    return values;
  }

  std::optional<std::int64_t> Time(std::size_t key) {
    const auto time =
        ReadTime(fields_[layout_.index[key]], layout_.time_unit, *lines_);
    if (time.ok()) return *time;
    error_.Update(time.status());
    return std::nullopt;
  }

  std::optional<std::int64_t> StampOf() {
    if (layout_.Has(kSeconds)) {
      const double seconds = Number(kSeconds);
      const double nanoseconds = Number(kNanoseconds);
      if (std::abs(seconds) > 9.2e9 || seconds != std::floor(seconds) ||
          nanoseconds < 0.0 || nanoseconds >= 1e9) {
        error_.Update(
            lines_->Error("expected a stamp of whole seconds and nanoseconds"));
        return std::nullopt;
      }
      return static_cast<std::int64_t>(seconds) * kNanosecondsPerSecond +
             static_cast<std::int64_t>(nanoseconds);
    }
    if (layout_.Has(kWeek)) return StampOfWeek();
    if (!layout_.Has(kTime)) return std::nullopt;
    const auto time = Time(kTime);
    if (time == 0 && layout_.Has(kTimeOfArrival)) return Time(kTimeOfArrival);
    return time;
  }

  std::optional<std::int64_t> StampOfWeek() {
    const double week = Number(kWeek);
    const auto seconds = NanosecondsOf(fields_[layout_.index[kTimeOfWeek]]);
    if (seconds.ok()) {
      if (const auto stamp = TimeOfGpsWeek(week, *seconds)) return stamp;
    }
    error_.Update(lines_->Error(
        absl::StrCat("expected a GPS week and seconds of it, got ",
                     Quoted(fields_[layout_.index[kWeek]]), " and ",
                     Quoted(fields_[layout_.index[kTimeOfWeek]]))));
    return std::nullopt;
  }

  // Variances and, where the file has them, covariances of x, y and yaw.
  std::optional<std::array<double, 6>> PlanarCovariance() {
    if (layout_.Has(kDeviation)) {
      const auto square = [&](std::size_t key) {
        const double deviation = NumberOrZero(key);
        return deviation * deviation;
      };
      return std::array<double, 6>{
          square(kDeviation),     0.0, 0.0,
          square(kDeviation + 1), 0.0, square(kDeviation + 3)};
    }
    if (!layout_.Has(kCovariance)) return std::nullopt;
    std::array<double, 6> values;
    for (std::size_t i = 0; i < 6; ++i) {
      values[i] = NumberOrZero(kCovariance + i);
    }
    return values;
  }

  void ReadCovariance(Sample* sample) {
    sample->covariance = PlanarCovariance();
    if (sample->covariance.has_value() && !sample->has_heading) {
      const auto& [xx, xy, xh, yy, yh, hh] = *sample->covariance;
      sample->position_covariance = {xx, xy, yy};
      sample->covariance.reset();
    }
    if (layout_.Has(kDeviation + 2)) {
      const double up = Number(kDeviation + 2);
      sample->height_covariance = {0.0, 0.0, up * up};
    }
    sample->covariance_36 = Group<36>(kCovariance36);
    if (sample->covariance_36.has_value()) {
      sample->covariance = PlanarPart(*sample->covariance_36);
    }
  }

  Sample Read() {
    Sample sample;
    sample.line = lines_->number();
    sample.time_nanoseconds = StampOf();
    if (layout_.Has(kLatitude)) {
      sample.geodetic = {Number(kLatitude), Number(kLongitude),
                         NumberOrZero(kHeight)};
    } else {
      sample.estimate = {Number(kX), Number(kY), 0.0};
      sample.z = NumberOrZero(kZ);
    }
    sample.quaternion = Group<4>(kQuaternion);
    if (!sample.quaternion.has_value()) {
      sample.has_heading = layout_.Has(kYaw);
      sample.estimate.heading = NumberOrZero(kYaw);
    }
    if (const auto velocity = Group<2>(kVelocity)) {
      sample.velocity = {(*velocity)[0], (*velocity)[1], std::nullopt};
    }
    if (const auto truth = Group<3>(kTruth)) {
      sample.truth = {(*truth)[0], (*truth)[1], (*truth)[2]};
    }
    if (layout_.Has(kTruthZ)) sample.truth_z = Number(kTruthZ);
    ReadCovariance(&sample);
    sample.error_transition = Group<9>(kTransition);
    return sample;
  }

  const std::unique_ptr<Lines> lines_;
  const CsvLayout layout_;
  bool has_comments_ = false;
  std::optional<std::string> first_;
  std::vector<std::string_view> fields_;
  absl::Status error_;
};

absl::StatusOr<std::unique_ptr<SampleReader>> ReadCounted(
    std::unique_ptr<Lines> lines, const ReaderOptions& options) {
  std::string_view line;
  do {
    if (!lines->Next(&line)) {
      if (!lines->status().ok()) return lines->status();
      return lines->Error("expected at least one pose, got none");
    }
  } while (IsComment(line));
  std::string first(line);
  auto layout = LayoutOfCounts(first, options, *lines);
  if (!layout.ok()) return layout.status();
  return std::unique_ptr<SampleReader>(std::make_unique<CsvReader>(
      std::move(lines), *std::move(layout), std::move(first)));
}

}  // namespace

bool IsDriveHeader(std::string_view line) {
  const auto names = FieldsOf(SeparatorOf(line), line);
  const auto has = [&](std::string_view name) {
    return std::find(names.begin(), names.end(), name) != names.end();
  };
  return NamesADrive(names) || (has("x") && has("y")) ||
         (has("lat") && has("lon"));
}

bool IsRosCsv(std::string_view line) {
  if (line.substr(0, 6) == "%time,") return true;
  const auto fields = SplitAt(',', line);
  if (fields.size() != kOdometryValues &&
      fields.size() != kPoseWithCovarianceValues) {
    return false;
  }
  // Seconds and nanoseconds; a header of as many columns has names.
  const auto is_whole = [](std::string_view field) {
    return !field.empty() &&
           field.find_first_not_of("-0123456789") == field.npos;
  };
  return is_whole(fields[0]) && is_whole(fields[1]);
}

absl::StatusOr<std::unique_ptr<SampleReader>> ReadCsv(
    std::unique_ptr<Lines> lines, const ReaderOptions& options) {
  if (CountsColumns(options.columns)) {
    return ReadCounted(std::move(lines), options);
  }
  std::string_view line;
  if (!lines->Next(&line)) {
    if (!lines->status().ok()) return lines->status();
    return lines->Error("expected a header line");
  }
  auto layout = LayoutOfHeader(line, options, *lines);
  if (!layout.ok()) return layout.status();
  return std::unique_ptr<SampleReader>(
      std::make_unique<CsvReader>(std::move(lines), *std::move(layout)));
}

absl::StatusOr<std::unique_ptr<SampleReader>> ReadRosCsv(
    std::unique_ptr<Lines> lines, const ReaderOptions&) {
  const std::string first(lines->PeekFirstLine());
  if (!lines->status().ok()) return lines->status();
  const auto fields = FieldsOf(',', first);
  if (fields.size() == kOdometryValues ||
      fields.size() == kPoseWithCovarianceValues) {
    if (!fields[0].empty() && fields[0][0] != '%') {
      return std::unique_ptr<SampleReader>(std::make_unique<CsvReader>(
          std::move(lines), LayoutOfRos2(fields.size())));
    }
  }
  std::string_view line;
  if (!lines->Next(&line)) return lines->Error("expected a header line");
  if (fields[0] != "%time") {
    return lines->Error(absl::StrCat(
        "expected 89 values of nav_msgs/Odometry or 46 of "
        "geometry_msgs/PoseWithCovarianceStamped (ros2 topic echo --csv), or a "
        "header line \"%time,field.header.seq,...\" (rostopic echo -p), got ",
        fields.size(), " values"));
  }
  auto layout = LayoutOfRostopic(FieldsOf(',', line), *lines);
  if (!layout.ok()) return layout.status();
  return std::unique_ptr<SampleReader>(
      std::make_unique<CsvReader>(std::move(lines), *std::move(layout)));
}

}  // namespace revisit::client
