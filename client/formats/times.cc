#include "client/formats/times.h"

#include <charconv>
#include <cmath>
#include <string>
#include <system_error>

#include "absl/strings/str_cat.h"
#include "absl/time/civil_time.h"

namespace revisit::client {
namespace {

constexpr double kMaxSeconds = 9.2e9;

// Extended precision: a double is exact to 256 ns in our time.
bool ReadExtended(std::string_view text, long double* value) {
  if (!text.empty() && text[0] == '+') text.remove_prefix(1);
  const auto [end, error] =
      std::from_chars(text.data(), text.data() + text.size(), *value);
  return error == std::errc() && end == text.data() + text.size() &&
         std::isfinite(*value);
}

bool ReadDigits(std::string_view text, int* value) {
  if (text.empty() || text.size() > 4) return false;
  *value = 0;
  for (const char c : text) {
    if (c < '0' || c > '9') return false;
    *value = 10 * *value + (c - '0');
  }
  return true;
}

bool LooksLikeDate(std::string_view field) {
  return field.size() >= 16 && field[4] == '-' && field[7] == '-' &&
         (field[10] == 'T' || field[10] == ' ');
}

// "Z", "+09:00", "+0900" or "+09"; minutes east of Greenwich.
bool ReadZone(std::string_view zone, int* minutes) {
  *minutes = 0;
  if (zone.empty() || zone == "Z" || zone == "z") return true;
  const bool west = zone[0] == '-';
  zone.remove_prefix(1);
  if (zone.size() != 2 && zone.size() != 4 && zone.size() != 5) return false;
  int hours = 0;
  int rest = 0;
  if (!ReadDigits(zone.substr(0, 2), &hours)) return false;
  if (zone.size() == 5 && zone[2] != ':') return false;
  if (zone.size() > 2 && !ReadDigits(zone.substr(zone.size() - 2), &rest)) {
    return false;
  }
  *minutes = (hours * 60 + rest) * (west ? -1 : 1);
  return hours < 24 && rest < 60;
}

absl::StatusOr<std::int64_t> ReadDate(std::string_view field) {
  const absl::Status bad = absl::InvalidArgumentError("");
  int year = 0;
  int month = 0;
  int day = 0;
  if (!ReadDigits(field.substr(0, 4), &year) ||
      !ReadDigits(field.substr(5, 2), &month) ||
      !ReadDigits(field.substr(8, 2), &day)) {
    return bad;
  }
  std::string_view time = field.substr(11);
  std::string_view zone;
  if (const auto at = time.find_first_of("Zz+-"); at != time.npos) {
    zone = time.substr(at);
    time = time.substr(0, at);
  }
  int minutes = 0;
  if (!ReadZone(zone, &minutes)) return bad;
  const auto local = TimeOfDate(year, month, day, time);
  if (!local.ok()) return local;
  return *local - minutes * 60 * kNanosecondsPerSecond;
}

double NanosecondsPerUnit(TimeUnit unit, double magnitude) {
  switch (unit) {
    case TimeUnit::kSeconds:
      return 1e9;
    case TimeUnit::kMilliseconds:
      return 1e6;
    case TimeUnit::kMicroseconds:
      return 1e3;
    case TimeUnit::kNanoseconds:
      return 1.0;
    case TimeUnit::kByMagnitude:
      break;
  }
  if (magnitude < 1e11) return 1e9;
  if (magnitude < 1e14) return 1e6;
  return magnitude < 1e17 ? 1e3 : 1.0;
}

}  // namespace

absl::StatusOr<std::int64_t> TimeOfDate(int year, int month, int day,
                                        std::string_view time_of_day) {
  const absl::Status bad = absl::InvalidArgumentError("no date and time");
  const absl::CivilDay date(year, month, day);
  int hours = 0;
  int minutes = 0;
  long double seconds = 0.0;
  if (year < 1678 || year > 2261 || date.month() != month ||
      date.day() != day || time_of_day.size() < 5 || time_of_day[2] != ':' ||
      !ReadDigits(time_of_day.substr(0, 2), &hours) ||
      !ReadDigits(time_of_day.substr(3, 2), &minutes) || hours > 24 ||
      minutes > 59) {
    return bad;
  }
  if (time_of_day.size() > 5 &&
      (time_of_day[5] != ':' ||
       !ReadExtended(time_of_day.substr(6), &seconds))) {
    return bad;
  }
  if (seconds < 0.0L || seconds >= 61.0L) return bad;
  const std::int64_t days = date - absl::CivilDay(1970, 1, 1);
  return ((days * 24 + hours) * 60 + minutes) * 60 * kNanosecondsPerSecond +
         std::llround(seconds * 1e9L);
}

absl::StatusOr<std::int64_t> NanosecondsOf(std::string_view seconds) {
  long double value = 0.0;
  if (!ReadExtended(seconds, &value) ||
      std::abs(value) > static_cast<long double>(kMaxSeconds)) {
    return absl::InvalidArgumentError("no time in seconds");
  }
  return std::llround(value * 1e9L);
}

absl::StatusOr<std::int64_t> ReadTime(std::string_view field, TimeUnit unit,
                                      const Lines& lines) {
  if (LooksLikeDate(field)) {
    const auto date = ReadDate(field);
    if (date.ok()) return date;
    return lines.Error(
        "expected a date and time such as 2021-08-05T13:34:46.518Z, got " +
        Quoted(field));
  }
  long double value = 0.0;
  if (!ReadExtended(field, &value)) {
    return lines.Error(
        "expected a number or an ISO 8601 date for the time, got " +
        Quoted(field));
  }
  const double scale =
      NanosecondsPerUnit(unit, std::abs(static_cast<double>(value)));
  const long double nanoseconds = value * static_cast<long double>(scale);
  if (std::abs(nanoseconds) > static_cast<long double>(kMaxSeconds) * 1e9L) {
    return lines.Error(absl::StrCat(
        "expected a time within 9.2e9 seconds of the Unix epoch, got ",
        Quoted(field).c_str(),
        unit == TimeUnit::kByMagnitude
            ? "; --time-unit names the unit of other numbers"
            : ""));
  }
  return std::llround(nanoseconds);
}

std::optional<std::int64_t> TimeOfGpsWeek(double week,
                                          std::int64_t nanoseconds_of_week) {
  // 1980-01-06, where GPS weeks begin.
  constexpr std::int64_t kGpsEpochSeconds = 315'964'800;
  constexpr std::int64_t kSecondsPerWeek = 604'800;
  constexpr double kMostWeeks = 10'000.0;
  if (!(week >= 0.0 && week <= kMostWeeks) || nanoseconds_of_week < 0 ||
      nanoseconds_of_week > kSecondsPerWeek * kNanosecondsPerSecond) {
    return std::nullopt;
  }
  return (kGpsEpochSeconds +
          kSecondsPerWeek * static_cast<std::int64_t>(week)) *
             kNanosecondsPerSecond +
         nanoseconds_of_week;
}

}  // namespace revisit::client
