// A map for programs that know the earth.
#ifndef REVISIT_CLIENT_MAP_MAP_GEOJSON_H_
#define REVISIT_CLIENT_MAP_MAP_GEOJSON_H_

#include <ostream>

#include "absl/status/status.h"
#include "client/map/server_map.h"

namespace revisit::client {

// FAILED_PRECONDITION for a vehicle that does not stream geodetic positions.
absl::Status CheckGeodetic(const v1::Vehicle& vehicle);

// Writes a FeatureCollection of RFC 7946, in longitude and latitude. The `kind`
// of a feature is among its properties: trajectory, uncertainty (the 95 %
// ellipse at a check), check, candidate, loop_closure, rejected_candidate.
// REQUIRES: CheckGeodetic() of the vehicle.
void WriteGeoJson(const ServerMap& map, std::ostream& out);

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_MAP_MAP_GEOJSON_H_
