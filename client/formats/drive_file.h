// Files of recorded drives.
//
// A malformed file is refused as a whole, with INVALID_ARGUMENT and a message
// that names file and line and says what was expected there; nothing is guessed
// or skipped. NOT_FOUND or PERMISSION_DENIED if it cannot be opened. Numbers
// are read in the C locale, whatever the process has set.
#ifndef REVISIT_CLIENT_FORMATS_DRIVE_FILE_H_
#define REVISIT_CLIENT_FORMATS_DRIVE_FILE_H_

#include <array>
#include <cstddef>
#include <istream>
#include <optional>
#include <string>
#include <vector>

#include "absl/status/statusor.h"
#include "client/formats/geodetic.h"

namespace revisit::client {

// Metres, and radians counter-clockwise from +x.
struct PlanarPose {
  double x = 0.0;
  double y = 0.0;
  double heading = 0.0;
};

struct DriveSample {
  double time_seconds = 0.0;
  PlanarPose estimate;
  // TUM only: height, and the orientation as the file has it (x, y, z, w);
  // `estimate.heading` is its heading.
  double estimate_z = 0.0;
  std::optional<std::array<double, 4>> quaternion;
  // GNSS only: the position that `estimate` was computed from.
  std::optional<GeodeticPosition> geodetic;
  // Covariance of the estimate: xx, xy, xh, yy, yh, hh.
  std::optional<std::array<double, 6>> covariance;
};

struct Drive {
  // Name of the file without directory and ending.
  std::string name;
  std::vector<DriveSample> samples;
  // One for each sample, or none at all.
  std::vector<PlanarPose> truth;
};

enum class DriveFormat {
  // Comma-separated. The first line names the columns, in any order: t_s
  // (seconds since the Unix epoch or since the start), est_x, est_y, est_yaw,
  // and, all together or not at all, gt_x, gt_y, gt_yaw (the truth) and pxx,
  // pxy, pxt, pyy, pyt, ptt (the covariance of the estimate, t meaning yaw).
  // `frame` is allowed and ignored; any other name is an error.
  kDrive,
  // The format of the TUM RGB-D benchmark: lines "t x y z qx qy qz qw",
  // separated by blanks, t in seconds; lines that begin with '#' are comments.
  kTum,
};

absl::StatusOr<Drive> ReadDriveFile(const std::string& path,
                                    DriveFormat format);

// Reads a stream likewise; `path` is for messages and the drive's name.
absl::StatusOr<Drive> ReadDrive(std::istream& input, const std::string& path,
                                DriveFormat format);

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_FORMATS_DRIVE_FILE_H_
