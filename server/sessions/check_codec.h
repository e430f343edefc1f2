// Checks that are stored and their candidates, in the server's own terms, and
// how they become bytes in the store.
#ifndef REVISIT_SERVER_SESSIONS_CHECK_CODEC_H_
#define REVISIT_SERVER_SESSIONS_CHECK_CODEC_H_

#include <chrono>
#include <cstddef>
#include <cstdint>
#include <string>
#include <vector>

#include "absl/status/statusor.h"
#include "core/search/candidates/candidate.h"
#include "server/sessions/vehicle_view.h"

namespace revisit::server {

enum class CandidateState { kOpen, kConfirmed, kRejected, kWithdrawn };
enum class CandidateCause {
  kCheck,
  kLoopClosure,
  kRejection,
  kDeletion,
  kRetention
};

// A candidate of a stored check, and what has become of it.
struct StoredCandidate {
  // From 1 on, in the order of rank.
  std::uint32_t number = 0;
  // core::Candidate::rank.
  int rank = 0;
  // The pose with which the matched node came.
  std::uint64_t matched_sequence = 0;
  CandidateState state = CandidateState::kOpen;
  CandidateCause cause = CandidateCause::kCheck;
  // Caller::identity of who caused it; empty if no caller did.
  std::string actor = std::string();
  std::int64_t update_time_ns = 0;  // Since the Unix epoch.
  // The id of the pair that decided; empty unless one did.
  std::string decision = std::string();
  // The number of the last event about it.
  std::uint64_t event_number = 0;
};

struct StoredCheck {
  std::string vehicle_uid;
  // The whole answer of the search, as bytes.
  std::string found;
  std::vector<StoredCandidate> candidates;
};

// A candidate by its name.
struct CandidateId {
  std::uint64_t check_sequence = 0;
  std::uint32_t number = 0;
};

// The vehicle that an event is about.
struct EventOrigin {
  const std::string& vehicle_id;
  const std::string& vehicle_uid;
};

// Knows the bytes. Thread-safe.
class CheckCodec {
 public:
  virtual ~CheckCodec() = default;
  // REQUIRES: the set was found in this view.
  virtual std::string EncodeFound(const VehicleView& view,
                                  const core::CandidateSet& set,
                                  std::chrono::nanoseconds duration) const = 0;
  virtual std::string EncodeCheck(const StoredCheck& check) const = 0;
  // DATA_LOSS if the payload is not that of a check.
  virtual absl::StatusOr<StoredCheck> DecodeCheck(
      const std::string& payload) const = 0;
  // Candidate `index` of the check at a pose came into its state.
  virtual std::string EncodeEvent(const EventOrigin& origin,
                                  std::uint64_t check_sequence,
                                  const StoredCheck& check,
                                  std::size_t index) const = 0;
  // The vehicle is deleted.
  virtual std::string EncodeFarewell(const EventOrigin& origin) const = 0;
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_SESSIONS_CHECK_CODEC_H_
