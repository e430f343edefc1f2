// Everything that changes a vehicle, but for appends. The session calls each
// while no append is in flight; nothing but reads starts until it has answered.
#ifndef REVISIT_SERVER_SESSIONS_CHANGES_H_
#define REVISIT_SERVER_SESSIONS_CHANGES_H_

#include <cstddef>
#include <cstdint>
#include <functional>
#include <memory>
#include <optional>
#include <string>
#include <utility>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "core/drive/agreement.h"
#include "core/drive/measured_loop.h"
#include "server/sessions/check_codec.h"
#include "server/sessions/replay.h"
#include "server/sessions/stored_checks.h"
#include "server/sessions/vehicle_queue.h"
#include "server/sessions/vehicle_state.h"
#include "server/sessions/vehicle_view.h"
#include "server/storage/records.h"

namespace revisit::server {

// A pair's creation time is moved behind the latest by at most an hour.
inline constexpr std::int64_t kMostClockError = 3'600'000'000'000;  // ns.

// Which poses a revision replaces.
struct RevisionPlan {
  // Batches with new payloads: first sequence and count as stored. None where
  // nothing changes.
  BatchSource batches;
  std::int64_t revised_count = 0;
  // Poses that were named but were dropped.
  std::int64_t dropped_count = 0;
  // The revision that has done the same before, if there is one: it is answered
  // again, and nothing is replaced.
  std::optional<std::uint64_t> done_by;
};

using ConfigChange =
    std::function<absl::StatusOr<VehicleConfig>(const VehicleView&)>;
using RevisionPlanner =
    std::function<absl::StatusOr<RevisionPlan>(const VehicleView&)>;
// The revision, and the counts of the plan.
struct RevisionResult {
  std::uint64_t revision = 0;
  std::int64_t revised_count = 0;
  std::int64_t dropped_count = 0;
  // False where there was nothing to change.
  bool is_new = false;
};
using RevisionCallback = std::function<void(absl::StatusOr<RevisionResult>)>;
// A pair as it is stored, the revision, and how well what was measured agreed
// with the graph before it was added, where that is defined.
struct AddedPair {
  PosePairRecord pair;
  std::uint64_t revision = 0;
  std::optional<core::Agreement> agreement;
  // False where the pair was there already.
  bool is_new = false;
};
// Who decided by a pair that is added, and the stored candidate that it names.
struct PairAnswer {
  std::optional<CandidateId> candidate = std::nullopt;
  // Caller::identity.
  std::string actor = std::string();
};
using PairCallback = std::function<void(absl::StatusOr<AddedPair>)>;
// Who deletes a pair, and when.
struct PairDeletion {
  std::int64_t time_ns = 0;  // Since the Unix epoch.
  // Caller::identity.
  std::string deleted_by = std::string();
};

// Contracts of the methods: see those of VehicleSession. Belongs to the strand.
class Changes {
 public:
  Changes(VehicleState* vehicle, VehicleQueue* queue, Replayer* replayer,
          StoredChecks* checks, std::size_t max_pose_pairs)
      : vehicle_(vehicle),
        queue_(queue),
        replayer_(replayer),
        checks_(checks),
        max_pose_pairs_(max_pose_pairs) {}

  // Calls `callback` with the answer to a client that claims this
  // acknowledgement, unless poses that it claims are lost: then only returns
  // false. Changes nothing, and may be called at any time.
  bool AnswerUnlessLost(std::uint64_t acked_sequence,
                        const std::string& vehicle_uid,
                        const ViewCallback& callback) const;
  void CheckAcknowledged(std::uint64_t acked_sequence,
                         const std::string& vehicle_uid,
                         const ViewCallback& callback);
  void AcceptDataLoss(std::uint64_t durable_sequence,
                      const ViewCallback& callback);
  void Update(const ConfigChange& change, const ViewCallback& callback);
  void Revise(const RevisionPlanner& plan, const RevisionCallback& callback);
  void AddPosePair(PairKind kind, PosePairRecord pair,
                   const PairAnswer& answers, const PairCallback& callback);
  void DeletePosePair(
      PairKind kind, const std::string& id, const PairDeletion& deletion,
      const std::function<void(absl::StatusOr<std::uint64_t>)>& callback);
  void Delete(const std::function<void(absl::Status)>& callback);
  // The stored poses have damage that was not known: the vehicle leaves, to be
  // loaded anew from the poses themselves, which show what is sound.
  void LoadAnew();

 private:
  using Then = std::function<void(const absl::Status&)>;
  // Hands something to the storage, before it returns.
  using StorageWrite = std::function<void(WriteDone)>;

  // Hands a write to the storage; `then` runs on the strand when it is done,
  // and nothing but reads starts before `then` returns.
  void Write(const StorageWrite& write, Then then);
  // The same where `then` takes long, which runs where long work does if the
  // write went well. Until then the store shows more than memory by `lead`.
  void WriteForLongWork(const StorageWrite& write, VehicleQueue::StoreLead lead,
                        Then then);
  // As Write(), but has the storage confirm what it was handed before: `then`
  // acknowledges something that is in memory already.
  void Confirm(Then then);
  // The write of a config, which has to outlive it.
  StorageWrite WriteOf(const VehicleConfig& config) const;
  // Gives the vehicle in memory a config that was stored and moves no nodes.
  absl::Status Apply(const VehicleConfig& config, std::uint64_t revision);
  // Stores and applies a config that moves no nodes.
  void ChangeConfig(const VehicleConfig& config, Then then);
  // Removes from the store what is damaged: the vehicle in memory stays.
  void DropDamaged(const VehicleConfig& config, Then then);
  Then AnswerWithView(const ViewCallback& callback);
  void WriteRevision(const RevisionPlanner& make_plan,
                     const RevisionCallback& callback);
  // Replaces the batches, and makes the graph anew.
  void WriteRevised(BatchSource batches, const RevisionResult& result,
                    const RevisionCallback& callback);
  // OK if the pair may be added, or if `present`, the pair that has its id, is
  // the same; `present` is null if no pair has the id.
  absl::Status CheckNewPair(PairKind kind, const PosePairRecord& pair,
                            const PosePairRecord* present) const;
  // OK unless the two poses are a pair of the other kind.
  absl::Status CheckConflict(PairKind kind, const PosePairRecord& pair) const;
  // Adds a pair that may be added, or answers the one that is there already.
  void StorePair(PairKind kind, PosePairRecord pair,
                 const std::shared_ptr<const core::MeasuredLoop>& measured,
                 const std::optional<ChecksWrite>& checks,
                 const PairCallback& callback);
  // Writes a new pair, and adds it to the graph; one that is not the last is
  // added by making the graph anew.
  void WritePair(PairKind kind, const AddedPair& added, bool is_last,
                 const std::shared_ptr<const core::MeasuredLoop>& measured,
                 const std::optional<ChecksWrite>& checks,
                 const PairCallback& callback);
  // Deletes a pair that is there, with what that makes of stored candidates.
  void RemovePair(
      PairKind kind, const PosePairRecord& pair, const PairDeletion& deletion,
      const std::optional<ChecksWrite>& checks,
      const std::function<void(absl::StatusOr<std::uint64_t>)>& callback);
  // The answer to a failed write of a pair. Where the store has another
  // head of checks than memory, the vehicle leaves, to be loaded anew.
  absl::Status FailureOf(const absl::Status& status);
  // Gives the pair its place in the order of creation times. Returns whether it
  // is the last.
  bool PlaceInOrder(PosePairRecord* pair) const;
  void TakeOnLastPair(
      PairKind kind, const PosePairRecord& pair, std::uint64_t revision,
      const std::shared_ptr<const core::MeasuredLoop>& measured);
  // Answers that there is no such pair, once the storage has confirmed it.
  void ConfirmMissing(
      PairKind kind, const std::string& id,
      const std::function<void(absl::StatusOr<std::uint64_t>)>& callback);
  // Takes a pair, which is still among the vehicle's, out of the graph.
  void TakeBack(PairKind kind, const PosePairRecord& pair,
                std::uint64_t revision);

  VehicleState* const vehicle_;
  VehicleQueue* const queue_;
  Replayer* const replayer_;
  StoredChecks* const checks_;
  const std::size_t max_pose_pairs_;
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_SESSIONS_CHANGES_H_
