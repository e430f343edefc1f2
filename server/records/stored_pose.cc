#include "server/records/stored_pose.h"

#include <algorithm>
#include <array>

#include "absl/types/span.h"
#include "server/records/stored_records.pb.h"
#include "server/records/wire_bytes.h"

namespace revisit::server {
namespace {

template <std::size_t count>
std::uint32_t DoublesSize(const std::array<double, count>& values) {
  std::uint32_t size = 0;
  for (const double value : values) size += BitsOf(value) == 0 ? 0 : 9;
  return size;
}

// Fields 1, 2, ... of a message.
template <std::size_t count>
std::uint8_t* WriteDoubles(const std::array<double, count>& values,
                           std::uint8_t* next) {
  int field = 0;
  for (const double value : values) {
    ++field;
    if (BitsOf(value) != 0) next = WriteDouble(field, value, next);
  }
  return next;
}

// ---- Messages whose fields 1, 2, ... are numbers: those of PoseFields

static_assert(stored::LocalPosition::kXMetersFieldNumber == 1 &&
              stored::LocalPosition::kYMetersFieldNumber == 2 &&
              stored::LocalPosition::kZMetersFieldNumber == 3);
static_assert(stored::GeodeticPosition::kLatitudeDegreesFieldNumber == 1 &&
              stored::GeodeticPosition::kLongitudeDegreesFieldNumber == 2 &&
              stored::GeodeticPosition::kHeightMetersFieldNumber == 3);
static_assert(stored::Quaternion::kXFieldNumber == 1 &&
              stored::Quaternion::kYFieldNumber == 2 &&
              stored::Quaternion::kZFieldNumber == 3 &&
              stored::Quaternion::kWFieldNumber == 4);
static_assert(AreCovarianceForms(stored::COVARIANCE_FORM_PLANAR_6,
                                 stored::COVARIANCE_FORM_SPATIAL_10,
                                 stored::COVARIANCE_FORM_ROS_36));

}  // namespace

StoredPose::StoredPose(const PoseFields& pose) {
  using Pose = stored::Pose;
  size_ = VarintSize(Pose::kSequenceFieldNumber, pose.sequence) +
          PackedSize(Pose::kErrorTransitionFieldNumber, pose.error_transition);
  if (pose.stamp != nullptr) {
    using google::protobuf::Timestamp;
    stamp_size_ = static_cast<std::uint32_t>(
        VarintSize(Timestamp::kSecondsFieldNumber,
                   Widened(pose.stamp->seconds())) +
        VarintSize(Timestamp::kNanosFieldNumber, Widened(pose.stamp->nanos())));
    size_ += BytesSize(Pose::kStampFieldNumber, stamp_size_);
  }
  if (pose.position_kind != PoseFields::Position::kNone) {
    position_size_ = DoublesSize(pose.position);
    size_ += BytesSize(Pose::kLocalFieldNumber, position_size_);
  }
  if (pose.orientation_kind == PoseFields::Orientation::kQuaternion) {
    quaternion_size_ = DoublesSize(pose.orientation);
    size_ += BytesSize(Pose::kQuaternionFieldNumber, quaternion_size_);
  } else if (pose.orientation_kind == PoseFields::Orientation::kHeading) {
    size_ += TagSize(Pose::kHeadingRadiansFieldNumber) + sizeof(double);
  }
  if (pose.covariance) {
    covariance_size_ = static_cast<std::uint32_t>(
        VarintSize(stored::Covariance::kFormFieldNumber,
                   Widened(static_cast<int>(pose.covariance->form))) +
        PackedSize(stored::Covariance::kValuesFieldNumber,
                   pose.covariance->values));
    size_ += BytesSize(Pose::kCovarianceFieldNumber, covariance_size_);
  }
  if (pose.recording_start) {
    stored::RecordingStart start;
    SetRecordingStart(*pose.recording_start, &start);
    recording_start_ =
        std::make_unique<const std::string>(start.SerializeAsString());
    size_ +=
        BytesSize(Pose::kRecordingStartFieldNumber, recording_start_->size());
  }
}

std::uint8_t* StoredPose::Write(const PoseFields& pose,
                                std::uint8_t* next) const {
  next = WriteVarint(stored::Pose::kSequenceFieldNumber, pose.sequence, next);
  if (pose.stamp != nullptr) {
    next = BeginBytes(stored::Pose::kStampFieldNumber, stamp_size_, next);
    next = WriteVarint(google::protobuf::Timestamp::kSecondsFieldNumber,
                       Widened(pose.stamp->seconds()), next);
    next = WriteVarint(google::protobuf::Timestamp::kNanosFieldNumber,
                       Widened(pose.stamp->nanos()), next);
  }
  if (pose.position_kind != PoseFields::Position::kNone) {
    const int field = pose.has_geodetic() ? stored::Pose::kGeodeticFieldNumber
                                          : stored::Pose::kLocalFieldNumber;
    next = BeginBytes(field, position_size_, next);
    next = WriteDoubles(pose.position, next);
  }
  if (pose.orientation_kind == PoseFields::Orientation::kQuaternion) {
    next = BeginBytes(stored::Pose::kQuaternionFieldNumber, quaternion_size_,
                      next);
    next = WriteDoubles(pose.orientation, next);
  } else if (pose.orientation_kind == PoseFields::Orientation::kHeading) {
    next = WriteDouble(stored::Pose::kHeadingRadiansFieldNumber,
                       pose.orientation[0], next);
  }
  if (pose.covariance) {
    next = BeginBytes(stored::Pose::kCovarianceFieldNumber, covariance_size_,
                      next);
    next = WriteVarint(stored::Covariance::kFormFieldNumber,
                       Widened(static_cast<int>(pose.covariance->form)), next);
    next = WritePacked(stored::Covariance::kValuesFieldNumber,
                       pose.covariance->values, next);
  }
  next = WritePacked(stored::Pose::kErrorTransitionFieldNumber,
                     pose.error_transition, next);
  if (recording_start_ != nullptr) {
    next = BeginBytes(stored::Pose::kRecordingStartFieldNumber,
                      recording_start_->size(), next);
    next = std::copy(recording_start_->begin(), recording_start_->end(), next);
  }
  return next;
}

}  // namespace revisit::server
