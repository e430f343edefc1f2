// Timestamps of messages as nanoseconds since the Unix epoch.
#ifndef REVISIT_SERVER_FIELDS_TIMESTAMPS_H_
#define REVISIT_SERVER_FIELDS_TIMESTAMPS_H_

#include <cstdint>

#include "google/protobuf/timestamp.pb.h"
#include "server/fields/field_violations.h"

namespace revisit::server {

inline constexpr std::int64_t kNanosPerSecond = 1000000000;

void EncodeTime(std::int64_t nanoseconds,
                google::protobuf::Timestamp* timestamp);

// Whether the timestamp lies in the years that 64-bit nanoseconds reach, 1678
// to 2261, with nanos in range; adds a violation otherwise.
bool CheckTimestamp(const google::protobuf::Timestamp& timestamp,
                    const FieldPath& path, Violations* violations);

// Whether CheckTimestamp() says true of the timestamp of these nanoseconds.
bool IsTimestamp(std::int64_t nanoseconds);

// REQUIRES: CheckTimestamp() says true.
std::int64_t ToNanoseconds(const google::protobuf::Timestamp& timestamp);

}  // namespace revisit::server

#endif  // REVISIT_SERVER_FIELDS_TIMESTAMPS_H_
