// Times of files as nanoseconds since the Unix epoch, exact to the last digit
// that they are written with.
#ifndef REVISIT_CLIENT_FORMATS_TIMES_H_
#define REVISIT_CLIENT_FORMATS_TIMES_H_

#include <cstdint>
#include <optional>
#include <string_view>

#include "absl/status/statusor.h"
#include "client/formats/text_lines.h"

namespace revisit::client {

enum class TimeUnit {
  // Seconds up to 9.2e9, milliseconds from 1e11, microseconds from 1e14 and
  // nanoseconds from 1e17: all since 1970, none of these can be another.
  kByMagnitude,
  kSeconds,
  kMilliseconds,
  kMicroseconds,
  kNanoseconds,
};

inline constexpr std::int64_t kNanosecondsPerSecond = 1'000'000'000;

// Reads a number of this unit, or a date and time by ISO 8601 such as
// 2021-08-05T13:34:46.518Z; without a zone it is UTC. Times must lie in the
// years 1678 to 2261.
absl::StatusOr<std::int64_t> ReadTime(std::string_view field, TimeUnit unit,
                                      const Lines& lines);

// A date of the Gregorian calendar and a time of day as hh:mm:ss.sss.
// INVALID_ARGUMENT without a place if there is no such date or time.
absl::StatusOr<std::int64_t> TimeOfDate(int year, int month, int day,
                                        std::string_view time_of_day);

// The time of a week of GPS, counted as if it were UTC; nothing if there is no
// such week or it has no such time.
std::optional<std::int64_t> TimeOfGpsWeek(double week,
                                          std::int64_t nanoseconds_of_week);

// Seconds as decimal digits, exact to a nanosecond; INVALID_ARGUMENT without a
// place if it is no number within 9.2e9.
absl::StatusOr<std::int64_t> NanosecondsOf(std::string_view seconds);

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_FORMATS_TIMES_H_
