// Where the frames of vehicles with geodetic positions lie in a group's frame.
#ifndef REVISIT_SERVER_FLEET_FIX_DATUMS_H_
#define REVISIT_SERVER_FLEET_FIX_DATUMS_H_

#include <memory>
#include <optional>

#include "core/geometry/pose.h"
#include "core/geometry/recording_start.h"
#include "core/geometry/state_space.h"
#include "server/sessions/vehicle_config.h"

namespace revisit::server {

// The datum of a frame that is East-North-Up at `origin`, in the one that is so
// at `anchor`. `first_error`: that of the frame's first pose, where the errors
// of poses are reckoned from it; nothing where each pose errs by itself. Then
// frames whose fixes are not biased have no error but that of their poses;
// otherwise each errs by itself.
std::shared_ptr<const core::RecordingStart> DatumOfFixes(
    const GeodeticOrigin& anchor, const GeodeticOrigin& origin,
    double bias_meters, core::StateSpace space,
    const std::optional<core::Covariance>& first_error = std::nullopt);

}  // namespace revisit::server

#endif  // REVISIT_SERVER_FLEET_FIX_DATUMS_H_
