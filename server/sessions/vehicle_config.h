// A vehicle apart from its poses, in the server's own types.
#ifndef REVISIT_SERVER_SESSIONS_VEHICLE_CONFIG_H_
#define REVISIT_SERVER_SESSIONS_VEHICLE_CONFIG_H_

#include <cstdint>
#include <map>
#include <optional>
#include <string>

#include "core/settings.h"

namespace revisit::server {

enum class CoordinateFrame { kLocal, kGeodetic };

// Whether the checks that fall due on the way are kept.
enum class ChecksKept { kOnRequest, kStored };

struct GeodeticOrigin {
  double latitude_degrees = 0.0;
  double longitude_degrees = 0.0;
  double height_meters = 0.0;
};

inline bool operator==(const GeodeticOrigin& a, const GeodeticOrigin& b) {
  return a.latitude_degrees == b.latitude_degrees &&
         a.longitude_degrees == b.longitude_degrees &&
         a.height_meters == b.height_meters;
}
inline bool operator!=(const GeodeticOrigin& a, const GeodeticOrigin& b) {
  return !(a == b);
}

struct VehicleConfig {
  // See vehicle_uid.h. Never changes.
  std::string uid;
  core::DriveSettings drive;
  CoordinateFrame frame = CoordinateFrame::kLocal;
  // The origin of a geodetic vehicle: given on creation, or set by its first
  // pose.
  std::optional<GeodeticOrigin> origin;
  ChecksKept checks = ChecksKept::kOnRequest;
  // Probability from which on a candidate of a stored check is kept.
  double keep_probability = 0.05;
  // The id of the group whose members' histories stored checks search too;
  // empty for none.
  std::string check_group;
  std::int64_t create_time_ns = 0;  // Since the Unix epoch.
  // Writes are refused until an operator accepts the loss.
  bool data_loss = false;
  // Damage was found in the stored vehicle, and no operator has accepted its
  // loss since. A load that finds none does not end it.
  bool damaged = false;
  // For people, and for the callers' programs: nothing depends on these.
  std::string display_name;
  std::map<std::string, std::string> labels;
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_SESSIONS_VEHICLE_CONFIG_H_
