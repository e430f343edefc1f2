// The uid tells a vehicle from every other one, also from earlier and later
// ones of its name: a UUID in its text form (RFC 9562).
#ifndef REVISIT_SERVER_SESSIONS_VEHICLE_UID_H_
#define REVISIT_SERVER_SESSIONS_VEHICLE_UID_H_

#include <cstdint>
#include <string>

#include "server/storage/records.h"

namespace revisit::server {

// A random UUID of version 4: the uid of a new vehicle, and whatever else has
// to differ from all that there were.
std::string NewUuid();

// The uid of a vehicle that was stored before there were uids. It is made from
// the stored record, so that it is always the same and nothing has to be
// rewritten. Version 8.
std::string DerivedVehicleUid(VehicleKey key, const std::string& id,
                              std::int64_t create_time_ns);

// Whether this is the text form: 8-4-4-4-12 hexadecimal digits in lower case.
bool IsUuid(const std::string& text);

}  // namespace revisit::server

#endif  // REVISIT_SERVER_SESSIONS_VEHICLE_UID_H_
