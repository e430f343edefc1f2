// Where recordings begin, of messages as of core.
#ifndef REVISIT_SERVER_FIELDS_RECORDING_STARTS_H_
#define REVISIT_SERVER_FIELDS_RECORDING_STARTS_H_

#include <cstddef>
#include <memory>

#include "core/geometry/recording_start.h"
#include "core/geometry/state_space.h"
#include "server/fields/field_violations.h"
#include "server/fields/pose_fields.h"

namespace revisit::server {

inline constexpr std::size_t kMaxRecordingLabelBytes = 256;
inline constexpr std::size_t kMaxDatumIdBytes = 128;

// Whether texts are judged: stored ones were, when they came.
enum class TextCheck { kAll, kNone };

// Null, with a violation for each defect, where there are any. Where it brings
// no relation, it begins after the recording before, over UsualGap(). `path`
// is the field of the start.
std::shared_ptr<const core::RecordingStart> DecodeRecordingStart(
    const RecordingStartFields& fields, core::StateSpace space, TextCheck texts,
    const FieldPath& path, Violations* violations);

}  // namespace revisit::server

#endif  // REVISIT_SERVER_FIELDS_RECORDING_STARTS_H_
