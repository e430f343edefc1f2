#include "server/records/stored_columns.h"

#include <algorithm>
#include <array>
#include <cstddef>
#include <cstdint>

#include "absl/types/span.h"
#include "server/fields/pose_fields.h"
#include "server/records/stored_records.pb.h"
#include "server/records/wire_bytes.h"

namespace revisit::server {
namespace {

using stored::PoseBatch;
using Columns = stored::PoseColumns;

std::size_t StepsSize(absl::Span<const std::int64_t> steps) {
  std::size_t size = 0;
  for (const std::int64_t step : steps) {
    size += CodedOutputStream::VarintSize64(ZigZag(step));
  }
  return size;
}

// Writes columns in two goes, so that they take as many bytes as they need.
class Writer {
 public:
  explicit Writer(const ColumnFields& columns)
      : columns_(columns),
        // In the order of their numbers.
        positions_({{
            {Columns::kXMetersFieldNumber, columns.x_meters},
            {Columns::kYMetersFieldNumber, columns.y_meters},
            {Columns::kZMetersFieldNumber, columns.z_meters},
            {Columns::kLatitudeDegreesFieldNumber, columns.latitude_degrees},
            {Columns::kLongitudeDegreesFieldNumber, columns.longitude_degrees},
            {Columns::kHeightMetersFieldNumber, columns.height_meters},
            {Columns::kHeadingRadiansFieldNumber, columns.heading_radians},
            {Columns::kQuaternionsFieldNumber, columns.quaternions},
        }}),
        errors_({{
            {Columns::kCovariancesFieldNumber, columns.covariances},
            {Columns::kCovarianceDiagonalsFieldNumber,
             columns.covariance_diagonals},
            {Columns::kErrorTransitionsFieldNumber, columns.error_transitions},
        }}) {
    if (columns.first_stamp) stamp_ = columns.first_stamp->SerializeAsString();
    if (columns.recording_start) {
      stored::RecordingStart start;
      SetRecordingStart(*columns.recording_start, &start);
      start_ = start.SerializeAsString();
    }
    steps_size_ = StepsSize(columns.stamp_step_nanos);
    size_ =
        VarintSize(Columns::kFirstSequenceFieldNumber, columns.first_sequence) +
        VarintSize(Columns::kPoseCountFieldNumber,
                   Widened(columns.pose_count)) +
        VarintSize(Columns::kCovarianceFormFieldNumber, form());
    if (columns.first_stamp) {
      size_ += BytesSize(Columns::kFirstStampFieldNumber, stamp_.size());
    }
    if (steps_size_ > 0) {
      size_ += BytesSize(Columns::kStampStepNanosFieldNumber, steps_size_);
    }
    for (const Column& column : positions_) size_ += SizeOf(column);
    for (const Column& column : errors_) size_ += SizeOf(column);
    if (columns.recording_start) {
      size_ += BytesSize(Columns::kRecordingStartFieldNumber, start_.size());
    }
  }

  std::string Write() const {
    std::string batch(BytesSize(PoseBatch::kColumnsFieldNumber, size_), '\0');
    std::uint8_t* next = BeginBytes(PoseBatch::kColumnsFieldNumber, size_,
                                    reinterpret_cast<std::uint8_t*>(&batch[0]));
    next = WriteVarint(Columns::kFirstSequenceFieldNumber,
                       columns_.first_sequence, next);
    next = WriteVarint(Columns::kPoseCountFieldNumber,
                       Widened(columns_.pose_count), next);
    next = WriteStamps(next);
    for (const Column& column : positions_) {
      next = WritePacked(column.field, column.values, next);
    }
    next = WriteVarint(Columns::kCovarianceFormFieldNumber, form(), next);
    for (const Column& column : errors_) {
      next = WritePacked(column.field, column.values, next);
    }
    if (columns_.recording_start) {
      next =
          BeginBytes(Columns::kRecordingStartFieldNumber, start_.size(), next);
      std::copy(start_.begin(), start_.end(), next);
    }
    return batch;
  }

 private:
  struct Column {
    int field;
    absl::Span<const double> values;
  };

  static std::size_t SizeOf(const Column& column) {
    return PackedSize(column.field, column.values);
  }

  std::uint64_t form() const {
    return Widened(static_cast<int>(columns_.covariance_form));
  }

  std::uint8_t* WriteStamps(std::uint8_t* next) const {
    if (columns_.first_stamp) {
      next = BeginBytes(Columns::kFirstStampFieldNumber, stamp_.size(), next);
      next = std::copy(stamp_.begin(), stamp_.end(), next);
    }
    if (steps_size_ == 0) return next;
    next = BeginBytes(Columns::kStampStepNanosFieldNumber, steps_size_, next);
    for (const std::int64_t step : columns_.stamp_step_nanos) {
      next = CodedOutputStream::WriteVarint64ToArray(ZigZag(step), next);
    }
    return next;
  }

  const ColumnFields& columns_;
  const std::array<Column, 8> positions_;
  const std::array<Column, 3> errors_;
  // The messages in it, serialized.
  std::string stamp_;
  std::string start_;
  // The bytes of all steps between stamps, and of the whole message.
  std::size_t steps_size_ = 0;
  std::size_t size_ = 0;
};

}  // namespace

std::string EncodeColumns(const ColumnFields& columns) {
  return Writer(columns).Write();
}

}  // namespace revisit::server
