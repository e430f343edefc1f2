#include "client/formats/geodetic.h"

#include <cmath>

#include "client/formats/angles.h"

namespace revisit::client {
namespace {

// WGS84.
constexpr double kSemiMajorMeters = 6378137.0;
constexpr double kFlattening = 1.0 / 298.257223563;

// Earth-centred, earth-fixed.
std::array<double, 3> EarthFixed(const GeodeticPosition& position) {
  constexpr double kSquaredEccentricity = kFlattening * (2.0 - kFlattening);
  const double latitude = position.latitude_degrees * kRadiansPerDegree;
  const double longitude = position.longitude_degrees * kRadiansPerDegree;
  const double sine = std::sin(latitude);
  const double normal =
      kSemiMajorMeters / std::sqrt(1.0 - kSquaredEccentricity * sine * sine);
  const double from_axis =
      (normal + position.height_meters) * std::cos(latitude);
  return {
      from_axis * std::cos(longitude), from_axis * std::sin(longitude),
      (normal * (1.0 - kSquaredEccentricity) + position.height_meters) * sine};
}

}  // namespace

std::array<double, 3> EastNorthUp(const GeodeticPosition& origin,
                                  const GeodeticPosition& position) {
  const auto from = EarthFixed(origin);
  const auto to = EarthFixed(position);
  const double dx = to[0] - from[0];
  const double dy = to[1] - from[1];
  const double dz = to[2] - from[2];
  const double latitude = origin.latitude_degrees * kRadiansPerDegree;
  const double longitude = origin.longitude_degrees * kRadiansPerDegree;
  const double sin_lat = std::sin(latitude);
  const double cos_lat = std::cos(latitude);
  const double sin_lon = std::sin(longitude);
  const double cos_lon = std::cos(longitude);
  const double outward = cos_lon * dx + sin_lon * dy;
  return {-sin_lon * dx + cos_lon * dy, -sin_lat * outward + cos_lat * dz,
          cos_lat * outward + sin_lat * dz};
}

}  // namespace revisit::client
