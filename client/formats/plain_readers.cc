#include "client/formats/plain_readers.h"

#include <array>
#include <cmath>
#include <string>
#include <utility>
#include <vector>

#include "absl/strings/str_cat.h"

namespace revisit::client {
namespace {

constexpr double kQuaternionTolerance = 1e-3;

// The next line that is neither blank nor a comment. What the last comment
// before it says of a recording that begins is put into `recording_start`.
bool NextLine(Lines* lines, std::vector<std::string_view>* fields,
              std::optional<std::string>* recording_start = nullptr) {
  std::string_view line;
  do {
    if (!lines->Next(&line)) return false;
    *fields = SplitAtBlanks(line);
    if (recording_start != nullptr &&
        line.substr(0, kRecordingMark.size()) == kRecordingMark) {
      *recording_start = line.substr(kRecordingMark.size());
    }
  } while (fields->empty() || (*fields)[0][0] == '#');
  return true;
}

class TumReader : public SampleReader {
 public:
  TumReader(std::unique_ptr<Lines> lines, TimeUnit unit)
      : lines_(std::move(lines)), unit_(unit) {}

  absl::StatusOr<std::optional<Sample>> Next() override {
    constexpr std::array<const char*, 7> kNames = {"x",  "y",  "z", "qx",
                                                   "qy", "qz", "qw"};
    std::optional<std::string> recording_start;
    if (!NextLine(lines_.get(), &fields_, &recording_start)) {
      return EndOf(*lines_);
    }
    if (fields_.size() != kNames.size() + 1) {
      return lines_->Error(absl::StrCat(
          "expected 8 fields \"t x y z qx qy qz qw\", got ", fields_.size()));
    }
    const auto time = ReadTime(fields_[0], unit_, *lines_);
    if (!time.ok()) return time.status();
    std::array<double, kNames.size()> values;
    for (std::size_t i = 0; i < kNames.size(); ++i) {
      const auto value = ReadNumber(fields_[i + 1], kNames[i], *lines_);
      if (!value.ok()) return value.status();
      values[i] = *value;
    }
    Sample sample;
    sample.line = lines_->number();
    sample.time_nanoseconds = *time;
    sample.estimate = {values[0], values[1], 0.0};
    sample.z = values[2];
    sample.quaternion = {values[3], values[4], values[5], values[6]};
    sample.recording_start = std::move(recording_start);
    if (absl::Status status = CheckPose(sample, *lines_); !status.ok()) {
      return status;
    }
    return sample;
  }

 private:
  const std::unique_ptr<Lines> lines_;
  const TimeUnit unit_;
  std::vector<std::string_view> fields_;
};

class KittiReader : public SampleReader {
 public:
  explicit KittiReader(std::unique_ptr<Lines> lines)
      : lines_(std::move(lines)) {}

  absl::StatusOr<std::optional<Sample>> Next() override {
    constexpr std::size_t kNumbers = 12;
    if (!NextLine(lines_.get(), &fields_)) return EndOf(*lines_);
    if (fields_.size() != kNumbers) {
      return lines_->Error(
          absl::StrCat("expected 12 numbers, the rows of a 3x4 matrix, got ",
                       fields_.size()));
    }
    std::array<double, kNumbers> values;
    for (std::size_t i = 0; i < kNumbers; ++i) {
      const auto value =
          ReadNumber(fields_[i],
                     absl::StrCat("number ", i + 1, " of the matrix"), *lines_);
      if (!value.ok()) return value.status();
      values[i] = *value;
    }
    const auto& v = values;
    Sample sample;
    sample.line = lines_->number();
    sample.estimate = {v[3], v[7], 0.0};
    sample.z = v[11];
    sample.quaternion =
        QuaternionOf({v[0], v[1], v[2], v[4], v[5], v[6], v[8], v[9], v[10]});
    if (!sample.quaternion.has_value()) {
      return lines_->Error(
          "expected a rotation in numbers 1-3, 5-7 and 9-11: rows that are "
          "orthonormal to 1e-2");
    }
    return sample;
  }

 private:
  const std::unique_ptr<Lines> lines_;
  std::vector<std::string_view> fields_;
};

}  // namespace

absl::StatusOr<std::unique_ptr<SampleReader>> ReadTum(
    std::unique_ptr<Lines> lines, const ReaderOptions& options) {
  return std::make_unique<TumReader>(std::move(lines), options.time_unit);
}

absl::StatusOr<std::unique_ptr<SampleReader>> ReadKitti(
    std::unique_ptr<Lines> lines, const ReaderOptions& /*options*/) {
  return std::make_unique<KittiReader>(std::move(lines));
}

absl::StatusOr<std::optional<Sample>> EndOf(const Lines& lines) {
  if (!lines.status().ok()) return lines.status();
  return std::optional<Sample>();
}

absl::Status CheckPose(const Sample& sample, const Lines& lines) {
  if (sample.geodetic.has_value() &&
      !(std::abs(sample.geodetic->latitude_degrees) <= 90.0 &&
        std::abs(sample.geodetic->longitude_degrees) <= 180.0)) {
    return lines.Error(
        "expected a latitude within 90 and a longitude within 180 degrees, "
        "got " +
        std::to_string(sample.geodetic->latitude_degrees) + ", " +
        std::to_string(sample.geodetic->longitude_degrees));
  }
  if (sample.quaternion.has_value()) {
    const auto [x, y, z, w] = *sample.quaternion;
    const double norm = std::sqrt(x * x + y * y + z * z + w * w);
    if (!(std::abs(norm - 1.0) <= kQuaternionTolerance)) {
      return lines.Error("expected a quaternion of norm 1, got one of norm " +
                         std::to_string(norm));
    }
  }
  return absl::OkStatus();
}

}  // namespace revisit::client
