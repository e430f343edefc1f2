#include "server/conversion/poses.h"

#include "absl/strings/str_cat.h"
#include "server/fields/enums.h"
#include "server/fields/pose_decoder.h"
#include "server/fields/pose_fields.h"
#include "server/records/batch_records.h"

namespace revisit::server {

static_assert(AreCovarianceForms(v1::COVARIANCE_FORM_PLANAR_6,
                                 v1::COVARIANCE_FORM_SPATIAL_10,
                                 v1::COVARIANCE_FORM_ROS_36));

namespace {

constexpr EnumRow<v1::PoseView, BatchVersion> kViews[] = {
    {v1::POSE_VIEW_CURRENT, BatchVersion::kCurrent},
    {v1::POSE_VIEW_AS_SENT, BatchVersion::kAsSent}};

}  // namespace

absl::StatusOr<DecodedBatch> DecodeBatch(const Poses& poses, int max_poses,
                                         const VehicleConfig& config,
                                         const FieldPath& path) {
  if (poses.empty() || poses.size() > max_poses) {
    return InvalidField(
        "BATCH_SIZE", path.Field("poses"),
        absl::StrCat("got ", poses.size(), " poses; allowed is [1, ", max_poses,
                     "]"));
  }
  Violations violations;
  PoseDecoder decoder(config, PoseSource::kAppend, &violations);
  DecodedBatch batch;
  BatchEncoder encoder(static_cast<std::size_t>(poses.size()));
  batch.samples =
      DecodePoses(poses, path, &decoder, &violations,
                  [&](const PoseFields& pose) { encoder.Measure(pose); });
  if (violations.count() > 0) return violations.ToStatus();
  encoder.Write(poses, &batch);
  batch.origin = decoder.origin();
  return batch;
}

BatchDecoder DecoderOf(const Poses* poses, int max_poses, const char* parent) {
  return [poses, max_poses, parent](const VehicleConfig& config) {
    const FieldPath request;
    return DecodeBatch(*poses, max_poses, config,
                       parent == nullptr ? request : request.Field(parent));
  };
}

void DropUnknownFields(Poses* poses) {
  // Each message is asked first, since dropping visits every field by
  // reflection.
  const auto is_clean = [](bool has, const google::protobuf::Message& message) {
    return !has || message.GetReflection()->GetUnknownFields(message).empty();
  };
  for (v1::Pose& pose : *poses) {
    if (is_clean(true, pose) && is_clean(pose.has_stamp(), pose.stamp()) &&
        is_clean(pose.has_local(), pose.local()) &&
        is_clean(pose.has_geodetic(), pose.geodetic()) &&
        is_clean(pose.has_quaternion(), pose.quaternion()) &&
        is_clean(pose.has_covariance(), pose.covariance()) &&
        !pose.has_recording_start()) {
      continue;
    }
    pose.DiscardUnknownFields();
  }
}

absl::StatusOr<BatchVersion> DecodePoseView(v1::PoseView view) {
  Violations violations;
  BatchVersion version = BatchVersion::kCurrent;
  DecodeEnum(kViews, view, FieldPath().Field("view"), &version, &violations);
  if (absl::Status status = violations.ToStatus(); !status.ok()) return status;
  return version;
}

absl::Status CheckRevisedPoses(const Poses& poses, std::size_t first_number,
                               const VehicleConfig& config) {
  Violations violations;
  PoseDecoder decoder(config, PoseSource::kRevision, &violations);
  std::size_t number = first_number;
  for (const v1::Pose& pose : poses) {
    decoder.Decode(PoseFieldsOf(pose), FieldPath().At("poses", number++));
  }
  return violations.ToStatus();
}

}  // namespace revisit::server
