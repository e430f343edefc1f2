// The measurement that a verifier made between the two poses of a loop closure.
#ifndef REVISIT_SERVER_FIELDS_LOOP_MEASUREMENT_H_
#define REVISIT_SERVER_FIELDS_LOOP_MEASUREMENT_H_

#include "absl/status/statusor.h"
#include "core/drive/measured_loop.h"
#include "core/settings.h"
#include "server/fields/field_violations.h"
#include "server/fields/pose_fields.h"

namespace revisit::server {

inline constexpr double kMaxMeasuredMeters = 10'000.0;

// Adds a violation for all that is wrong whatever the vehicle's state space is.
void CheckMeasurement(const MeasurementFields& fields, const FieldPath& path,
                      Violations* violations);

// INVALID_ARGUMENT if it is none for a vehicle of this state space.
absl::StatusOr<core::LoopMeasurement> DecodeMeasurement(
    const MeasurementFields& fields, core::StateSpace space,
    const FieldPath& path);

}  // namespace revisit::server

#endif  // REVISIT_SERVER_FIELDS_LOOP_MEASUREMENT_H_
