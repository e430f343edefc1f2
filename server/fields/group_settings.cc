#include "server/fields/group_settings.h"

#include "server/fields/geodetic_frame.h"

namespace revisit::server {

void CheckGroupSettings(const GroupSettings& settings, const FieldPath& path,
                        Violations* violations) {
  if (settings.geodetic_origin) {
    CheckGeodetic(*settings.geodetic_origin, path.Field("geodetic_origin"),
                  violations);
  }
  CheckRange(settings.fix_bias_meters, 0.0, kMaxFixBiasMeters,
             path.Field("fix_bias_meters"), violations);
}

}  // namespace revisit::server
