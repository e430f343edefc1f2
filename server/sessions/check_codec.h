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
#include "server/sessions/check_scopes.h"
#include "server/sessions/vehicle_view.h"

namespace revisit::server {

enum class CandidateState { kOpen, kConfirmed, kRejected, kWithdrawn };
enum class CandidateCause {
  kCheck,
  kLoopClosure,
  kRejection,
  kDeletion,
  kRetention,
  kSearch,
  kContradiction
};

// A candidate of a stored check, and what has become of it.
struct StoredCandidate {
  // From 1 on, in the order of rank, then in that in which later searches found
  // more.
  std::uint32_t number = 0;
  // core::Candidate::rank in the set that was found first, and in the latest
  // one; 0 where it is not in there.
  int rank = 0;
  int latest_rank = 0;
  // The pose with which the matched node came.
  std::uint64_t matched_sequence = 0;
  // Id and uid of the vehicle of this pose, where it is another one than that
  // which is checked; else empty.
  std::string matched_vehicle = std::string();
  std::string matched_uid = std::string();
  // Where it is: the poses of that vehicle that lay within
  // core::kPlaceRadiusMeters of this one, along its path, when it was found;
  // and the id of the group in which it was found.
  std::uint64_t place_first = 0;
  std::uint64_t place_last = 0;
  std::string group = std::string();
  CandidateState state = CandidateState::kOpen;
  CandidateCause cause = CandidateCause::kCheck;
  // Caller::identity of who caused it; empty if no caller did.
  std::string actor = std::string();
  std::int64_t update_time_ns = 0;  // Since the Unix epoch.
  // The id of the pair that decided, or of the loop closure between vehicles in
  // `group`; empty unless one did.
  std::string decision = std::string();
  // The number of the last event about it.
  std::uint64_t event_number = 0;
  // By the last search; 0 where that did not find it.
  double probability = 0.0;
  // The probability times core::VarianceReductions::Of(), m^2, of one that is
  // open.
  double value = 0.0;
  // The id of the closure that was found to contradict others, so that it is
  // asked about once; empty if none was.
  std::string contradicted = std::string();

  // Whether both places are in the history of the vehicle that is checked.
  bool is_own() const { return matched_vehicle.empty(); }
};

struct StoredCheck {
  std::string vehicle_uid;
  // The whole answer of the first search, as bytes, and that of the last one,
  // empty where there was no second.
  std::string found;
  std::string latest = std::string();
  // CheckBasis::Of() at the last search.
  std::uint64_t basis = 0;
  // It is to be searched again.
  bool stale = false;
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
  // `scope`: null for the vehicle's own history alone. REQUIRES: the set was
  // found in this view and scope.
  virtual std::string EncodeFound(const VehicleView& view,
                                  const core::CandidateSet& set,
                                  std::chrono::nanoseconds duration,
                                  const CheckScope* scope) const = 0;
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
