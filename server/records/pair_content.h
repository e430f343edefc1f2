// The content of a loop closure or a rejected candidate beside the columns of
// its row: the payload of its record (revisit.stored.PosePairContent).
#ifndef REVISIT_SERVER_RECORDS_PAIR_CONTENT_H_
#define REVISIT_SERVER_RECORDS_PAIR_CONTENT_H_

#include <functional>
#include <optional>
#include <string>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "core/drive/measured_loop.h"
#include "core/settings.h"
#include "server/fields/pose_fields.h"

namespace revisit::server {

struct PairContent {
  // Only loop closures have one.
  std::optional<MeasurementFields> measurement;
  std::string note;
  // Only loop closures have one.
  std::optional<double> score;
  // The caller who decided (Caller::identity); empty if that is not known.
  std::string decided_by;
  // The caller who deleted it, likewise. Only deleted ones have one.
  std::string deleted_by;
};

// Empty if there is no content.
std::string EncodePairContent(const PairContent& content);

// Calls `read` with the content, which is valid during the call. DATA_LOSS if
// the payload is not that of a pair.
absl::Status ReadPairContent(
    const std::string& payload,
    const std::function<void(const PairContent&)>& read);

// Implements RecordCodec::SayTheSame().
bool PairContentsSayTheSame(const std::string& payload,
                            const std::string& other);

// Implements RecordCodec::WithDeleter().
std::string PairContentWithDeleter(const std::string& payload,
                                   const std::string& deleted_by);

// Implements RecordCodec::DecodeMeasurement().
absl::StatusOr<std::optional<core::LoopMeasurement>> DecodePairMeasurement(
    const std::string& payload, core::StateSpace space);

}  // namespace revisit::server

#endif  // REVISIT_SERVER_RECORDS_PAIR_CONTENT_H_
