// The truth of a drive, recorded beside it. Errors are those of reader.h.
#ifndef REVISIT_CLIENT_FORMATS_TRUTH_FILE_H_
#define REVISIT_CLIENT_FORMATS_TRUTH_FILE_H_

#include <cstdint>
#include <memory>
#include <optional>
#include <string>
#include <vector>

#include "absl/status/statusor.h"
#include "client/formats/byte_source.h"
#include "client/formats/drive_file.h"
#include "client/formats/geodetic.h"

namespace revisit::client {

struct TruthPose {
  // Absent in files without times.
  std::optional<std::int64_t> time_nanoseconds;
  PlanarPose pose;
};

// Reads any format of reader.h, or the reference of a receiver: comma-separated
// with a header line that names, among others, the columns "GPS TOW (s)",
// "GPS Week", "Latitude (deg)", "Longitude (deg)", "Ellipsoid Height (m)" and
// "Heading (deg)", the last clockwise from north. GPS time is counted as if it
// were UTC, as ReadRtklib() does. Geodetic positions become metres to the east
// and north of `origin`, or of their first one.
absl::StatusOr<std::vector<TruthPose>> ReadTruth(
    const std::string& path, const std::optional<GeodeticPosition>& origin);

// Reads `source` likewise, if it is such a reference; `path` is for messages.
absl::StatusOr<std::vector<TruthPose>> ReadReference(
    std::unique_ptr<ByteSource> source, const std::string& path,
    const std::optional<GeodeticPosition>& origin);

// Sets the truth of a drive: interpolated at its times, or pose by pose where
// neither has times. INVALID_ARGUMENT if times of the truth do not grow, times
// of the drive do not grow or lie outside the truth's, or if only one of the
// two has times.
absl::Status AddTruth(const std::vector<TruthPose>& truth, Drive* drive);

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_FORMATS_TRUTH_FILE_H_
