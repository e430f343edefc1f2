// The fields of a pose, whichever message they are in: the API's or the
// store's.
#ifndef REVISIT_SERVER_FIELDS_POSE_FIELDS_H_
#define REVISIT_SERVER_FIELDS_POSE_FIELDS_H_

#include <array>
#include <cstddef>
#include <cstdint>
#include <memory>
#include <optional>
#include <string>

#include "absl/types/span.h"
#include "google/protobuf/timestamp.pb.h"

namespace revisit::server {

// The numbers are those of every message. A message may have others, which
// nobody understands.
enum class CovarianceForm : std::int32_t {
  kPlanar6 = 1,
  kSpatial10 = 2,
  kRos36 = 3,
};

// Whether an enum of messages has the numbers of CovarianceForm.
constexpr bool AreCovarianceForms(int planar_6, int spatial_10, int ros_36) {
  return planar_6 == static_cast<int>(CovarianceForm::kPlanar6) &&
         spatial_10 == static_cast<int>(CovarianceForm::kSpatial10) &&
         ros_36 == static_cast<int>(CovarianceForm::kRos36);
}

struct CovarianceFields {
  CovarianceForm form{};
  // Valid as long as the message.
  absl::Span<const double> values;
};

// Where a recording begins, as its message has it. It points into the message,
// which has to outlive it.
struct RecordingStartFields {
  enum class Relation : std::uint8_t { kNone, kAfter, kDatum, kUnknown };

  // Never null.
  const std::string* label = nullptr;
  Relation relation = Relation::kNone;
  // The covariance of kAfter, or of the datum, where that has one.
  std::optional<CovarianceFields> covariance;
  // kDatum has both: the name, and x, y, z in metres and the heading in
  // radians.
  const std::string* datum_id = nullptr;
  std::optional<std::array<double, 4>> datum_pose;
  // The value of kUnknown.
  bool unknown = false;
};

// A pose as its message has it: nothing is checked. Small numbers are copied,
// so that messages need not be; what is long or seldom there stays in the
// message, which has to outlive this.
struct PoseFields {
  enum class Position : std::uint8_t { kNone, kLocal, kGeodetic };
  enum class Orientation : std::uint8_t { kNone, kHeading, kQuaternion };

  std::uint64_t sequence = 0;
  // Null if absent.
  const google::protobuf::Timestamp* stamp = nullptr;
  Position position_kind = Position::kNone;
  Orientation orientation_kind = Orientation::kNone;
  // x, y, z in metres; or latitude and longitude in degrees, height in metres.
  std::array<double, 3> position{};
  // The heading in radians, first; or x, y, z, w.
  std::array<double, 4> orientation{};
  std::optional<CovarianceFields> covariance;
  // Empty if absent.
  absl::Span<const double> error_transition;
  // Null if absent, as it is in most poses.
  std::shared_ptr<const RecordingStartFields> recording_start;

  bool has_geodetic() const { return position_kind == Position::kGeodetic; }
};

// Covariance: a message with `form` and `values`.
template <typename Covariance>
CovarianceFields CovarianceFieldsOf(const Covariance& covariance) {
  return {static_cast<CovarianceForm>(covariance.form()), covariance.values()};
}

// A start of kDatum without a label. Datum: a message with the fields of a
// datum by their names.
template <typename Datum>
RecordingStartFields DatumFieldsOf(const Datum& datum) {
  static const auto* const no_label = new std::string();
  RecordingStartFields fields;
  fields.label = no_label;
  fields.relation = RecordingStartFields::Relation::kDatum;
  fields.datum_id = &datum.datum_id();
  if (datum.has_pose()) {
    const auto& pose = datum.pose();
    fields.datum_pose = {pose.x_meters(), pose.y_meters(), pose.z_meters(),
                         pose.heading_radians()};
  }
  if (datum.has_covariance()) {
    fields.covariance = CovarianceFieldsOf(datum.covariance());
  }
  return fields;
}

// Start: a message with the fields of a recording's start by their names.
template <typename Start>
RecordingStartFields RecordingStartFieldsOf(const Start& start) {
  using Relation = RecordingStartFields::Relation;
  RecordingStartFields fields;
  if (start.has_datum()) fields = DatumFieldsOf(start.datum());
  fields.label = &start.label();
  if (start.has_after()) {
    fields.relation = Relation::kAfter;
    fields.covariance = CovarianceFieldsOf(start.after());
  } else if (start.has_unknown()) {
    fields.relation = Relation::kUnknown;
    fields.unknown = start.unknown();
  }
  return fields;
}

// Pose: a message with the fields of a pose by their names.
template <typename Pose>
PoseFields PoseFieldsOf(const Pose& pose) {
  PoseFields fields;
  fields.sequence = pose.sequence();
  if (pose.has_stamp()) fields.stamp = &pose.stamp();
  if (pose.has_local()) {
    const auto& local = pose.local();
    fields.position_kind = PoseFields::Position::kLocal;
    fields.position = {local.x_meters(), local.y_meters(), local.z_meters()};
  } else if (pose.has_geodetic()) {
    const auto& geodetic = pose.geodetic();
    fields.position_kind = PoseFields::Position::kGeodetic;
    fields.position = {geodetic.latitude_degrees(),
                       geodetic.longitude_degrees(), geodetic.height_meters()};
  }
  if (pose.has_quaternion()) {
    const auto& quaternion = pose.quaternion();
    fields.orientation_kind = PoseFields::Orientation::kQuaternion;
    fields.orientation = {quaternion.x(), quaternion.y(), quaternion.z(),
                          quaternion.w()};
  } else if (pose.has_heading_radians()) {
    fields.orientation_kind = PoseFields::Orientation::kHeading;
    fields.orientation[0] = pose.heading_radians();
  }
  if (pose.has_covariance()) {
    fields.covariance = CovarianceFieldsOf(pose.covariance());
  }
  fields.error_transition = pose.error_transition();
  if (pose.has_recording_start()) {
    fields.recording_start = std::make_shared<const RecordingStartFields>(
        RecordingStartFieldsOf(pose.recording_start()));
  }
  return fields;
}

// The fields of each of these messages by its index, for DecodePoses().
template <typename Poses>
auto FieldsOfEach(const Poses& poses) {
  return [&poses](std::size_t i) {
    return PoseFieldsOf(poses[static_cast<int>(i)]);
  };
}

// The measurement between the two poses of a loop closure, as its message has
// it.
struct MeasurementFields {
  double x_meters = 0.0;
  double y_meters = 0.0;
  double z_meters = 0.0;
  double heading_radians = 0.0;
  std::optional<CovarianceFields> covariance;
};

template <typename Measurement>
MeasurementFields MeasurementFieldsOf(const Measurement& measurement) {
  MeasurementFields fields;
  fields.x_meters = measurement.x_meters();
  fields.y_meters = measurement.y_meters();
  fields.z_meters = measurement.z_meters();
  fields.heading_radians = measurement.heading_radians();
  if (measurement.has_covariance()) {
    fields.covariance = CovarianceFieldsOf(measurement.covariance());
  }
  return fields;
}

// ---- Back into messages. What is absent is cleared, so that one message can
// serve for many poses.

template <typename Covariance>
void SetCovariance(const CovarianceFields& fields, Covariance* covariance) {
  using Form = decltype(covariance->form());
  covariance->set_form(static_cast<Form>(fields.form));
  covariance->mutable_values()->Assign(fields.values.begin(),
                                       fields.values.end());
}

// Sets position, orientation and covariance: what a pose estimates.
template <typename Pose>
void SetEstimate(const PoseFields& fields, Pose* pose) {
  switch (fields.position_kind) {
    case PoseFields::Position::kNone:
      pose->clear_position();
      break;
    case PoseFields::Position::kLocal: {
      auto* const local = pose->mutable_local();
      local->set_x_meters(fields.position[0]);
      local->set_y_meters(fields.position[1]);
      local->set_z_meters(fields.position[2]);
      break;
    }
    case PoseFields::Position::kGeodetic: {
      auto* const geodetic = pose->mutable_geodetic();
      geodetic->set_latitude_degrees(fields.position[0]);
      geodetic->set_longitude_degrees(fields.position[1]);
      geodetic->set_height_meters(fields.position[2]);
      break;
    }
  }
  switch (fields.orientation_kind) {
    case PoseFields::Orientation::kNone:
      pose->clear_orientation();
      break;
    case PoseFields::Orientation::kHeading:
      pose->set_heading_radians(fields.orientation[0]);
      break;
    case PoseFields::Orientation::kQuaternion: {
      auto* const quaternion = pose->mutable_quaternion();
      quaternion->set_x(fields.orientation[0]);
      quaternion->set_y(fields.orientation[1]);
      quaternion->set_z(fields.orientation[2]);
      quaternion->set_w(fields.orientation[3]);
      break;
    }
  }
  if (fields.covariance) {
    SetCovariance(*fields.covariance, pose->mutable_covariance());
  } else {
    pose->clear_covariance();
  }
}

// `fields` are of kDatum.
template <typename Datum>
void SetDatum(const RecordingStartFields& fields, Datum* datum) {
  datum->set_datum_id(*fields.datum_id);
  if (fields.datum_pose) {
    auto* const pose = datum->mutable_pose();
    pose->set_x_meters((*fields.datum_pose)[0]);
    pose->set_y_meters((*fields.datum_pose)[1]);
    pose->set_z_meters((*fields.datum_pose)[2]);
    pose->set_heading_radians((*fields.datum_pose)[3]);
  }
  if (fields.covariance) {
    SetCovariance(*fields.covariance, datum->mutable_covariance());
  }
}

template <typename Start>
void SetRecordingStart(const RecordingStartFields& fields, Start* start) {
  start->Clear();
  start->set_label(*fields.label);
  switch (fields.relation) {
    case RecordingStartFields::Relation::kNone:
      break;
    case RecordingStartFields::Relation::kAfter:
      SetCovariance(*fields.covariance, start->mutable_after());
      break;
    case RecordingStartFields::Relation::kDatum:
      SetDatum(fields, start->mutable_datum());
      break;
    case RecordingStartFields::Relation::kUnknown:
      start->set_unknown(fields.unknown);
      break;
  }
}

template <typename Pose>
void SetPose(const PoseFields& fields, Pose* pose) {
  pose->set_sequence(fields.sequence);
  if (fields.stamp != nullptr) {
    pose->mutable_stamp()->set_seconds(fields.stamp->seconds());
    pose->mutable_stamp()->set_nanos(fields.stamp->nanos());
  } else {
    pose->clear_stamp();
  }
  SetEstimate(fields, pose);
  pose->mutable_error_transition()->Assign(fields.error_transition.begin(),
                                           fields.error_transition.end());
  if (fields.recording_start) {
    SetRecordingStart(*fields.recording_start, pose->mutable_recording_start());
  } else {
    pose->clear_recording_start();
  }
}

template <typename Measurement>
void SetMeasurement(const MeasurementFields& fields, Measurement* measurement) {
  measurement->set_x_meters(fields.x_meters);
  measurement->set_y_meters(fields.y_meters);
  measurement->set_z_meters(fields.z_meters);
  measurement->set_heading_radians(fields.heading_radians);
  if (fields.covariance) {
    SetCovariance(*fields.covariance, measurement->mutable_covariance());
  }
}

}  // namespace revisit::server

#endif  // REVISIT_SERVER_FIELDS_POSE_FIELDS_H_
