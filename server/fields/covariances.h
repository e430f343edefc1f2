// Covariances and error transitions, in the layouts of messages.
#ifndef REVISIT_SERVER_FIELDS_COVARIANCES_H_
#define REVISIT_SERVER_FIELDS_COVARIANCES_H_

#include <cstddef>

#include "core/geometry/pose.h"
#include "core/settings.h"
#include "google/protobuf/repeated_field.h"
#include "server/fields/field_violations.h"
#include "server/fields/pose_fields.h"

namespace revisit::server {

// How many rows the matrix has whose upper triangle, or all of which, a form
// has; 0 for a form that nobody understands.
std::size_t RowsOf(CovarianceForm form);

// The covariance reduced to the state. Checks layout, size, finiteness and, for
// ROS_36, symmetry; not whether it is positive definite.
void DecodeCovariance(const CovarianceFields& fields, core::StateSpace space,
                      const FieldPath& path, core::Covariance* covariance,
                      Violations* violations);

// The reason of a violation.
const char* ReasonOf(core::DefectKind kind);

// Adds a violation unless the covariance is positive definite, with standard
// deviations within bounds.
void CheckPositiveDefinite(const core::Covariance& covariance,
                           core::StateSpace space, const FieldPath& path,
                           Violations* violations);

// Where the entry of this row and column of a transition, row-major over the
// state, lies in core::ErrorTransition::values.
std::size_t TransitionIndex(core::StateSpace space, int row, int column);

// Row-major over the state.
void EncodeTransition(const core::ErrorTransition& transition,
                      core::StateSpace space,
                      google::protobuf::RepeatedField<double>* values);

}  // namespace revisit::server

#endif  // REVISIT_SERVER_FIELDS_COVARIANCES_H_
