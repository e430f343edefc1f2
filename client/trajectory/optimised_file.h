// Files in which an optimiser or a script has written new estimates of stored
// poses.
#ifndef REVISIT_CLIENT_TRAJECTORY_OPTIMISED_FILE_H_
#define REVISIT_CLIENT_TRAJECTORY_OPTIMISED_FILE_H_

#include <array>
#include <cstdint>
#include <optional>
#include <string>
#include <vector>

#include "absl/status/statusor.h"
#include "revisit/v1/geometry.pb.h"

namespace revisit::client {

struct OptimisedPose {
  // Its line in the file, from 1.
  std::int64_t line = 0;
  // By one of these it is found among the stored poses.
  std::optional<std::uint64_t> sequence;
  std::optional<std::int64_t> stamp_nanoseconds;
  double x = 0.0;
  double y = 0.0;
  // The stored one stays if it is absent.
  std::optional<double> z;
  // One of these; a heading leaves roll and pitch as they are stored.
  double heading = 0.0;
  // x, y, z, w.
  std::optional<std::array<double, 4>> quaternion;
  // The stored one stays if it is absent.
  std::optional<v1::Covariance> covariance;
};

enum class OptimisedFormat {
  // "t x y z qx qy qz qw": poses are found by their stamps.
  kTum,
  // VERTEX_SE2 and VERTEX_SE3:QUAT, whose ids are sequences. Edges and fixed
  // vertices are passed over.
  kG2o,
  // Columns by name, in any order: sequence, est_x, est_y, est_yaw; est_z; qx,
  // qy, qz, qw; pxx, pxy, pxt, pyy, pyt, ptt (t meaning yaw); pxz, pyz, pzz,
  // pzt. Others are passed over. Only the first four must be there; of the
  // others all of a group or none.
  kCsv,
};

// INVALID_ARGUMENT with file and line where it is malformed, NOT_FOUND or
// PERMISSION_DENIED if it cannot be opened. A file without poses is malformed.
absl::StatusOr<std::vector<OptimisedPose>> ReadOptimisedFile(
    const std::string& path, OptimisedFormat format);

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_TRAJECTORY_OPTIMISED_FILE_H_
