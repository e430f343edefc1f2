// Receivers: RTKLIB, NMEA and GPX. Samples are geodetic, without a heading of
// their own: see course.h.
#ifndef REVISIT_CLIENT_FORMATS_GNSS_READERS_H_
#define REVISIT_CLIENT_FORMATS_GNSS_READERS_H_

#include <memory>

#include "absl/status/statusor.h"
#include "client/formats/reader.h"
#include "client/formats/text_lines.h"

namespace revisit::client {

// A solution file of RTKLIB (.pos): comment lines begin with '%', the last of
// them names the columns, such as "% GPST latitude(deg) longitude(deg)
// height(m) Q ns sdn(m) sde(m) sdu(m) sdne(m) ... vn(m/s) ve(m/s) ... sdvn sdve
// ... sdvne". Standard deviations and velocities may be missing, and
// deviations of 0 state nothing. Mixed columns such as sdne are signed square
// roots of covariances. Times are a date and a
// time of day, or GPS week and seconds of the week; GPS time is counted as if
// it were UTC: since 1970-01-01 00:00 of the GPS calendar.
absl::StatusOr<std::unique_ptr<SampleReader>> ReadRtklib(
    std::unique_ptr<Lines> lines, const ReaderOptions& options);

// GGA and RMC sentences of NMEA 0183, of any talker. Both of one epoch are one
// sample. Sentences without a fix and other sentences are passed over. So are
// those with a wrong checksum, which are counted; it is an error if they are
// more than the others. Before the first RMC, which has the date, times count
// from midnight. Heights are above the ellipsoid where GGA has the separation
// of the geoid.
absl::StatusOr<std::unique_ptr<SampleReader>> ReadNmea(
    std::unique_ptr<Lines> lines, const ReaderOptions& options);

// Track points (trkpt) of GPX 1.0 and 1.1, all segments one after the other.
absl::StatusOr<std::unique_ptr<SampleReader>> ReadGpx(
    std::unique_ptr<Lines> lines, const ReaderOptions& options);

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_FORMATS_GNSS_READERS_H_
