#include "client/answers/exact_text.h"

#include <algorithm>
#include <charconv>
#include <cstdint>
#include <limits>
#include <system_error>

#include "absl/strings/str_cat.h"
#include "client/terminal/terminal.h"
#include "google/protobuf/util/time_util.h"

namespace revisit::client {

using google::protobuf::Timestamp;
using google::protobuf::util::TimeUtil;

std::string Exact(double value) {
  char buffer[64];
  const auto [end, error] =
      std::to_chars(buffer, buffer + sizeof(buffer), value);
  return error == std::errc() ? std::string(buffer, end) : "nan";
}

std::string StampSeconds(const Timestamp& stamp) {
  std::int64_t seconds = stamp.seconds();
  std::int64_t nanos = std::clamp(stamp.nanos(), 0, 999'999'999);
  std::string sign;
  if (seconds < 0 && nanos > 0) {
    seconds += 1;
    nanos = 1'000'000'000 - nanos;
    if (seconds == 0) sign = "-";
  }
  if (nanos == 0) return absl::StrCat(seconds);
  std::string digits = absl::StrCat(nanos);
  digits.insert(0, 9 - digits.size(), '0');
  digits.erase(digits.find_last_not_of('0') + 1);
  return absl::StrCat(sign, seconds, ".", digits);
}

std::string StampText(const Timestamp& stamp) {
  constexpr std::int32_t kNanosPerMilli = 1'000'000;
  Timestamp rounded = stamp;
  rounded.set_nanos(
      (std::clamp(stamp.nanos(), 0, 999'999'999) + kNanosPerMilli / 2) /
      kNanosPerMilli * kNanosPerMilli);
  if (rounded.nanos() == 1'000'000'000) {
    rounded.set_nanos(0);
    constexpr std::int64_t kMost = std::numeric_limits<std::int64_t>::max();
    rounded.set_seconds(std::min(stamp.seconds(), kMost - 1) + 1);
  }
  return TimeUtil::ToString(rounded);
}

std::string GeodeticText(const v1::GeodeticPosition& position) {
  return absl::StrCat(Fixed(position.latitude_degrees(), 8), " deg, ",
                      Fixed(position.longitude_degrees(), 8), " deg, ",
                      Fixed(position.height_meters(), 3), " m");
}

}  // namespace revisit::client
