// The settings of a group, of messages as of the server's own type.
#ifndef REVISIT_SERVER_FIELDS_GROUP_SETTINGS_H_
#define REVISIT_SERVER_FIELDS_GROUP_SETTINGS_H_

#include <optional>

#include "server/fields/field_violations.h"
#include "server/sessions/vehicle_config.h"

namespace revisit::server {

inline constexpr double kMaxFixBiasMeters = 1000.0;

struct GroupSettings {
  // The origin of the frame that all members share, if that lies on the Earth.
  std::optional<GeodeticOrigin> geodetic_origin;
  // Standard deviation of what all fixes of one vehicle have in common, in
  // range [0, kMaxFixBiasMeters].
  double fix_bias_meters = 0.0;
};

inline bool operator==(const GroupSettings& a, const GroupSettings& b) {
  return a.geodetic_origin == b.geodetic_origin &&
         a.fix_bias_meters == b.fix_bias_meters;
}
inline bool operator!=(const GroupSettings& a, const GroupSettings& b) {
  return !(a == b);
}

// Adds a violation for each setting that is out of range.
void CheckGroupSettings(const GroupSettings& settings, const FieldPath& path,
                        Violations* violations);

// Settings: a message with the fields of a group's settings by their names.
// Those that are absent take their defaults; nothing is checked.
template <typename Settings>
GroupSettings GroupSettingsOf(const Settings& message) {
  GroupSettings settings;
  if (message.has_geodetic_origin()) {
    const auto& origin = message.geodetic_origin();
    settings.geodetic_origin =
        GeodeticOrigin{origin.latitude_degrees(), origin.longitude_degrees(),
                       origin.height_meters()};
  }
  if (message.has_fix_bias_meters()) {
    settings.fix_bias_meters = message.fix_bias_meters();
  }
  return settings;
}

template <typename Settings>
void SetGroupSettings(const GroupSettings& settings, Settings* message) {
  message->Clear();
  if (settings.geodetic_origin) {
    auto* const origin = message->mutable_geodetic_origin();
    origin->set_latitude_degrees(settings.geodetic_origin->latitude_degrees);
    origin->set_longitude_degrees(settings.geodetic_origin->longitude_degrees);
    origin->set_height_meters(settings.geodetic_origin->height_meters);
  }
  message->set_fix_bias_meters(settings.fix_bias_meters);
}

}  // namespace revisit::server

#endif  // REVISIT_SERVER_FIELDS_GROUP_SETTINGS_H_
