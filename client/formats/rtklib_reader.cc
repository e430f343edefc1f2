#include <array>
#include <cmath>
#include <map>
#include <string>
#include <utility>
#include <vector>

#include "absl/strings/str_cat.h"
#include "client/formats/gnss_readers.h"
#include "client/formats/plain_readers.h"

namespace revisit::client {
namespace {

using Columns = std::map<std::string, std::size_t, std::less<>>;

double SignedSquare(double value) { return value * std::abs(value); }

class RtklibReader : public SampleReader {
 public:
  explicit RtklibReader(std::unique_ptr<Lines> lines)
      : lines_(std::move(lines)) {}

  absl::StatusOr<std::optional<Sample>> Next() override {
    std::string_view line;
    while (lines_->Next(&line)) {
      if (WithoutBlanks(line).empty()) continue;
      if (line[0] == '%') {
        if (absl::Status status = ReadComment(line); !status.ok()) {
          return status;
        }
        continue;
      }
      return ReadEpoch(line);
    }
    return EndOf(*lines_);
  }

 private:
  absl::Status ReadComment(std::string_view line) {
    const auto names = SplitAtBlanks(line.substr(1));
    if (names.empty() ||
        (names[0] != "GPST" && names[0] != "UTC" && names[0] != "JST")) {
      return absl::OkStatus();
    }
    columns_.clear();
    // Time takes two fields.
    for (std::size_t i = 1; i < names.size(); ++i) {
      if (!columns_.emplace(names[i], i + 1).second) {
        return lines_->Error("column " + Quoted(names[i]) + " stands twice");
      }
    }
    for (const char* name : {"latitude(deg)", "longitude(deg)", "height(m)"}) {
      if (columns_.count(name) == 0) {
        return lines_->Error(
            absl::StrCat("expected a column \"", name,
                         "\", which RTKLIB writes with out-solformat=llh and "
                         "out-degform=deg"));
      }
    }
    has_deviations_ = Has({"sdn(m)", "sde(m)", "sdne(m)"});
    has_height_deviations_ = Has({"sdu(m)", "sdeu(m)", "sdun(m)"});
    has_velocity_ = Has({"vn(m/s)", "ve(m/s)"});
    has_velocity_deviations_ = Has({"sdvn", "sdve", "sdvne"});
    return absl::OkStatus();
  }

  bool Has(std::initializer_list<const char*> names) const {
    for (const char* name : names) {
      if (columns_.count(name) == 0) return false;
    }
    return true;
  }

  absl::StatusOr<std::int64_t> Time() const {
    const std::string_view date = fields_[0];
    const std::string_view time = fields_[1];
    int part[3];
    if (date.size() == 10 && date[4] == '/' && date[7] == '/') {
      const std::string_view parts[] = {date.substr(0, 4), date.substr(5, 2),
                                        date.substr(8, 2)};
      for (std::size_t i = 0; i < 3; ++i) {
        const auto number = ReadNumber(parts[i], "the date", *lines_);
        if (!number.ok()) return number.status();
        part[i] = static_cast<int>(*number);
      }
      const auto stamp = TimeOfDate(part[0], part[1], part[2], time);
      if (stamp.ok()) return stamp;
    } else if (date.find_first_not_of("0123456789") == date.npos &&
               date.size() <= 5) {
      const auto week = ReadNumber(date, "the GPS week", *lines_);
      if (!week.ok()) return week.status();
      const auto seconds = NanosecondsOf(time);
      if (seconds.ok()) {
        if (const auto stamp = TimeOfGpsWeek(*week, *seconds)) return *stamp;
      }
    }
    return lines_->Error(
        "expected a time such as 2023/07/11 06:04:30.000, or a GPS week and "
        "seconds, got " +
        Quoted(std::string(date) + " " + std::string(time)));
  }

  // `get` reads the column of a name.
  template <typename Get>
  void ReadDeviations(const Get& get, Sample* sample) const {
    // Deviations of 0 state nothing.
    if (has_deviations_ && get("sde(m)") > 0.0 && get("sdn(m)") > 0.0) {
      sample->position_covariance = {SignedSquare(get("sde(m)")),
                                     SignedSquare(get("sdne(m)")),
                                     SignedSquare(get("sdn(m)"))};
    }
    if (has_height_deviations_ && get("sdu(m)") > 0.0) {
      sample->height_covariance = {SignedSquare(get("sdeu(m)")),
                                   SignedSquare(get("sdun(m)")),
                                   SignedSquare(get("sdu(m)"))};
    }
    if (has_velocity_) {
      sample->velocity = {get("ve(m/s)"), get("vn(m/s)"), std::nullopt};
      if (has_velocity_deviations_ && get("sdve") > 0.0 && get("sdvn") > 0.0) {
        sample->velocity->covariance = {SignedSquare(get("sdve")),
                                        SignedSquare(get("sdvne")),
                                        SignedSquare(get("sdvn"))};
      }
    }
  }

  absl::StatusOr<std::optional<Sample>> ReadEpoch(std::string_view line) {
    if (columns_.empty()) {
      return lines_->Error(
          "expected a line \"% GPST latitude(deg) ...\" that names the columns "
          "before this one (out-outhead=on)");
    }
    fields_ = SplitAtBlanks(line);
    if (fields_.size() != columns_.size() + 2) {
      return lines_->Error(absl::StrCat("expected ", columns_.size() + 2,
                                        " fields, got ", fields_.size()));
    }
    const auto time = Time();
    if (!time.ok()) return time.status();
    absl::Status error;
    const auto get = [&](const char* name) {
      const auto value =
          ReadNumber(fields_[columns_.find(name)->second], name, *lines_);
      if (value.ok()) return *value;
      error.Update(value.status());
      return 0.0;
    };
    Sample sample;
    sample.line = lines_->number();
    sample.time_nanoseconds = *time;
    sample.has_heading = false;
    sample.geodetic = {get("latitude(deg)"), get("longitude(deg)"),
                       get("height(m)")};
    ReadDeviations(get, &sample);
    if (!error.ok()) return error;
    if (absl::Status status = CheckPose(sample, *lines_); !status.ok()) {
      return status;
    }
    return sample;
  }

  const std::unique_ptr<Lines> lines_;
  Columns columns_;
  bool has_deviations_ = false;
  bool has_height_deviations_ = false;
  bool has_velocity_ = false;
  bool has_velocity_deviations_ = false;
  std::vector<std::string_view> fields_;
};

}  // namespace

absl::StatusOr<std::unique_ptr<SampleReader>> ReadRtklib(
    std::unique_ptr<Lines> lines, const ReaderOptions& /*options*/) {
  return std::make_unique<RtklibReader>(std::move(lines));
}

}  // namespace revisit::client
