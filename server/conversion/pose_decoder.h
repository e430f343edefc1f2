// One pose of a message as a sample of core.
#ifndef REVISIT_SERVER_CONVERSION_POSE_DECODER_H_
#define REVISIT_SERVER_CONVERSION_POSE_DECODER_H_

#include <array>
#include <cstdint>
#include <optional>
#include <string>

#include "core/drive/drive.h"
#include "core/geometry/pose.h"
#include "revisit/v1/geometry.pb.h"
#include "server/conversion/field_violations.h"
#include "server/conversion/geodetic_frame.h"
#include "server/sessions/vehicle_config.h"

namespace revisit::server {

// Where poses come from decides which fields may be left out, and whether a
// geodetic vehicle takes local positions.
enum class PoseSource { kAppend, kRevision, kStored };

// Decodes poses of one vehicle, one after the other. The config and the
// violations must outlive it.
class PoseDecoder {
 public:
  PoseDecoder(const VehicleConfig& config, PoseSource source,
              Violations* violations);

  // Adds a violation for each defect of the pose; the sample is meaningless if
  // there is one.
  core::PoseSample Decode(const v1::Pose& pose, const FieldPath& path);

  // The origin of a geodetic vehicle: that of the config or, without, that of
  // the first pose that can be decoded.
  std::optional<GeodeticOrigin> origin() const;

 private:
  // The forward axis in the axes of the pose's own position, and its heading.
  // The axis is set for geodetic poses and quaternions only.
  struct Forward {
    double heading = 0.0;
    std::array<double, 3> axis{};
  };

  void DecodePosition(const v1::Pose& pose, const FieldPath& path,
                      core::Pose* position);
  void DecodeLocal(const v1::LocalPosition& local, const FieldPath& path,
                   core::Pose* position);
  std::optional<Forward> DecodeOrientation(const v1::Pose& pose,
                                           const FieldPath& path);
  std::optional<Forward> DecodeQuaternion(const v1::Quaternion& quaternion,
                                          const FieldPath& path);
  void DecodeTransition(const v1::Pose& pose, const FieldPath& path,
                        core::PoseSample* sample);
  void ToLocalFrame(const v1::Pose& pose, const Forward& forward,
                    const FieldPath& path, core::PoseSample* sample);
  void Refuse(const FieldPath& path, const std::string& description);
  void AddDefect(const core::Defect& defect, const FieldPath& path);

  const VehicleConfig& config_;
  const PoseSource source_;
  Violations* const violations_;
  const core::StateSpace space_;
  std::optional<GeodeticFrame> frame_;
};

// Adds a violation unless a pose's sequence is the one after that of the pose
// before it in the batch. `path` is the pose's.
void CheckFollows(std::uint64_t before, std::uint64_t sequence,
                  const FieldPath& path, Violations* violations);

}  // namespace revisit::server

#endif  // REVISIT_SERVER_CONVERSION_POSE_DECODER_H_
