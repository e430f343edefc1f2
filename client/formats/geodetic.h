// Positions on the WGS84 ellipsoid, and the plane that touches it.
#ifndef REVISIT_CLIENT_FORMATS_GEODETIC_H_
#define REVISIT_CLIENT_FORMATS_GEODETIC_H_

#include <array>

namespace revisit::client {

struct GeodeticPosition {
  double latitude_degrees = 0.0;
  double longitude_degrees = 0.0;
  // Above the ellipsoid.
  double height_meters = 0.0;
};

// East, north and up of `position` as seen from `origin`, in metres along the
// axes at `origin`.
std::array<double, 3> EastNorthUp(const GeodeticPosition& origin,
                                  const GeodeticPosition& position);

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_FORMATS_GEODETIC_H_
