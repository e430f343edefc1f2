#include "server/conversion/stored_pose.h"

#include <array>
#include <cstring>

#include "google/protobuf/io/coded_stream.h"
#include "google/protobuf/repeated_field.h"
#include "server/conversion/stored_records.pb.h"

namespace revisit::server {
namespace {

using google::protobuf::RepeatedField;
using google::protobuf::io::CodedOutputStream;

enum class WireType : std::uint32_t { kVarint = 0, kFixed64 = 1, kBytes = 2 };

constexpr std::uint32_t Tag(int field, WireType type) {
  return static_cast<std::uint32_t>(field) << 3 |
         static_cast<std::uint32_t>(type);
}

// Up to here, a tag has one byte.
constexpr int kMostField = 15;
static_assert(stored::Pose::kErrorTransitionFieldNumber <= kMostField);

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

std::size_t PackedSize(const RepeatedField<double>& values) {
  return values.empty() ? 0
                        : BytesSize(sizeof(double) *
                                    static_cast<std::size_t>(values.size()));
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

std::uint8_t* WritePacked(int field, const RepeatedField<double>& values,
                          std::uint8_t* next) {
  if (values.empty()) return next;
  next = BeginBytes(
      field, sizeof(double) * static_cast<std::size_t>(values.size()), next);
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

// ---- Messages whose fields 1, 2, ... are numbers

static_assert(stored::LocalPosition::kXMetersFieldNumber == 1 &&
              stored::LocalPosition::kYMetersFieldNumber == 2 &&
              stored::LocalPosition::kZMetersFieldNumber == 3);
std::array<double, 3> NumbersOf(const v1::LocalPosition& local) {
  return {local.x_meters(), local.y_meters(), local.z_meters()};
}

static_assert(stored::GeodeticPosition::kLatitudeDegreesFieldNumber == 1 &&
              stored::GeodeticPosition::kLongitudeDegreesFieldNumber == 2 &&
              stored::GeodeticPosition::kHeightMetersFieldNumber == 3);
std::array<double, 3> NumbersOf(const v1::GeodeticPosition& geodetic) {
  return {geodetic.latitude_degrees(), geodetic.longitude_degrees(),
          geodetic.height_meters()};
}

static_assert(stored::Quaternion::kXFieldNumber == 1 &&
              stored::Quaternion::kYFieldNumber == 2 &&
              stored::Quaternion::kZFieldNumber == 3 &&
              stored::Quaternion::kWFieldNumber == 4);
std::array<double, 4> NumbersOf(const v1::Quaternion& quaternion) {
  return {quaternion.x(), quaternion.y(), quaternion.z(), quaternion.w()};
}

// Negative numbers of 32 bits are stored as those of 64 bits.
std::uint64_t Widened(std::int64_t value) {
  return static_cast<std::uint64_t>(value);
}

}  // namespace

StoredPose::StoredPose(const v1::Pose& pose) : pose_(&pose) {
  size_ = VarintSize(pose.sequence()) + PackedSize(pose.error_transition());
  if (pose.has_stamp()) {
    stamp_size_ =
        static_cast<std::uint32_t>(VarintSize(Widened(pose.stamp().seconds())) +
                                   VarintSize(Widened(pose.stamp().nanos())));
    size_ += BytesSize(stamp_size_);
  }
  if (pose.has_local()) {
    position_size_ = DoublesSize(NumbersOf(pose.local()));
    size_ += BytesSize(position_size_);
  } else if (pose.has_geodetic()) {
    position_size_ = DoublesSize(NumbersOf(pose.geodetic()));
    size_ += BytesSize(position_size_);
  }
  if (pose.has_quaternion()) {
    quaternion_size_ = DoublesSize(NumbersOf(pose.quaternion()));
    size_ += BytesSize(quaternion_size_);
  } else if (pose.has_heading_radians()) {
    size_ += 1 + sizeof(double);
  }
  if (pose.has_covariance()) {
    covariance_size_ = static_cast<std::uint32_t>(
        VarintSize(Widened(pose.covariance().form())) +
        PackedSize(pose.covariance().values()));
    size_ += BytesSize(covariance_size_);
  }
}

std::uint8_t* StoredPose::Write(std::uint8_t* next) const {
  const v1::Pose& pose = *pose_;
  next = WriteVarint(stored::Pose::kSequenceFieldNumber, pose.sequence(), next);
  if (pose.has_stamp()) {
    next = BeginBytes(stored::Pose::kStampFieldNumber, stamp_size_, next);
    next = WriteVarint(google::protobuf::Timestamp::kSecondsFieldNumber,
                       Widened(pose.stamp().seconds()), next);
    next = WriteVarint(google::protobuf::Timestamp::kNanosFieldNumber,
                       Widened(pose.stamp().nanos()), next);
  }
  if (pose.has_local()) {
    next = BeginBytes(stored::Pose::kLocalFieldNumber, position_size_, next);
    next = WriteDoubles(NumbersOf(pose.local()), next);
  } else if (pose.has_geodetic()) {
    next = BeginBytes(stored::Pose::kGeodeticFieldNumber, position_size_, next);
    next = WriteDoubles(NumbersOf(pose.geodetic()), next);
  }
  if (pose.has_quaternion()) {
    next = BeginBytes(stored::Pose::kQuaternionFieldNumber, quaternion_size_,
                      next);
    next = WriteDoubles(NumbersOf(pose.quaternion()), next);
  } else if (pose.has_heading_radians()) {
    next = WriteDouble(stored::Pose::kHeadingRadiansFieldNumber,
                       pose.heading_radians(), next);
  }
  if (pose.has_covariance()) {
    const v1::Covariance& covariance = pose.covariance();
    next = BeginBytes(stored::Pose::kCovarianceFieldNumber, covariance_size_,
                      next);
    next = WriteVarint(stored::Covariance::kFormFieldNumber,
                       Widened(covariance.form()), next);
    next = WritePacked(stored::Covariance::kValuesFieldNumber,
                       covariance.values(), next);
  }
  return WritePacked(stored::Pose::kErrorTransitionFieldNumber,
                     pose.error_transition(), next);
}

}  // namespace revisit::server
