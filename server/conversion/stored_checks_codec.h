// Stored checks and their events: as bytes in the store, and as messages.
#ifndef REVISIT_SERVER_CONVERSION_STORED_CHECKS_CODEC_H_
#define REVISIT_SERVER_CONVERSION_STORED_CHECKS_CODEC_H_

#include <cstddef>
#include <cstdint>
#include <functional>
#include <set>
#include <string>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "revisit/v1/check.pb.h"
#include "revisit/v1/pose_graph_service.pb.h"
#include "server/fields/field_violations.h"
#include "server/sessions/check_codec.h"
#include "server/storage/records.h"

namespace revisit::server {

class ProtoCheckCodec final : public CheckCodec {
 public:
  std::string EncodeFound(const VehicleView& view,
                          const core::CandidateSet& set,
                          std::chrono::nanoseconds duration,
                          const CheckScope* scope) const override;
  std::string EncodeCheck(const StoredCheck& check) const override;
  absl::StatusOr<StoredCheck> DecodeCheck(
      const std::string& payload) const override;
  std::string EncodeEvent(const EventOrigin& origin,
                          std::uint64_t check_sequence,
                          const StoredCheck& check,
                          std::size_t index) const override;
  std::string EncodeFarewell(const EventOrigin& origin) const override;
};

// Whether a caller may read a vehicle.
using MayReadVehicle = std::function<bool(const std::string& vehicle_id)>;

// A check of a vehicle as it is stored, without what names another vehicle that
// the caller may not read: without states if that is all that it has. DATA_LOSS
// (STORE_CORRUPT) if it is damaged.
absl::Status EncodeCheck(const std::string& vehicle_id,
                         const CheckRecord& record,
                         const MayReadVehicle& may_read, v1::Check* message);

// An event as it is stored, without its cursor. Sets the id of the other
// vehicle that it is about, if it is about one. DATA_LOSS (STORE_CORRUPT) if
// its payload is not that of an event.
absl::Status EncodeEvent(const EventRecord& record,
                         v1::WatchCandidatesResponse* message,
                         std::string* matched_vehicle_id);

// Which candidates a caller wants.
struct CandidateFilter {
  // Ids; empty: any.
  std::set<std::string> vehicles;
  std::set<v1::CandidateState> states;
  std::set<v1::Verdict> verdicts;
  double least_probability = 0.0;
  double least_value = 0.0;
};
// INVALID_ARGUMENT if the message is none.
absl::StatusOr<CandidateFilter> DecodeFilter(const v1::CandidateFilter& message,
                                             const FieldPath& path);
// Whether a candidate with this evidence is wanted: all but its vehicle.
bool Matches(const CandidateFilter& filter, const v1::CheckCandidate& candidate,
             const v1::Candidate& evidence);
// Whether a candidate of the check is, by the evidence that was found last.
bool Matches(const CandidateFilter& filter, const v1::Check& check,
             const v1::CheckCandidate& candidate);
// Whether any candidate of the check is wanted.
bool Matches(const CandidateFilter& filter, const v1::Check& check);

// Cursors are sealed as page tokens are (page_token.h).
std::string MakeCursor(const EventPosition& position);
// INVALID_ARGUMENT (INVALID_CURSOR) if no server made it.
absl::StatusOr<EventPosition> ParseCursor(const std::string& cursor,
                                          const FieldPath& path);

}  // namespace revisit::server

#endif  // REVISIT_SERVER_CONVERSION_STORED_CHECKS_CODEC_H_
