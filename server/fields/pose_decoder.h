// Poses of messages as samples of core.
#ifndef REVISIT_SERVER_FIELDS_POSE_DECODER_H_
#define REVISIT_SERVER_FIELDS_POSE_DECODER_H_

#include <array>
#include <cstddef>
#include <cstdint>
#include <optional>
#include <string>
#include <vector>

#include "core/drive/drive.h"
#include "core/geometry/pose.h"
#include "server/fields/field_violations.h"
#include "server/fields/geodetic_frame.h"
#include "server/fields/pose_fields.h"
#include "server/fields/pose_orientation.h"
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
  core::PoseSample Decode(const PoseFields& pose, const FieldPath& path);

  const VehicleConfig& config() const { return config_; }
  PoseSource source() const { return source_; }

  // The origin of a geodetic vehicle: that of the config or, without, that of
  // the first pose that can be decoded.
  std::optional<GeodeticOrigin> origin() const;

 private:
  void DecodePosition(const PoseFields& pose, const FieldPath& path,
                      core::Pose* position);
  void DecodeLocal(const std::array<double, 3>& local, const FieldPath& path,
                   core::Pose* position);
  // The axis is set for geodetic poses and quaternions only.
  std::optional<Forward> DecodeOrientation(const PoseFields& pose,
                                           const FieldPath& path);
  std::optional<Forward> DecodeQuaternion(const Quaternion& quaternion,
                                          const FieldPath& path);
  void DecodeTransition(const PoseFields& pose, const FieldPath& path,
                        core::PoseSample* sample);
  void DecodeRecordingStart(const PoseFields& pose, const FieldPath& path,
                            core::PoseSample* sample);
  void ToLocalFrame(const PoseFields& pose, const Forward& forward,
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

// Decodes so many poses, which have to follow each other: `fields_of(i)` has
// the fields of one, which may be valid until the next is asked for. The field
// `poses` lies below `path`. Calls `each` with the fields of every pose.
template <typename FieldsOf, typename Each>
std::vector<core::PoseSample> DecodePoses(std::size_t count, FieldsOf fields_of,
                                          const FieldPath& path,
                                          PoseDecoder* decoder,
                                          Violations* violations, Each each) {
  std::vector<core::PoseSample> samples;
  samples.reserve(count);
  std::uint64_t before = 0;
  for (std::size_t i = 0; i < count; ++i) {
    const PoseFields fields = fields_of(i);
    const FieldPath pose = path.At("poses", i);
    const bool is_first = samples.empty();
    samples.push_back(decoder->Decode(fields, pose));
    if (!is_first) CheckFollows(before, fields.sequence, pose, violations);
    before = fields.sequence;
    each(fields);
  }
  return samples;
}

}  // namespace revisit::server

#endif  // REVISIT_SERVER_FIELDS_POSE_DECODER_H_
