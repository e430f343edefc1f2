#include "server/conversion/poses.h"

#include <algorithm>
#include <string>
#include <utility>

#include "absl/strings/numbers.h"
#include "absl/strings/str_cat.h"
#include "absl/strings/string_view.h"
#include "absl/strings/strip.h"
#include "server/fields/column_decoder.h"
#include "server/fields/enums.h"
#include "server/fields/pose_columns.h"
#include "server/fields/pose_decoder.h"
#include "server/fields/pose_fields.h"
#include "server/records/batch_records.h"
#include "server/records/stored_columns.h"

namespace revisit::server {

using absl::StrCat;

static_assert(AreCovarianceForms(v1::COVARIANCE_FORM_PLANAR_6,
                                 v1::COVARIANCE_FORM_SPATIAL_10,
                                 v1::COVARIANCE_FORM_ROS_36));

namespace {

constexpr EnumRow<v1::PoseView, BatchVersion> kViews[] = {
    {v1::POSE_VIEW_CURRENT, BatchVersion::kCurrent},
    {v1::POSE_VIEW_AS_SENT, BatchVersion::kAsSent}};

absl::Status CheckCount(int count, int max_poses, const FieldPath& path) {
  if (count >= 1 && count <= max_poses) return absl::OkStatus();
  return InvalidField(
      "BATCH_SIZE", path,
      StrCat("got ", count, " poses; allowed is [1, ", max_poses, "]"));
}

// The poses lie below `path` as a field `poses`.
absl::StatusOr<DecodedBatch> DecodeMessages(const Poses& poses,
                                            const FieldPath& path,
                                            const VehicleConfig& config) {
  Violations violations;
  PoseDecoder decoder(config, PoseSource::kAppend, &violations);
  const auto count = static_cast<std::size_t>(poses.size());
  DecodedBatch batch;
  BatchEncoder encoder(count);
  batch.samples =
      DecodePoses(count, FieldsOfEach(poses), path, &decoder, &violations,
                  [&](const PoseFields& pose) { encoder.Measure(pose); });
  if (violations.count() > 0) return violations.ToStatus();
  batch.payload = encoder.Write(FieldsOfEach(poses));
  batch.origin = decoder.origin();
  return batch;
}

// The column of a field that DecodeColumns() calls "poses[3].local.x_meters".
std::string NameIn(const PoseColumns& columns, const std::string& name) {
  absl::string_view rest = name;
  std::size_t index = 0;
  const std::size_t end = name.find(']');
  if (!absl::ConsumePrefix(&rest, "poses[") || end == std::string::npos ||
      !absl::SimpleAtoi(name.substr(6, end - 6), &index)) {
    return name;
  }
  return columns.ColumnOf(index, name.substr(std::min(end + 2, name.size())));
}

// `path` is that of the columns.
absl::StatusOr<DecodedBatch> DecodeColumnsOf(const v1::PoseColumns& message,
                                             const FieldPath& path,
                                             const VehicleConfig& config) {
  Violations violations;
  PoseColumns columns(ColumnFieldsOf(message), path, &violations);
  if (violations.count() > 0) return violations.ToStatus();
  PoseDecoder decoder(config, PoseSource::kAppend, &violations);
  DecodedBatch batch;
  batch.samples = DecodeColumns(&columns, &decoder, &violations);
  if (violations.count() > 0) {
    violations.Rename([&](const std::string& name) {
      return StrCat(path.ToString(), ".", NameIn(columns, name));
    });
    return violations.ToStatus();
  }
  batch.payload = EncodeColumns(columns.fields());
  batch.origin = decoder.origin();
  return batch;
}

}  // namespace

std::uint64_t SentPoses::count() const {
  auto count = static_cast<std::uint64_t>(poses->size());
  if (columns == nullptr) return count;
  const int places =
      std::max(columns->x_meters_size(), columns->latitude_degrees_size());
  return count + static_cast<std::uint64_t>(
                     std::clamp(columns->pose_count(), 0, places));
}

absl::StatusOr<DecodedBatch> DecodeBatch(const SentPoses& sent, int max_poses,
                                         const VehicleConfig& config,
                                         const FieldPath& path) {
  if (sent.columns == nullptr) {
    if (absl::Status status =
            CheckCount(sent.poses->size(), max_poses, path.Field("poses"));
        !status.ok()) {
      return status;
    }
    return DecodeMessages(*sent.poses, path, config);
  }
  const FieldPath in_columns = path.Field("columns");
  if (!sent.poses->empty()) {
    return InvalidField(kInvalidField, in_columns,
                        "got both this and `poses`; allowed is one");
  }
  if (absl::Status status = CheckCount(sent.columns->pose_count(), max_poses,
                                       in_columns.Field("pose_count"));
      !status.ok()) {
    return status;
  }
  return DecodeColumnsOf(*sent.columns, in_columns, config);
}

BatchDecoder DecoderOf(const SentPoses& sent, int max_poses,
                       const char* parent) {
  return [sent, max_poses, parent](const VehicleConfig& config) {
    const FieldPath request;
    return DecodeBatch(sent, max_poses, config,
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
