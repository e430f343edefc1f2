// Numbers, times and positions as text.
#ifndef REVISIT_CLIENT_ANSWERS_EXACT_TEXT_H_
#define REVISIT_CLIENT_ANSWERS_EXACT_TEXT_H_

#include <string>

#include "google/protobuf/timestamp.pb.h"
#include "revisit/v1/geometry.pb.h"

namespace revisit::client {

// The shortest text that reads as the same number.
std::string Exact(double value);

// Seconds since 1970, to the nanosecond, as files of poses have them: a double
// does not hold today's stamps so finely. Without trailing zeros.
std::string StampSeconds(const google::protobuf::Timestamp& stamp);

// RFC 3339 in UTC, rounded to the millisecond: 2020-11-26T18:58:17.528Z.
std::string StampText(const google::protobuf::Timestamp& stamp);

// "43.79000000 deg, -79.46000000 deg, 200.000 m": latitude, longitude, height.
std::string GeodeticText(const v1::GeodeticPosition& position);

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_ANSWERS_EXACT_TEXT_H_
