// Stored checks and events as bytes (revisit.stored.Check and Event).
#ifndef REVISIT_SERVER_RECORDS_CHECK_RECORDS_H_
#define REVISIT_SERVER_RECORDS_CHECK_RECORDS_H_

#include <cstdint>
#include <optional>
#include <string>

#include "absl/status/statusor.h"
#include "server/sessions/check_codec.h"

namespace revisit::server {

// A change of a candidate, or the end of a vehicle.
struct StoredEvent {
  std::string vehicle_id;
  std::string vehicle_uid;
  // Nothing where the vehicle was deleted.
  std::optional<StoredCandidate> candidate = std::nullopt;
  // The pose of the candidate's check, and the revision at which it was made.
  std::uint64_t check_sequence = 0;
  std::uint64_t revision = 0;
  // The evidence of the candidate, as bytes.
  std::string evidence = std::string();
};

// The payload of a check; DATA_LOSS (STORE_CORRUPT) if it is decoded and is
// none.
std::string EncodeCheckRecord(const StoredCheck& check);
absl::StatusOr<StoredCheck> DecodeCheckRecord(const std::string& payload);
// The payload of an event, likewise.
std::string EncodeEventRecord(const StoredEvent& event);
absl::StatusOr<StoredEvent> DecodeEventRecord(const std::string& payload);

}  // namespace revisit::server

#endif  // REVISIT_SERVER_RECORDS_CHECK_RECORDS_H_
