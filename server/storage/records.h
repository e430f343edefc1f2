// The records that a storage keeps (storage.h).
#ifndef REVISIT_SERVER_STORAGE_RECORDS_H_
#define REVISIT_SERVER_STORAGE_RECORDS_H_

#include <cstdint>
#include <functional>
#include <limits>
#include <optional>
#include <string>
#include <vector>

#include "absl/status/status.h"

namespace revisit::server {

// Version of the tables and of how payloads are written. A field that is added
// and may be ignored needs no new version: older servers do so, newer ones take
// its absence for its default.
inline constexpr int kStoreFormat = 9;
// The oldest that is read, and brought to this one: that of release 0.1.0.
inline constexpr int kOldestStoreFormat = 4;

// The greatest sequence and revision that a storage can hold.
inline constexpr std::uint64_t kLastSequence =
    std::uint64_t{std::numeric_limits<std::int64_t>::max()};

// Key of a vehicle's rows; never used again after the vehicle is deleted.
using VehicleKey = std::int64_t;

// How far the stored checks of a vehicle have come.
struct ChecksHead {
  // Whether checks are stored: those of poses after `checked_sequence` are
  // owed.
  bool stores = false;
  // No check is owed at this pose or one before it.
  std::uint64_t checked_sequence = 0;
  // Number of the vehicle's last event; 0 if it has had none.
  std::uint64_t last_event = 0;
};

inline bool operator==(const ChecksHead& a, const ChecksHead& b) {
  return a.stores == b.stores && a.checked_sequence == b.checked_sequence &&
         a.last_event == b.last_event;
}
inline bool operator!=(const ChecksHead& a, const ChecksHead& b) {
  return !(a == b);
}

struct VehicleRecord {
  VehicleKey key = 0;  // Given by the storage.
  std::string id;
  std::string payload;
  // Highest revision of any change to the vehicle.
  std::uint64_t revision = 0;
  // Highest sequence stored; 0 if none.
  std::uint64_t durable_sequence = 0;
  std::int64_t loop_closure_count = 0;
  std::int64_t rejected_candidate_count = 0;
  ChecksHead checks = {};
  // How often the vehicle was taken (TakeVehicle()); 0 where one server has the
  // storage alone, and in answers of other calls.
  std::int64_t epoch = 0;
  // The epoch under which this server had the vehicle right before it took it
  // now; 0 if it did not, and where the epoch is.
  std::int64_t previous_epoch = 0;
  // DATA_LOSS if the row or the last batch is damaged. If the row is, only key
  // and id are set, and the payload is empty. If the last batch is, the highest
  // sequence is the one its row claims, and the revision does not count it.
  absl::Status damage = absl::OkStatus();
};

struct BatchRecord {
  std::uint64_t first_sequence = 0;
  std::uint32_t count = 0;
  std::uint64_t revision = 0;
  std::string payload;
};

// A batch as it was sent, and as it was revised, if it was.
struct BatchVersions {
  BatchRecord as_sent;
  std::optional<BatchRecord> revised = std::nullopt;
};

// Passes on batches, one after the other, until `take` refuses; returns its own
// failure or that of `take`. May be called again.
using BatchSource = std::function<absl::Status(
    const std::function<absl::Status(const BatchRecord&)>& take)>;

// A verifier's finding about two poses. Ids are unique among the pairs of one
// kind of one vehicle.
enum class PairKind { kLoopClosure, kRejectedCandidate };
inline constexpr PairKind kPairKinds[] = {PairKind::kLoopClosure,
                                          PairKind::kRejectedCandidate};

// The number that stands for a kind in rows.
constexpr std::int64_t NumberOf(PairKind kind) {
  return kind == PairKind::kLoopClosure ? 1 : 2;
}

struct PosePairRecord {
  std::string id;
  std::uint64_t query_sequence = 0;
  std::uint64_t matched_sequence = 0;
  std::int64_t create_time_ns = 0;  // Since the Unix epoch.
  // The rest of the verifier's report; empty if nothing.
  std::string payload = std::string();
  // DATA_LOSS if the row is damaged: then only the id is set.
  absl::Status damage = absl::OkStatus();
};

// The words for a kind in messages, fields and error reasons.
struct PairWords {
  const char* noun;
  const char* field;
  // In resource names.
  const char* collection;
  // The parts of its payload.
  const char* content;
  const char* exists;
  const char* not_found;
};

constexpr PairWords WordsOf(PairKind kind) {
  return kind == PairKind::kLoopClosure
             ? PairWords{"loop closure",        "loop_closure",
                         "loopClosures",        "measurement, note or score",
                         "LOOP_CLOSURE_EXISTS", "LOOP_CLOSURE_NOT_FOUND"}
             : PairWords{
                   "rejected candidate",        "rejected_candidate",
                   "rejectedCandidates",        "note",
                   "REJECTED_CANDIDATE_EXISTS", "REJECTED_CANDIDATE_NOT_FOUND"};
}

// Pairs that were deleted, of which a storage keeps the last of each vehicle.
inline constexpr int kMostDeletedPairs = 1000;

struct DeletedPairRecord {
  // Grows with each deletion of the vehicle, from 1 on. Given by the storage.
  std::uint64_t number = 0;
  PairKind kind = PairKind::kLoopClosure;
  // The pair as it was, with the payload that it has from then on. DATA_LOSS is
  // its `damage` if the row is damaged: then only the number is set.
  PosePairRecord pair;
  std::int64_t delete_time_ns = 0;  // Since the Unix epoch.
};

// A check that is stored: what was found at a pose, and what has become of it.
struct CheckRecord {
  // The pose of the check; a vehicle has one check a pose at most.
  std::uint64_t sequence = 0;
  // The vehicle's when it was made.
  std::uint64_t revision = 0;
  // Candidates that nobody has decided on yet.
  std::uint32_t open_count = 0;
  std::int64_t create_time_ns = 0;  // Since the Unix epoch.
  std::string payload;
  // DATA_LOSS if the row is damaged: then only the sequence is set.
  absl::Status damage = absl::OkStatus();
};

// Where an event stands among those of all vehicles. Positions are compared as
// (order, key, number). The default one is that before all events.
struct EventPosition {
  // Grows from one write to the next, with gaps, as far as these did not run at
  // the same time; given by the storage.
  std::uint64_t order = 0;
  VehicleKey key = 0;
  std::uint64_t number = 0;
  // The checksum of the event that stands there.
  std::int64_t checksum = 0;
};

inline bool operator==(const EventPosition& a, const EventPosition& b) {
  return a.order == b.order && a.key == b.key && a.number == b.number &&
         a.checksum == b.checksum;
}

// A change of a candidate that is stored, or the end of a vehicle that had any.
struct EventRecord {
  // Number among those of its vehicle: 1, 2, 3, ... without gaps.
  std::uint64_t number = 0;
  std::int64_t time_ns = 0;  // Since the Unix epoch.
  // Empty once the vehicle is deleted, but for the event that tells it.
  std::string payload;
  // Given by the storage.
  EventPosition position = {};
  // DATA_LOSS if the row is damaged: then only position and number are set.
  absl::Status damage = absl::OkStatus();
};

// One step of a vehicle's checks.
struct ChecksWrite {
  // The head that the store has to hold until then, and that from then on.
  // REQUIRES: after.last_event is before.last_event plus the count of events.
  ChecksHead before;
  ChecksHead after;
  // Each takes the place of the one of its sequence, if there is one.
  std::vector<CheckRecord> checks = {};
  // Sequences of checks that go.
  std::vector<std::uint64_t> removed = {};
  // Given the numbers behind before.last_event. REQUIRES: payloads that are not
  // empty.
  std::vector<EventRecord> events = {};
};

// A graph that the poses of a vehicle make, as bytes that the storage does not
// interpret: the first `part_count` of the parts that are kept, and a payload.
struct SnapshotRecord {
  // The last pose that it comes from.
  std::uint64_t last_sequence = 0;
  std::uint32_t part_count = 0;
  std::string payload;
};

// Called once with the outcome of a write, on a thread that writes, which is
// the same for all writes of a vehicle: return soon, and do not block on the
// storage.
using WriteDone = std::function<void(absl::Status)>;

// A batch keeps the poses that were first sent, even if they were revised.
enum class BatchVersion { kAsSent, kCurrent };

}  // namespace revisit::server

#endif  // REVISIT_SERVER_STORAGE_RECORDS_H_
