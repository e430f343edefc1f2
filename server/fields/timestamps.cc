#include "server/fields/timestamps.h"

#include "absl/strings/str_cat.h"

namespace revisit::server {
namespace {

constexpr std::int64_t kFirstSecond = -9214560000;  // 1678-01-01
constexpr std::int64_t kEndSecond = 9214646400;     // 2262-01-01

}  // namespace

void EncodeTime(std::int64_t nanoseconds,
                google::protobuf::Timestamp* timestamp) {
  std::int64_t seconds = nanoseconds / kNanosPerSecond;
  std::int64_t nanos = nanoseconds % kNanosPerSecond;
  if (nanos < 0) {
    nanos += kNanosPerSecond;
    --seconds;
  }
  timestamp->set_seconds(seconds);
  timestamp->set_nanos(static_cast<std::int32_t>(nanos));
}

bool CheckTimestamp(const google::protobuf::Timestamp& timestamp,
                    const FieldPath& path, Violations* violations) {
  bool valid = true;
  if (timestamp.seconds() < kFirstSecond || timestamp.seconds() >= kEndSecond) {
    violations->Add(kInvalidField, path.Field("seconds"),
                    absl::StrCat("got ", timestamp.seconds(),
                                 "; allowed are the years 1678 to 2261"));
    valid = false;
  }
  if (timestamp.nanos() < 0 || timestamp.nanos() >= kNanosPerSecond) {
    violations->Add(
        kInvalidField, path.Field("nanos"),
        absl::StrCat("got ", timestamp.nanos(), "; allowed is [0, 999999999]"));
    valid = false;
  }
  return valid;
}

bool IsTimestamp(std::int64_t nanoseconds) {
  return nanoseconds >= kFirstSecond * kNanosPerSecond &&
         nanoseconds < kEndSecond * kNanosPerSecond;
}

std::int64_t ToNanoseconds(const google::protobuf::Timestamp& timestamp) {
  return timestamp.seconds() * kNanosPerSecond + timestamp.nanos();
}

}  // namespace revisit::server
