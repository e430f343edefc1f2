// Drives that were recorded by a GNSS receiver, with a reference that serves as
// the truth.
//
// Errors are those of drive_file.h. Times are GPS time, counted as if it were
// UTC: seconds since 1970-01-01 00:00 of the GPS calendar.
#ifndef REVISIT_CLIENT_FORMATS_GNSS_FILE_H_
#define REVISIT_CLIENT_FORMATS_GNSS_FILE_H_

#include <array>
#include <istream>
#include <string>
#include <vector>

#include "absl/status/statusor.h"
#include "client/formats/drive_file.h"
#include "client/formats/geodetic.h"

namespace revisit::client {

// One epoch of a receiver. Covariances are east, north: ee, en, nn.
struct GnssFix {
  double time_seconds = 0.0;
  GeodeticPosition position;
  std::array<double, 3> position_covariance{};
  double east_velocity = 0.0;
  double north_velocity = 0.0;
  std::array<double, 3> velocity_covariance{};
};

struct ReferencePose {
  double time_seconds = 0.0;
  GeodeticPosition position;
  // Radians counter-clockwise from east.
  double heading = 0.0;
};

// A solution file of RTKLIB (.pos) with velocities: comment lines begin with
// '%', the last of them names the columns: "% GPST", latitude(deg),
// longitude(deg), height(m), sdn(m), sde(m), sdne(m), vn(m/s), ve(m/s), sdvn,
// sdve, sdvne, among others. Mixed columns such as sdne are signed square roots
// of covariances.
absl::StatusOr<std::vector<GnssFix>> ReadRtklib(std::istream& input,
                                                const std::string& path);

// Comma-separated with a header line that names, among others, the columns
// "GPS TOW (s)", "GPS Week", "Latitude (deg)", "Longitude (deg)",
// "Ellipsoid Height (m)" and "Heading (deg)", the last clockwise from north.
absl::StatusOr<std::vector<ReferencePose>> ReadReference(
    std::istream& input, const std::string& path);

// Slower epochs are left out of drives.
inline constexpr double kGnssStandstillMetersPerSecond = 0.5;

// The drive of a vehicle that faces where it moves. Heading is the direction of
// the velocity, its variance that of the velocity across, over the speed
// squared; it is independent of the position. An epoch slower than the
// standstill speed shows neither heading nor progress, and the wandering of its
// position would count as travelled distance: it is left out. The truth is the
// reference, interpolated at the epochs. Local coordinates are east and north
// of `origin`.
//
// INVALID_ARGUMENT if an epoch lies outside the reference's times, if times do
// not grow, or if the vehicle never moves.
absl::StatusOr<Drive> MakeGnssDrive(const std::string& name,
                                    const std::vector<GnssFix>& fixes,
                                    const std::vector<ReferencePose>& reference,
                                    const GeodeticPosition& origin);

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_FORMATS_GNSS_FILE_H_
