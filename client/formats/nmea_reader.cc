#include <algorithm>
#include <charconv>
#include <cmath>
#include <string>
#include <utility>
#include <vector>

#include "absl/strings/str_cat.h"
#include "client/formats/angles.h"
#include "client/formats/gnss_readers.h"
#include "client/formats/plain_readers.h"

namespace revisit::client {
namespace {

constexpr double kMetersPerSecondPerKnot = 1852.0 / 3600.0;
constexpr std::int64_t kNanosecondsPerDay = 86'400 * kNanosecondsPerSecond;

// The sentences of one time of day, together.
struct Epoch {
  std::int64_t time_of_day = 0;
  bool has_gga = false;
  bool has_rmc = false;
  Sample sample;
};

class NmeaReader : public SampleReader {
 public:
  explicit NmeaReader(std::unique_ptr<Lines> lines)
      : lines_(std::move(lines)) {}

  absl::StatusOr<std::optional<Sample>> Next() override {
    for (;;) {
      std::string_view line;
      if (!lines_->Next(&line)) {
        if (!lines_->status().ok()) return lines_->status();
        if (absl::Status status = CheckShare(); !status.ok()) return status;
        return Emit();
      }
      line = WithoutBlanks(line);
      // Logs of a running receiver begin in the middle of a sentence.
      if (line.empty() || (lines_->number() == 1 && line[0] != '$')) continue;
      if (line[0] != '$' && line[0] != '!') {
        return lines_->Error("expected a sentence that begins with '$', got " +
                             Quoted(line));
      }
      ++sentences_;
      const std::size_t star = line.find('*');
      const std::string_view body =
          line.substr(1, star == line.npos ? line.npos : star - 1);
      if (star != line.npos && !IsSumOf(body, line.substr(star + 1))) {
        ++wrong_checksums_;
        continue;
      }
      auto finished = ReadSentence(body);
      if (!finished.ok() || finished->has_value()) return finished;
    }
  }

  LeftOut left_out() const override { return {0, wrong_checksums_}; }

 private:
  // An epoch that this sentence completes.
  absl::StatusOr<std::optional<Sample>> ReadSentence(std::string_view body) {
    const auto fields = SplitAt(',', body);
    const std::string_view kind =
        fields[0].size() == 5 ? fields[0].substr(2) : std::string_view();
    if (kind != "GGA" && kind != "RMC") return std::optional<Sample>();
    const std::size_t least = kind == "GGA" ? 12 : 10;
    if (fields.size() < least) {
      return lines_->Error(absl::StrCat("expected at least ", least,
                                        " fields of ", std::string(kind),
                                        ", got ", fields.size()));
    }
    // No fix: quality 0, or status V.
    if (kind == "GGA" ? fields[6] == "0" || fields[6].empty()
                      : fields[2] != "A") {
      return std::optional<Sample>();
    }
    const auto time_of_day = TimeOfDayOf(fields[1]);
    if (!time_of_day.ok()) return time_of_day.status();
    std::optional<Sample> finished;
    if (epoch_.has_value() && epoch_->time_of_day != *time_of_day) {
      finished = Emit();
    }
    if (emitted_ == *time_of_day) return finished;
    if (!epoch_.has_value()) {
      epoch_.emplace();
      epoch_->time_of_day = *time_of_day;
    }
    const absl::Status read = kind == "GGA" ? ReadGga(fields) : ReadRmc(fields);
    if (!read.ok()) return read;
    // An epoch is handed on as soon as nothing more of it can come, which a
    // receiver that sends one kind only shows with its next epoch.
    if (!finished.has_value() && epoch_->has_gga && epoch_->has_rmc) {
      return Emit();
    }
    return finished;
  }

  static bool IsSumOf(std::string_view body, std::string_view given) {
    unsigned sum = 0;
    for (const char c : body) sum ^= static_cast<unsigned char>(c);
    unsigned stated = 0;
    const auto [end, error] =
        std::from_chars(given.data(), given.data() + given.size(), stated, 16);
    return error == std::errc() && end == given.data() + given.size() &&
           given.size() == 2 && stated == sum;
  }

  // Single sentences are lost on serial lines; most are not.
  absl::Status CheckShare() const {
    if (2 * wrong_checksums_ <= sentences_ || sentences_ < 2) {
      return absl::OkStatus();
    }
    return lines_->Error(absl::StrCat(wrong_checksums_, " of ", sentences_,
                                      " sentences have a wrong checksum"));
  }

  // "hhmmss.ss"
  absl::StatusOr<std::int64_t> TimeOfDayOf(std::string_view field) const {
    const auto part = [&](std::size_t from) {
      return ReadNumber(field.substr(from, 2), "the time of day", *lines_);
    };
    if (field.size() >= 6) {
      const auto hours = part(0);
      const auto minutes = part(2);
      const auto seconds = NanosecondsOf(field.substr(4));
      if (hours.ok() && minutes.ok() && seconds.ok() && *hours >= 0.0 &&
          *hours < 24.0 && *minutes >= 0.0 && *minutes < 60.0 &&
          *seconds >= 0 && *seconds <= 61 * kNanosecondsPerSecond) {
        return (static_cast<std::int64_t>(*hours) * 60 +
                static_cast<std::int64_t>(*minutes)) *
                   60 * kNanosecondsPerSecond +
               *seconds;
      }
    }
    return lines_->Error("expected a time of day as hhmmss.ss, got " +
                         Quoted(field));
  }

  // "dddmm.mmm" and one of the two letters.
  absl::StatusOr<double> DegreesOf(std::string_view field,
                                   std::string_view letter,
                                   const char* letters) const {
    const auto value = ReadNumber(field, "degrees and minutes", *lines_);
    if (!value.ok()) return value.status();
    const double degrees = std::floor(*value / 100.0);
    const double minutes = *value - 100.0 * degrees;
    if (*value < 0.0 || minutes >= 60.0 || letter.size() != 1 ||
        (letter[0] != letters[0] && letter[0] != letters[1])) {
      return lines_->Error(absl::StrCat(
          "expected degrees and minutes as dddmm.mmm and one of ", letters,
          ", got ", Quoted(field), " and ", Quoted(letter)));
    }
    const double sign = letter[0] == letters[0] ? 1.0 : -1.0;
    return sign * (degrees + minutes / 60.0);
  }

  absl::Status ReadPosition(const std::vector<std::string_view>& fields,
                            std::size_t first) {
    const auto latitude = DegreesOf(fields[first], fields[first + 1], "NS");
    if (!latitude.ok()) return latitude.status();
    const auto longitude =
        DegreesOf(fields[first + 2], fields[first + 3], "EW");
    if (!longitude.ok()) return longitude.status();
    Sample& sample = epoch_->sample;
    const double height =
        sample.geodetic.has_value() ? sample.geodetic->height_meters : 0.0;
    sample.geodetic = {*latitude, *longitude, height};
    sample.has_heading = false;
    sample.line = lines_->number();
    return CheckPose(sample, *lines_);
  }

  absl::Status ReadGga(const std::vector<std::string_view>& fields) {
    if (absl::Status status = ReadPosition(fields, 2); !status.ok()) {
      return status;
    }
    epoch_->has_gga = true;
    double height = 0.0;
    for (const std::size_t i : {9, 11}) {
      if (fields[i].empty()) continue;
      const auto value = ReadNumber(fields[i], "height", *lines_);
      if (!value.ok()) return value.status();
      height += *value;
    }
    epoch_->sample.geodetic->height_meters = height;
    return absl::OkStatus();
  }

  absl::Status ReadRmc(const std::vector<std::string_view>& fields) {
    if (absl::Status status = ReadPosition(fields, 3); !status.ok()) {
      return status;
    }
    epoch_->has_rmc = true;
    if (!fields[7].empty() && !fields[8].empty()) {
      const auto knots = ReadNumber(fields[7], "speed", *lines_);
      if (!knots.ok()) return knots.status();
      const auto course = ReadNumber(fields[8], "course", *lines_);
      if (!course.ok()) return course.status();
      const double speed = *knots * kMetersPerSecondPerKnot;
      const double angle = *course * kRadiansPerDegree;
      epoch_->sample.velocity = {speed * std::sin(angle),
                                 speed * std::cos(angle), std::nullopt};
    }
    return ReadDate(fields[9]);
  }

  // "ddmmyy"; 80 and later are of the last century.
  absl::Status ReadDate(std::string_view field) {
    int part[3] = {};
    bool digits = field.size() == 6;
    for (std::size_t i = 0; i < 6 && digits; ++i) {
      digits = field[i] >= '0' && field[i] <= '9';
      if (digits) part[i / 2] = 10 * part[i / 2] + (field[i] - '0');
    }
    if (digits) {
      const int year = part[2] + (part[2] >= 80 ? 1900 : 2000);
      if (const auto day = TimeOfDate(year, part[1], part[0], "00:00");
          day.ok()) {
        day_ = *day;
        return absl::OkStatus();
      }
    }
    return lines_->Error("expected a date as ddmmyy, got " + Quoted(field));
  }

  // Hands the epoch on; nothing if there is none.
  std::optional<Sample> Emit() {
    if (!epoch_.has_value()) return std::nullopt;
    Epoch epoch = *std::exchange(epoch_, std::nullopt);
    // Midnight between two sentences that have no date.
    if (!epoch.has_rmc && emitted_.has_value() &&
        epoch.time_of_day < *emitted_ - kNanosecondsPerDay / 2) {
      day_ += kNanosecondsPerDay;
    }
    emitted_ = epoch.time_of_day;
    epoch.sample.time_nanoseconds = day_ + epoch.time_of_day;
    return epoch.sample;
  }

  const std::unique_ptr<Lines> lines_;
  std::optional<Epoch> epoch_;
  // The time of day of the epoch that was handed on last.
  std::optional<std::int64_t> emitted_;
  std::int64_t day_ = 0;
  std::int64_t sentences_ = 0;
  std::int64_t wrong_checksums_ = 0;
};

}  // namespace

absl::StatusOr<std::unique_ptr<SampleReader>> ReadNmea(
    std::unique_ptr<Lines> lines, const ReaderOptions& /*options*/) {
  return std::make_unique<NmeaReader>(std::move(lines));
}

}  // namespace revisit::client
