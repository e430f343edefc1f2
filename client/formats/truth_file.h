// The truth of a drive, recorded beside it. Errors are those of reader.h.
#ifndef REVISIT_CLIENT_FORMATS_TRUTH_FILE_H_
#define REVISIT_CLIENT_FORMATS_TRUTH_FILE_H_

#include <cstddef>
#include <cstdint>
#include <memory>
#include <optional>
#include <string>
#include <vector>

#include "absl/status/statusor.h"
#include "client/formats/byte_source.h"
#include "client/formats/drive_file.h"
#include "client/formats/geodetic.h"
#include "client/formats/reader.h"

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
//
// Messages name the flags of `options` as those of the truth, --truth-axes.
absl::StatusOr<std::vector<TruthPose>> ReadTruth(
    const std::string& path, const ReaderOptions& options,
    const std::optional<GeodeticPosition>& origin);

// Reads `source` likewise, if it is such a reference; `path` is for messages.
absl::StatusOr<std::vector<TruthPose>> ReadReference(
    std::unique_ptr<ByteSource> source, const std::string& path,
    const std::optional<GeodeticPosition>& origin);

// Poses of a drive before its truth begins and after it ends, and how long
// these stretches are.
struct WithoutTruth {
  std::size_t poses_before = 0;
  std::size_t poses_after = 0;
  double seconds_before = 0.0;
  double seconds_after = 0.0;
};

// Sets the truth of a drive: interpolated at its times, or pose by pose where
// neither has times. Poses outside the truth's times are left out of the drive,
// and returned. INVALID_ARGUMENT if these are more than half of all, if times
// of the truth or the drive do not grow, or if only one of the two has times.
absl::StatusOr<WithoutTruth> AddTruth(const std::vector<TruthPose>& truth,
                                      Drive* drive);

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_FORMATS_TRUTH_FILE_H_
