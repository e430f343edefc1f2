// Poses as columns, whichever message they are in: the API's or the store's.
#ifndef REVISIT_SERVER_FIELDS_POSE_COLUMNS_H_
#define REVISIT_SERVER_FIELDS_POSE_COLUMNS_H_

#include <array>
#include <cstddef>
#include <cstdint>
#include <memory>
#include <optional>
#include <string>
#include <vector>

#include "absl/types/span.h"
#include "google/protobuf/timestamp.pb.h"
#include "server/fields/field_violations.h"
#include "server/fields/pose_fields.h"

namespace revisit::server {

// Columns as their message has them: nothing is checked. It points into the
// message, which has to outlive it. Columns that are absent are empty.
struct ColumnFields {
  using Doubles = absl::Span<const double>;

  std::uint64_t first_sequence = 0;
  std::int32_t pose_count = 0;
  std::optional<google::protobuf::Timestamp> first_stamp;
  absl::Span<const std::int64_t> stamp_step_nanos;
  Doubles x_meters;
  Doubles y_meters;
  Doubles z_meters;
  Doubles latitude_degrees;
  Doubles longitude_degrees;
  Doubles height_meters;
  Doubles heading_radians;
  Doubles quaternions;
  CovarianceForm covariance_form{};
  Doubles covariances;
  Doubles covariance_diagonals;
  Doubles error_transitions;
  // Null if absent.
  std::shared_ptr<const RecordingStartFields> recording_start;
};

// Columns: a message with these fields by their names.
template <typename Columns>
ColumnFields ColumnFieldsOf(const Columns& message) {
  ColumnFields fields;
  fields.first_sequence = message.first_sequence();
  fields.pose_count = message.pose_count();
  if (message.has_first_stamp()) {
    fields.first_stamp.emplace();
    fields.first_stamp->set_seconds(message.first_stamp().seconds());
    fields.first_stamp->set_nanos(message.first_stamp().nanos());
  }
  fields.stamp_step_nanos = message.stamp_step_nanos();
  fields.x_meters = message.x_meters();
  fields.y_meters = message.y_meters();
  fields.z_meters = message.z_meters();
  fields.latitude_degrees = message.latitude_degrees();
  fields.longitude_degrees = message.longitude_degrees();
  fields.height_meters = message.height_meters();
  fields.heading_radians = message.heading_radians();
  fields.quaternions = message.quaternions();
  fields.covariance_form =
      static_cast<CovarianceForm>(message.covariance_form());
  fields.covariances = message.covariances();
  fields.covariance_diagonals = message.covariance_diagonals();
  fields.error_transitions = message.error_transitions();
  if (message.has_recording_start()) {
    fields.recording_start = std::make_shared<const RecordingStartFields>(
        RecordingStartFieldsOf(message.recording_start()));
  }
  return fields;
}

// The poses that columns are, one after the other.
class PoseColumns {
 public:
  // Adds a violation for each column whose length does not fit the others, for
  // columns that exclude each other, and for those that are missing. Fields lie
  // below `path`.
  PoseColumns(ColumnFields fields, const FieldPath& path,
              Violations* violations);

  const ColumnFields& fields() const { return fields_; }
  std::size_t size() const {
    return static_cast<std::size_t>(fields_.pose_count);
  }

  // ---- REQUIRES: there were no violations; indexes are below size().

  // The fields of a pose, valid until the next call.
  PoseFields At(std::size_t index);
  // Its covariance alone, likewise.
  CovarianceFields CovarianceAt(std::size_t index);
  // Whether all poses have the same covariance.
  bool has_one_covariance() const { return has_one_covariance_; }
  // Empty if it has none.
  absl::Span<const double> TransitionAt(std::size_t index) const;
  // Nanoseconds since the Unix epoch; empty if there are no stamps.
  const std::vector<std::int64_t>& stamps_ns() const { return stamps_ns_; }

  // Columns of the poses from `first` on, `count` of them, of at least one.
  ColumnFields Slice(std::size_t first, std::size_t count) const;

  // The name of a number in its column, where a message Pose at this index has
  // a field of this name, such as "local.x_meters".
  std::string ColumnOf(std::size_t index, const std::string& field) const;

 private:
  void CheckLengths(const FieldPath& path, Violations* violations) const;
  void CheckChoices(const FieldPath& path, Violations* violations) const;
  void CheckPerPose(std::size_t given, std::size_t per_pose, bool may_be_one,
                    const FieldPath& path, Violations* violations) const;
  void ReadTransitions(const FieldPath& path, Violations* violations);
  void ReadStamps(const FieldPath& path, Violations* violations);
  // Where the transition of a pose that has one begins in its column.
  std::size_t TransitionBegin(std::size_t index) const {
    return (first_has_none_ ? index - 1 : index) * transition_;
  }

  const ColumnFields fields_;
  // Numbers in a covariance of this form, and on its diagonal; 0 for a form
  // that nobody understands.
  const std::size_t values_;
  const std::size_t diagonal_;
  bool has_one_covariance_ = false;
  // Numbers of a transition; 0 if there are none.
  std::size_t transition_ = 0;
  // Whether the first pose has no transition.
  bool first_has_none_ = false;
  std::vector<std::int64_t> stamps_ns_;

  // The fields of the last pose point to these.
  google::protobuf::Timestamp stamp_;
  std::array<double, 36> covariance_{};
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_FIELDS_POSE_COLUMNS_H_
