#include "server/fields/pose_decoder.h"

#include <cmath>
#include <cstddef>
#include <string>

#include "absl/strings/str_cat.h"
#include "core/base/number_text.h"
#include "core/geometry/pose.h"
#include "server/base/sequences.h"
#include "server/fields/covariances.h"
#include "server/fields/recording_starts.h"
#include "server/fields/timestamps.h"

namespace revisit::server {
namespace {

constexpr char kQuaternionInvalid[] = "QUATERNION_INVALID";

// REQUIRES: the position is geodetic.
GeodeticOrigin ToOrigin(const PoseFields& pose) {
  return {pose.position[0], pose.position[1], pose.position[2]};
}

}  // namespace

PoseDecoder::PoseDecoder(const VehicleConfig& config, PoseSource source,
                         Violations* violations)
    : config_(config),
      source_(source),
      violations_(violations),
      space_(config.drive.state_space) {
  if (config.frame == CoordinateFrame::kGeodetic && config.origin) {
    frame_.emplace(*config.origin);
  }
}

std::optional<GeodeticOrigin> PoseDecoder::origin() const {
  if (!frame_) return std::nullopt;
  return frame_->origin();
}

core::PoseSample PoseDecoder::Decode(const PoseFields& pose,
                                     const FieldPath& path) {
  const std::size_t violations_before = violations_->count();
  core::PoseSample sample;
  sample.sequence = pose.sequence;
  if (pose.sequence < 1 || pose.sequence > kMaxSequence) {
    Refuse(path.Field("sequence"),
           absl::StrCat("got ", pose.sequence, "; allowed is [1, ",
                        kMaxSequence, "]"));
  }
  if (pose.stamp != nullptr &&
      CheckTimestamp(*pose.stamp, path.Field("stamp"), violations_)) {
    sample.stamp_ns = ToNanoseconds(*pose.stamp);
  }
  DecodePosition(pose, path, &sample.pose);
  const std::optional<Forward> forward = DecodeOrientation(pose, path);
  if (pose.covariance) {
    DecodeCovariance(*pose.covariance, space_, path.Field("covariance"),
                     &sample.covariance, violations_);
  } else {
    Refuse(path.Field("covariance"), "required");
  }
  DecodeTransition(pose, path, &sample);
  DecodeRecordingStart(pose, path, &sample);
  if (violations_->count() != violations_before) return sample;

  if (pose.has_geodetic()) {
    ToLocalFrame(pose, *forward, path, &sample);
  } else {
    sample.pose.heading = forward->heading;
  }
  if (violations_->count() != violations_before) return sample;
  if (const auto defect = core::FindDefect(sample, space_)) {
    AddDefect(*defect, path);
  }
  return sample;
}

void PoseDecoder::Refuse(const FieldPath& path,
                         const std::string& description) {
  violations_->Add(kInvalidField, path, description);
}

void PoseDecoder::DecodePosition(const PoseFields& pose, const FieldPath& path,
                                 core::Pose* position) {
  const bool geodetic_vehicle = config_.frame == CoordinateFrame::kGeodetic;
  switch (pose.position_kind) {
    case PoseFields::Position::kLocal:
      if (geodetic_vehicle && source_ == PoseSource::kAppend) {
        Refuse(path.Field("local"),
               "got a local position; this vehicle's coordinate frame is "
               "GEODETIC");
        return;
      }
      DecodeLocal(pose.position, path.Field("local"), position);
      return;
    case PoseFields::Position::kGeodetic:
      if (!geodetic_vehicle) {
        Refuse(path.Field("geodetic"),
               "got a geodetic position; this vehicle's coordinate frame is "
               "LOCAL");
        return;
      }
      CheckGeodetic(ToOrigin(pose), path.Field("geodetic"), violations_);
      return;
    case PoseFields::Position::kNone:
      Refuse(path.Field("position"),
             absl::StrCat("required; this vehicle takes ",
                          geodetic_vehicle ? "`geodetic`" : "`local`"));
      return;
  }
}

void PoseDecoder::DecodeLocal(const std::array<double, 3>& local,
                              const FieldPath& path, core::Pose* position) {
  const double limit = core::kMaxCoordinateMeters;
  CheckRange(local[0], -limit, limit, path.Field("x_meters"), violations_);
  CheckRange(local[1], -limit, limit, path.Field("y_meters"), violations_);
  CheckRange(local[2], -limit, limit, path.Field("z_meters"), violations_);
  position->x = local[0];
  position->y = local[1];
  position->z = local[2];
}

std::optional<Forward> PoseDecoder::DecodeOrientation(const PoseFields& pose,
                                                      const FieldPath& path) {
  switch (pose.orientation_kind) {
    case PoseFields::Orientation::kHeading: {
      const double heading = pose.orientation[0];
      if (!CheckRange(heading, -core::kMaxHeadingRadians,
                      core::kMaxHeadingRadians, path.Field("heading_radians"),
                      violations_)) {
        return std::nullopt;
      }
      if (!pose.has_geodetic()) return Forward{heading, {}};
      return Forward{heading, {std::cos(heading), std::sin(heading), 0.0}};
    }
    case PoseFields::Orientation::kQuaternion:
      return DecodeQuaternion(pose.orientation, path.Field("quaternion"));
    case PoseFields::Orientation::kNone:
      Refuse(path.Field("orientation"),
             "required: `heading_radians` or `quaternion`");
      return std::nullopt;
  }
  return std::nullopt;
}

std::optional<Forward> PoseDecoder::DecodeQuaternion(
    const Quaternion& quaternion, const FieldPath& path) {
  const auto [x, y, z, w] = quaternion;
  bool finite = CheckFinite(x, path.Field("x"), violations_);
  finite &= CheckFinite(y, path.Field("y"), violations_);
  finite &= CheckFinite(z, path.Field("z"), violations_);
  finite &= CheckFinite(w, path.Field("w"), violations_);
  if (!finite) return std::nullopt;
  const double norm = NormOf(quaternion);
  if (!IsUnit(norm)) {
    violations_->Add(kQuaternionInvalid, path,
                     absl::StrCat("its norm is ", core::NumberText(norm),
                                  "; allowed is 1 to within 0.001"));
    return std::nullopt;
  }
  std::optional<Forward> forward = ForwardOf(quaternion, norm);
  if (!forward) {
    violations_->Add(
        kQuaternionInvalid, path,
        "the forward axis points straight up or down and has no heading");
  }
  return forward;
}

void PoseDecoder::DecodeTransition(const PoseFields& pose,
                                   const FieldPath& path,
                                   core::PoseSample* sample) {
  const auto given = static_cast<int>(pose.error_transition.size());
  const FieldPath field = path.Field("error_transition");
  if (!core::NoiseOf(config_.drive.search.correlation_model)
           .carries_transitions) {
    if (given != 0) {
      Refuse(field,
             absl::StrCat(
                 "got ", given,
                 " numbers; this vehicle's correlation model is not FILTER"));
    }
    return;
  }
  const int size = core::DegreesOfFreedom(space_);
  const bool optional = pose.sequence == 1 || pose.recording_start ||
                        source_ == PoseSource::kRevision;
  if (given == 0 && optional) return;
  if (given != size * size) {
    Refuse(field,
           absl::StrCat("got ", given,
                        " numbers; this vehicle's correlation model is FILTER "
                        "and needs ",
                        size * size));
    return;
  }
  core::ErrorTransition transition;
  bool finite = true;
  for (int i = 0; i < given; ++i) {
    const auto k = static_cast<std::size_t>(i);
    const double value = pose.error_transition[k];
    finite &= CheckFinite(value, path.At("error_transition", k), violations_);
    transition.values[TransitionIndex(space_, i / size, i % size)] = value;
  }
  if (finite) sample->transition = transition;
}

// A revision leaves the starts of recordings alone.
void PoseDecoder::DecodeRecordingStart(const PoseFields& pose,
                                       const FieldPath& path,
                                       core::PoseSample* sample) {
  if (!pose.recording_start || source_ == PoseSource::kRevision) return;
  const FieldPath field = path.Field("recording_start");
  if (config_.frame == CoordinateFrame::kGeodetic) {
    Refuse(field,
           "got one; this vehicle's coordinate frame is GEODETIC, which all of "
           "its poses share");
    return;
  }
  const TextCheck texts =
      source_ == PoseSource::kStored ? TextCheck::kNone : TextCheck::kAll;
  sample->recording_start = server::DecodeRecordingStart(
      *pose.recording_start, space_, texts, field, violations_);
}

void PoseDecoder::ToLocalFrame(const PoseFields& pose, const Forward& forward,
                               const FieldPath& path,
                               core::PoseSample* sample) {
  const GeodeticOrigin position = ToOrigin(pose);
  if (!frame_) frame_.emplace(position);
  if (!frame_->ToLocal(position, forward.axis, space_, sample)) {
    Refuse(path.Field("orientation"),
           "so far from the vehicle's origin, the forward axis is vertical in "
           "the local frame and has no heading");
  }
}

void PoseDecoder::AddDefect(const core::Defect& defect, const FieldPath& path) {
  const FieldPath part = path.Field(defect.part.c_str());
  violations_->Add(ReasonOf(defect.kind),
                   defect.part == "covariance" ? part.Field("values") : part,
                   defect.description);
}

void CheckFollows(std::uint64_t before, std::uint64_t sequence,
                  const FieldPath& path, Violations* violations) {
  if (const auto gap = FindSequenceGap(before, sequence)) {
    violations->Add(kInvalidField, path.Field("sequence"), *gap);
  }
}

}  // namespace revisit::server
