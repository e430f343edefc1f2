// Appends of one vehicle, from their coming to their last callback.
#ifndef REVISIT_SERVER_SESSIONS_APPENDS_H_
#define REVISIT_SERVER_SESSIONS_APPENDS_H_

#include <atomic>
#include <cstddef>
#include <cstdint>
#include <deque>
#include <memory>
#include <utility>
#include <vector>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "core/base/mutex.h"
#include "core/drive/drive.h"
#include "core/geometry/pose.h"
#include "server/sessions/append_request.h"
#include "server/sessions/appends_in_flight.h"
#include "server/sessions/pose_dropper.h"
#include "server/sessions/stored_checks.h"
#include "server/sessions/vehicle_queue.h"
#include "server/sessions/vehicle_state.h"

namespace revisit::server {

// A batch is decoded and checked whole, staged, written by the storage, and,
// once durable, applied and acknowledged; then the checks that fell due run.
// Appends may be in flight one behind the other. Belongs to the strand, but for
// Submit() and Arrive().
class Appends {
 public:
  // At most `max_pending` appends wait or are in flight.
  Appends(VehicleState* vehicle, VehicleQueue* queue,
          AppendsInFlight* in_flight, PoseDropper* dropper,
          StoredChecks* checks, int max_pending)
      : vehicle_(vehicle),
        queue_(queue),
        in_flight_(in_flight),
        dropper_(dropper),
        checks_(checks),
        max_pending_(max_pending) {}

  // See VehicleSession::Append(). From any thread; stages the batch before it
  // returns if nothing stands in its way, so that the caller's thread does what
  // it would else have woken another for.
  void Submit(AppendRequest request, std::shared_ptr<AppendObserver> observer);

 private:
  struct Pending;
  using PendingPtr = std::shared_ptr<Pending>;
  struct Checks;
  using ChecksPtr = std::shared_ptr<Checks>;

  // Whether an append was taken on, or when it can be.
  enum class Taken {
    kYes,
    // Once all that is in flight has landed.
    kWhenIdle,
    // On a thread that may wait for the storage.
    kWhereReadsMayBlock,
  };

  void Refuse(std::shared_ptr<AppendObserver> observer);
  // `may_block`: whether this thread may wait for the storage.
  void Run(const PendingPtr& append, const absl::Status& status,
           bool may_block);
  absl::StatusOr<Taken> TakeOn(const PendingPtr& append, bool may_block);
  // Does what TakeOn() does for an append that begins with poses which came
  // before.
  absl::StatusOr<Taken> TakeOnKnown(const PendingPtr& append, bool may_block);
  absl::StatusOr<Taken> TakeOnNew(const PendingPtr& append);
  // Has an append that writes nothing answered, behind those before it.
  void Conclude(const PendingPtr& append, const absl::Status& result);
  absl::Status SequenceGap(std::uint64_t first) const;
  absl::Status Decode(Pending* append);
  absl::Status CheckRecordings(const DecodedBatch& batch) const;
  absl::Status TakeOrigin(const DecodedBatch& batch);
  absl::Status CompareWithStored(const DecodedBatch& batch, std::uint64_t first,
                                 std::uint64_t last) const;
  // The fingerprints of a stored batch; none if its poses were dropped.
  absl::StatusOr<std::vector<std::uint64_t>> StoredFingerprints(
      const BatchRecord& record) const;
  absl::Status KeepFrom(std::size_t first, DecodedBatch* batch) const;
  void Write(const PendingPtr& append);
  // The rows of a batch, whose payload is used up.
  std::vector<BatchRecord> RowsOf(DecodedBatch* batch);
  // Keeps the result of a write, on the storage's thread, until TakeArrived().
  void Arrive(const PendingPtr& append, const absl::Status& result);
  // Takes the results that have arrived by now.
  void TakeArrived();
  void AnswerInOrder();
  // The same in a task of its own.
  void AnswerLater();
  // Returns whether nothing more comes of the append, rather than its checks.
  bool Land(const PendingPtr& append);
  absl::Status ResultOf(const Pending& append);
  std::vector<core::NodeIndex> Apply(Pending* append);
  // The poses with which nodes came.
  std::vector<std::uint64_t> PosesOf(
      const std::vector<core::NodeIndex>& nodes) const;
  // The first stamp that is too far ahead, unless those of the last batch with
  // stamps were too.
  std::optional<StampAhead> FindAhead(
      const std::vector<core::PoseSample>& samples);
  void RunChecks(const PendingPtr& append, std::vector<core::NodeIndex> due);
  // Takes a turn of a search; the next one is a task of its own.
  void CheckOn(const ChecksPtr& checks);
  void Answer(const Pending& append, const absl::Status& status);

  VehicleState* const vehicle_;
  VehicleQueue* const queue_;
  AppendsInFlight* const in_flight_;
  PoseDropper* const dropper_;
  StoredChecks* const checks_;
  const int max_pending_;
  std::atomic<int> pending_{0};

  Mutex arrived_mutex_;
  // If there are any, a task of the strand is on its way to take them.
  std::vector<std::pair<PendingPtr, absl::Status>> arrived_
      ABSL_GUARDED_BY(arrived_mutex_);

  // The appends in flight, oldest first.
  std::deque<PendingPtr> unanswered_;
  // Whether the last batch with stamps had one too far ahead.
  bool was_ahead_ = false;
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_SESSIONS_APPENDS_H_
