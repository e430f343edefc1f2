#include "server/fields/loop_measurement.h"

#include "core/geometry/pose.h"
#include "server/fields/covariances.h"

namespace revisit::server {

void CheckMeasurement(const MeasurementFields& fields, const FieldPath& path,
                      Violations* violations) {
  const auto check = [&](double value, const char* field, double limit) {
    CheckRange(value, -limit, limit, path.Field(field), violations);
  };
  check(fields.x_meters, "x_meters", kMaxMeasuredMeters);
  check(fields.y_meters, "y_meters", kMaxMeasuredMeters);
  check(fields.z_meters, "z_meters", kMaxMeasuredMeters);
  check(fields.heading_radians, "heading_radians", core::kMaxHeadingRadians);
  if (!fields.covariance) {
    violations->Add(kInvalidField, path.Field("covariance"), "required");
  }
}

absl::StatusOr<core::LoopMeasurement> DecodeMeasurement(
    const MeasurementFields& fields, core::StateSpace space,
    const FieldPath& path) {
  core::LoopMeasurement measurement;
  measurement.relative = {fields.x_meters, fields.y_meters, fields.z_meters,
                          fields.heading_radians};
  const FieldPath covariance = path.Field("covariance");
  Violations violations;
  CheckMeasurement(fields, path, &violations);
  if (fields.covariance) {
    DecodeCovariance(*fields.covariance, space, covariance,
                     &measurement.covariance, &violations);
  }
  if (violations.count() == 0) {
    CheckPositiveDefinite(measurement.covariance, space, covariance,
                          &violations);
  }
  if (violations.count() > 0) return violations.ToStatus();
  return measurement;
}

}  // namespace revisit::server
