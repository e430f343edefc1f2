#include "server/fields/recording_starts.h"

#include "absl/strings/str_cat.h"
#include "server/fields/covariances.h"

namespace revisit::server {
namespace {

using Relation = RecordingStartFields::Relation;

void DecodeDatumPose(const RecordingStartFields& fields, const FieldPath& path,
                     core::Pose* pose, Violations* violations) {
  if (!fields.datum_pose) return;
  const auto check = [&](double value, const char* field, double limit) {
    CheckRange(value, -limit, limit, path.Field(field), violations);
  };
  const auto& [x, y, z, heading] = *fields.datum_pose;
  check(x, "x_meters", core::kMaxCoordinateMeters);
  check(y, "y_meters", core::kMaxCoordinateMeters);
  check(z, "z_meters", core::kMaxCoordinateMeters);
  check(heading, "heading_radians", core::kMaxHeadingRadians);
  *pose = {x, y, z, heading};
}

// A datum is no pose of an estimator, so that it has the forms of the state
// alone.
void DecodeDatumCovariance(const RecordingStartFields& fields,
                           core::StateSpace space, const FieldPath& path,
                           core::Covariance* covariance,
                           Violations* violations) {
  if (!fields.covariance) {
    violations->Add(kInvalidField, path, "required");
    return;
  }
  const bool spatial = space == core::StateSpace::kSpatial;
  const CovarianceForm form = fields.covariance->form;
  if (form != CovarianceForm::kSpatial10 &&
      (spatial || form != CovarianceForm::kPlanar6)) {
    violations->Add(
        kInvalidField, path.Field("form"),
        absl::StrCat("got ", static_cast<int>(form), "; required is ",
                     spatial ? "SPATIAL_10" : "PLANAR_6 or SPATIAL_10"));
    return;
  }
  DecodeCovariance(*fields.covariance, space, path, covariance, violations);
}

void DecodeDatum(const RecordingStartFields& fields, core::StateSpace space,
                 TextCheck texts, const FieldPath& path,
                 core::RecordingStart* start, Violations* violations) {
  start->relation = core::RecordingRelation::kDatum;
  start->datum_id = *fields.datum_id;
  if (texts == TextCheck::kAll) {
    CheckText(*fields.datum_id, kMaxDatumIdBytes, TextUse::kName,
              path.Field("datum_id"), violations);
  }
  DecodeDatumPose(fields, path.Field("pose"), &start->datum, violations);
  DecodeDatumCovariance(fields, space, path.Field("covariance"),
                        &start->covariance, violations);
}

// The values are finite and in their ranges, so that only the covariance can be
// left.
void AddDefect(const core::RecordingStart& start, core::StateSpace space,
               const FieldPath& covariance, Violations* violations) {
  if (const auto defect = core::FindDefect(start, space)) {
    violations->Add(ReasonOf(defect->kind), covariance.Field("values"),
                    defect->description);
  }
}

}  // namespace

std::shared_ptr<const core::RecordingStart> DecodeRecordingStart(
    const RecordingStartFields& fields, core::StateSpace space, TextCheck texts,
    const FieldPath& path, Violations* violations) {
  const std::size_t violations_before = violations->count();
  const auto start = std::make_shared<core::RecordingStart>();
  start->label = *fields.label;
  if (texts == TextCheck::kAll) {
    CheckText(*fields.label, kMaxRecordingLabelBytes, TextUse::kName,
              path.Field("label"), violations);
  }
  const FieldPath after = path.Field("after");
  const FieldPath datum = path.Field("datum");
  switch (fields.relation) {
    case Relation::kNone:
      start->covariance = core::UsualGap();
      break;
    case Relation::kAfter:
      DecodeCovariance(*fields.covariance, space, after, &start->covariance,
                       violations);
      break;
    case Relation::kDatum:
      DecodeDatum(fields, space, texts, datum, start.get(), violations);
      break;
    case Relation::kUnknown:
      start->relation = core::RecordingRelation::kUnknown;
      if (!fields.unknown) {
        violations->Add(kInvalidField, path.Field("unknown"),
                        "got false; allowed is true, or to leave it out");
      }
      break;
  }
  if (violations->count() == violations_before) {
    AddDefect(
        *start, space,
        fields.relation == Relation::kDatum ? datum.Field("covariance") : after,
        violations);
  }
  if (violations->count() != violations_before) return nullptr;
  return start;
}

}  // namespace revisit::server
