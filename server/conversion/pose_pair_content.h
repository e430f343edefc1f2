// The content of a loop closure or a rejected candidate beside its two poses:
// as it is sent, as it is stored (revisit.stored.PosePairContent), and, for
// measurements, as core takes it.
#ifndef REVISIT_SERVER_CONVERSION_POSE_PAIR_CONTENT_H_
#define REVISIT_SERVER_CONVERSION_POSE_PAIR_CONTENT_H_

#include <cstddef>
#include <optional>
#include <string>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "core/drive/measured_loop.h"
#include "core/geometry/pose.h"
#include "revisit/v1/loop_closure.pb.h"
#include "server/conversion/field_violations.h"

namespace revisit::server {

inline constexpr std::size_t kMaxNoteBytes = 1024;
inline constexpr double kMaxMeasuredMeters = 10'000.0;

// The payload; empty if there is nothing but poses. Adds a violation for all
// that is wrong whatever the vehicle's state space is.
std::string EncodeContent(const v1::LoopClosure& closure, const FieldPath& path,
                          Violations* violations);
std::string EncodeContent(const v1::RejectedCandidate& rejection,
                          const FieldPath& path, Violations* violations);

// Sets the fields of the message that the payload holds, which may be empty.
// DATA_LOSS if the payload is not that of a pair.
absl::Status DecodeContent(const std::string& payload,
                           v1::LoopClosure* closure);
absl::Status DecodeContent(const std::string& payload,
                           v1::RejectedCandidate* rejection);

// Implements RecordCodec::DecodeMeasurement().
absl::StatusOr<std::optional<core::LoopMeasurement>> DecodeMeasurement(
    const std::string& payload, core::StateSpace space);

}  // namespace revisit::server

#endif  // REVISIT_SERVER_CONVERSION_POSE_PAIR_CONTENT_H_
