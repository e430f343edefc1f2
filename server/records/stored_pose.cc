#include "server/records/stored_pose.h"

#include <algorithm>
#include <array>
#include <cstring>

#include "absl/types/span.h"
#include "google/protobuf/io/coded_stream.h"
#include "server/records/stored_records.pb.h"

namespace revisit::server {
namespace {

using google::protobuf::io::CodedOutputStream;

enum class WireType : std::uint32_t { kVarint = 0, kFixed64 = 1, kBytes = 2 };

constexpr std::uint32_t Tag(int field, WireType type) {
  return static_cast<std::uint32_t>(field) << 3 |
         static_cast<std::uint32_t>(type);
}

// Up to here, a tag has one byte.
constexpr int kMostField = 15;
static_assert(stored::Pose::kRecordingStartFieldNumber <= kMostField);

std::uint64_t BitsOf(double value) {
  std::uint64_t bits;
  static_assert(sizeof(bits) == sizeof(value));
  std::memcpy(&bits, &value, sizeof(bits));
  return bits;
}

// ---- Sizes, with tags. Fields that are 0, to the bit, are left out.

std::size_t VarintSize(std::uint64_t value) {
  return value == 0 ? 0 : 1 + CodedOutputStream::VarintSize64(value);
}

template <std::size_t count>
std::uint32_t DoublesSize(const std::array<double, count>& values) {
  std::uint32_t size = 0;
  for (const double value : values) size += BitsOf(value) == 0 ? 0 : 9;
  return size;
}

std::size_t BytesSize(std::size_t size) {
  return 1 + CodedOutputStream::VarintSize64(size) + size;
}

std::size_t PackedSize(absl::Span<const double> values) {
  return values.empty() ? 0 : BytesSize(sizeof(double) * values.size());
}

// ---- Fields

std::uint8_t* WriteVarint(int field, std::uint64_t value, std::uint8_t* next) {
  if (value == 0) return next;
  next =
      CodedOutputStream::WriteTagToArray(Tag(field, WireType::kVarint), next);
  return CodedOutputStream::WriteVarint64ToArray(value, next);
}

std::uint8_t* WriteDouble(int field, double value, std::uint8_t* next) {
  next =
      CodedOutputStream::WriteTagToArray(Tag(field, WireType::kFixed64), next);
  return CodedOutputStream::WriteLittleEndian64ToArray(BitsOf(value), next);
}

std::uint8_t* BeginBytes(int field, std::size_t size, std::uint8_t* next) {
  next = CodedOutputStream::WriteTagToArray(Tag(field, WireType::kBytes), next);
  return CodedOutputStream::WriteVarint64ToArray(size, next);
}

std::uint8_t* WritePacked(int field, absl::Span<const double> values,
                          std::uint8_t* next) {
  if (values.empty()) return next;
  next = BeginBytes(field, sizeof(double) * values.size(), next);
  for (const double value : values) {
    next = CodedOutputStream::WriteLittleEndian64ToArray(BitsOf(value), next);
  }
  return next;
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

// Negative numbers of 32 bits are stored as those of 64 bits.
std::uint64_t Widened(std::int64_t value) {
  return static_cast<std::uint64_t>(value);
}

}  // namespace

StoredPose::StoredPose(const PoseFields& pose) {
  size_ = VarintSize(pose.sequence) + PackedSize(pose.error_transition);
  if (pose.stamp != nullptr) {
    stamp_size_ =
        static_cast<std::uint32_t>(VarintSize(Widened(pose.stamp->seconds())) +
                                   VarintSize(Widened(pose.stamp->nanos())));
    size_ += BytesSize(stamp_size_);
  }
  if (pose.position_kind != PoseFields::Position::kNone) {
    position_size_ = DoublesSize(pose.position);
    size_ += BytesSize(position_size_);
  }
  if (pose.orientation_kind == PoseFields::Orientation::kQuaternion) {
    quaternion_size_ = DoublesSize(pose.orientation);
    size_ += BytesSize(quaternion_size_);
  } else if (pose.orientation_kind == PoseFields::Orientation::kHeading) {
    size_ += 1 + sizeof(double);
  }
  if (pose.covariance) {
    covariance_size_ = static_cast<std::uint32_t>(
        VarintSize(Widened(static_cast<int>(pose.covariance->form))) +
        PackedSize(pose.covariance->values));
    size_ += BytesSize(covariance_size_);
  }
  if (pose.recording_start) {
    stored::RecordingStart start;
    SetRecordingStart(*pose.recording_start, &start);
    recording_start_ =
        std::make_unique<const std::string>(start.SerializeAsString());
    size_ += BytesSize(recording_start_->size());
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
