#include "server/storage/postgres/postgres_storage.h"

#include <algorithm>
#include <optional>
#include <utility>
#include <vector>

#include "server/base/status.h"
#include "server/storage/kept_answer.h"
#include "server/storage/postgres/postgres_appends.h"
#include "server/storage/postgres/postgres_changes.h"
#include "server/storage/postgres/postgres_checks.h"
#include "server/storage/postgres/postgres_reader.h"
#include "server/storage/postgres/postgres_reads.h"
#include "server/storage/postgres/postgres_snapshots.h"
#include "server/storage/postgres/postgres_writer.h"

namespace revisit::server {
namespace {

using absl::StatusCode;

// How old the size of the database may be.
constexpr std::chrono::minutes kSizePeriod{1};

PostgresWriter::Options WriterOptions(const PostgresOptions& options,
                                      const std::string& conninfo) {
  PostgresWriter::Options writer;
  static_cast<WriteGroupOptions&>(writer) = options;
  writer.conninfo = conninfo;
  writer.require_replicated = options.require_replicated;
  return writer;
}

class PostgresStorage : public PostgresReader {
 public:
  // Groups have a writer of their own, so that no vehicle waits while another
  // server holds a group.
  PostgresStorage(PostgresDatabase found, const PostgresOptions& options,
                  std::unique_ptr<Ownership> ownership,
                  std::unique_ptr<PostgresWriter> group_writer)
      : PostgresReader(std::move(found), group_writer.get()),
        options_(options),
        ownership_(std::move(ownership)) {
    PostgresWriter::Options writer =
        WriterOptions(options, database().conninfo);
    for (int i = 0; i < std::max(1, options.writer_connections); ++i) {
      writer.purges_first = i == 0;
      writer.size_period = i == 0 ? kSizePeriod : std::chrono::milliseconds(0);
      writers_.push_back(
          std::make_unique<PostgresWriter>(writer, ownership_.get()));
    }
    writers_.push_back(std::move(group_writer));
  }

  // The writes are settled before the ownership ends.
  ~PostgresStorage() override {
    for (const auto& writer : writers_) writer->Stop();
    const auto latest = std::chrono::steady_clock::now() + options_.settle_time;
    for (const auto& writer : writers_) {
      if (!writer->AwaitEnd(latest)) writer->GiveUp();
    }
    writers_.clear();
  }

  void CreateVehicle(
      VehicleRecord record,
      std::function<void(absl::StatusOr<VehicleKey>)> done) override {
    const std::size_t bytes = record.payload.size();
    // Creations of one id keep their order.
    const auto lane =
        static_cast<VehicleKey>(std::hash<std::string>()(record.id));
    const KeptAnswer<VehicleKey> key;
    WriterOf(lane).Submit(
        0, bytes,
        [this, record = std::move(record), key](PostgresConnection& connection,
                                                const Fence&) {
          return key.Keep(
              InsertVehicle(connection, record, ownership_->HighestKey()));
        },
        key.Then(std::move(done)));
  }

  void UpdateVehicle(VehicleKey key, std::string payload,
                     std::uint64_t revision, Done done) override {
    const std::size_t bytes = payload.size();
    WriterOf(key).Submit(
        key, bytes,
        [payload = std::move(payload), revision](PostgresConnection& connection,
                                                 const Fence& fence) {
          return ChangeVehicle(connection, fence, payload, revision);
        },
        std::move(done));
  }

  void DeleteVehicle(VehicleKey key, EventRecord farewell, Done done) override {
    PostgresWriter& writer = WriterOf(key);
    const std::size_t bytes = farewell.payload.size();
    writer.Submit(
        key, bytes,
        [this, &writer, farewell = std::move(farewell)](
            PostgresConnection& connection, const Fence& fence) {
          absl::Status status = RemoveVehicle(connection, fence, farewell);
          if (status.ok()) {
            ownership_->Forget(fence.key, fence.claim.get());
            writer.PurgeSoon();
          }
          return status;
        },
        std::move(done));
  }

  void AppendBatches(VehicleKey key, std::vector<BatchRecord> batches,
                     std::optional<std::string> vehicle_payload,
                     Done done) override {
    PostgresWriter& writer = WriterOf(key);
    if (!vehicle_payload.has_value()) {
      writer.Append(key, std::move(batches), std::move(done));
      return;
    }
    std::size_t bytes = 0;
    for (const BatchRecord& batch : batches) bytes += batch.payload.size();
    writer.Submit(
        key, bytes,
        [batches = std::move(batches), payload = *std::move(vehicle_payload)](
            PostgresConnection& connection, const Fence& fence) {
          return AppendWithVehicle(connection, fence, batches, payload);
        },
        std::move(done));
  }

  std::size_t MostBatchBytes() const override { return kMostInlineBytes; }
  bool KeepsColumns() const override { return false; }

  void ReviseBatches(VehicleKey key, BatchSource batches,
                     std::uint64_t revision, Done done) override {
    PostgresWriter& writer = WriterOf(key);
    writer.Submit(
        key, 0,
        [&writer, batches = std::move(batches), revision](
            PostgresConnection& connection, const Fence& fence) {
          writer.PurgeSoon();
          return ReviseBatchRows(connection, fence, batches, revision);
        },
        std::move(done));
  }

  void ReplaceBatches(VehicleKey key, std::vector<BatchVersions> batches,
                      std::uint64_t revision, Done done) override {
    PostgresWriter& writer = WriterOf(key);
    writer.Submit(
        key, 0,
        [&writer, batches = std::move(batches), revision](
            PostgresConnection& connection, const Fence& fence) {
          writer.PurgeSoon();
          return ReplaceBatchRows(connection, fence, batches, revision);
        },
        std::move(done));
  }

  void AddPosePair(VehicleKey key, PairKind kind, PosePairRecord pair,
                   std::optional<ChecksWrite> checks, std::uint64_t revision,
                   Done done) override {
    WriterOf(key).Submit(
        key, 0,
        [kind, pair = std::move(pair), checks = std::move(checks), revision](
            PostgresConnection& connection, const Fence& fence) {
          return InsertPosePair(connection, fence, kind, pair, checks,
                                revision);
        },
        std::move(done));
  }

  void DeletePosePair(VehicleKey key, DeletedPairRecord deleted,
                      std::optional<ChecksWrite> checks, std::uint64_t revision,
                      Done done) override {
    WriterOf(key).Submit(
        key, 0,
        [deleted = std::move(deleted), checks = std::move(checks), revision](
            PostgresConnection& connection, const Fence& fence) {
          return RemovePosePair(connection, fence, deleted, checks, revision);
        },
        std::move(done));
  }

  void PutChecks(VehicleKey key, ChecksWrite checks, Done done) override {
    std::size_t bytes = 0;
    for (const CheckRecord& check : checks.checks) {
      bytes += check.payload.size();
    }
    for (const EventRecord& event : checks.events) {
      bytes += event.payload.size();
    }
    WriterOf(key).Submit(
        key, bytes,
        [checks = std::move(checks)](PostgresConnection& connection,
                                     const Fence& fence) {
          return StoreChecks(connection, fence, checks);
        },
        std::move(done));
  }

  void DropEvents(std::int64_t before_ns, int most, Done done) override {
    writers_.front()->Submit(
        0, 0,
        [before_ns, most](PostgresConnection& connection, const Fence&) {
          return DropOldEvents(connection, before_ns, most);
        },
        std::move(done));
  }

  void DropDamaged(VehicleKey key, std::uint64_t last_sequence,
                   std::string payload, std::uint64_t revision,
                   Done done) override {
    PostgresWriter& writer = WriterOf(key);
    writer.Submit(
        key, 0,
        [&writer, last_sequence, payload = std::move(payload), revision](
            PostgresConnection& connection, const Fence& fence) {
          writer.PurgeSoon();
          return DropDamagedRows(connection, fence, last_sequence, payload,
                                 revision);
        },
        std::move(done));
  }

  void PutSnapshotPart(VehicleKey key, std::uint32_t number, std::string part,
                       Done done) override {
    const std::size_t bytes = part.size();
    PostgresWriter& writer = WriterOf(key);
    writer.Submit(
        key, bytes,
        [&writer, number, part = std::move(part)](
            PostgresConnection& connection, const Fence& fence) {
          if (number == 0) writer.PurgeSoon();
          return PutSnapshotPartRow(connection, fence, number, part);
        },
        std::move(done));
  }

  void PutSnapshot(VehicleKey key, SnapshotRecord snapshot,
                   Done done) override {
    const std::size_t bytes = snapshot.payload.size();
    WriterOf(key).Submit(
        key, bytes,
        [snapshot = std::move(snapshot)](PostgresConnection& connection,
                                         const Fence& fence) {
          return PutSnapshotRow(connection, fence, snapshot);
        },
        std::move(done));
  }

  void DropSnapshot(VehicleKey key, Done done) override {
    PostgresWriter& writer = WriterOf(key);
    writer.Submit(
        key, 0,
        [&writer](PostgresConnection& connection, const Fence& fence) {
          writer.PurgeSoon();
          return DropSnapshotRow(connection, fence);
        },
        std::move(done));
  }

  void PutMarks(VehicleKey key, std::string marks, Done done) override {
    const std::size_t bytes = marks.size();
    WriterOf(key).Submit(
        key, bytes,
        [marks = std::move(marks)](PostgresConnection& connection,
                                   const Fence& fence) {
          return PutMarksRow(connection, fence, marks);
        },
        std::move(done));
  }

  absl::StatusOr<VehicleRecord> TakeVehicle(const std::string& id) override {
    return Read<VehicleRecord>(
        [&](PostgresConnection& connection) { return Take(connection, id); });
  }

  void ReleaseVehicle(VehicleKey key) override {
    const std::shared_ptr<const Claim> claim = ownership_->Find(key);
    if (claim == nullptr) return;
    // From now on, nothing is answered from memory.
    ownership_->Forget(key, claim.get());
    WriterOf(key).Submit(
        key, 0,
        [claim](PostgresConnection& connection, const Fence& fence) {
          return Ownership::Release(connection, fence.key, claim->owner,
                                    claim->epoch);
        },
        [](const absl::Status&) {});
  }

  absl::Status CheckOwned(VehicleKey key) const override {
    return ownership_->Check(key);
  }

  absl::Status CheckLease() const override { return ownership_->CheckLease(); }

  void ConfirmOwned(VehicleKey key, Done done) override {
    WriterOf(key).Submit(
        key, 0,
        [](PostgresConnection& connection, const Fence& fence) {
          return ConfirmHead(connection, fence);
        },
        std::move(done));
  }

  void Leave() override { ownership_->Leave(); }

  void OnWanted(const HandOver& hand_over) override {
    ownership_->OnWanted(hand_over);
  }

  absl::StatusOr<std::vector<StorageUser>> ListUsers() override {
    return ownership_->Users();
  }

  absl::Status CheckWritable() override {
    if (absl::Status lease = CheckLease(); !lease.ok()) return lease;
    for (const auto& writer : writers_) {
      if (absl::Status status = writer->CheckWritable(); !status.ok()) {
        return status;
      }
    }
    return absl::OkStatus();
  }

  Durability GetDurability() const override { return ownership_->durability(); }

  CommitCounts Counts() const override {
    CommitCounts sum;
    for (const auto& writer : writers_) {
      const CommitCounts counts = writer->Counts();
      sum.commits += counts.commits;
      sum.writes += counts.writes;
      sum.commit_seconds.Add(counts.commit_seconds);
    }
    sum.flush_seconds = ownership_->BeatSeconds();
    return sum;
  }

  std::optional<StorageRoom> GetRoom() const override {
    const std::optional<std::int64_t> bytes = writers_.front()->DatabaseBytes();
    if (!bytes.has_value()) return std::nullopt;
    return StorageRoom{*bytes};
  }

  std::optional<SharingState> GetSharing() const override {
    return ownership_->GetSharing();
  }

 protected:
  Uuid Self() const override { return ownership_->Self(); }

 private:
  // All writes of a vehicle go the same way.
  PostgresWriter& WriterOf(VehicleKey key) {
    return *writers_[static_cast<std::size_t>(key) % (writers_.size() - 1)];
  }

  absl::StatusOr<VehicleRecord> Take(PostgresConnection& connection,
                                     const std::string& id) {
    const absl::StatusOr<VehicleKey> key = ownership_->Take(connection, id);
    if (!key.ok()) return key.status();
    // The claim is committed: what is read now is final.
    absl::StatusOr<VehicleRecord> record = FindVehicle(connection, id);
    const std::shared_ptr<const Claim> claim = ownership_->Find(*key);
    if (record.ok() && record->key == *key && claim != nullptr) {
      record->epoch = claim->epoch;
      record->previous_epoch = claim->previous_epoch;
      return record;
    }
    if (claim != nullptr) ownership_->Forget(*key, claim.get());
    if (!record.ok()) return record.status();
    return Error(StatusCode::kUnavailable, "STORE_UNAVAILABLE",
                 "vehicle '" + id + "' was deleted and made anew just now");
  }

  const PostgresOptions options_;
  // Outlives the writers.
  const std::unique_ptr<Ownership> ownership_;
  // The last one is that of groups.
  std::vector<std::unique_ptr<PostgresWriter>> writers_;
};

}  // namespace

absl::StatusOr<std::unique_ptr<Storage>> OpenPostgresStorage(
    const std::string& conninfo, const PostgresOptions& options) {
  absl::StatusOr<PostgresDatabase> database = LookAtDatabase(conninfo);
  if (!database.ok()) return database.status();
  const Durability& durability = database->durability;
  if (options.require_replicated &&
      durability.level != Durability::Level::kReplicated) {
    return Error(StatusCode::kFailedPrecondition, "STORE_UNAVAILABLE",
                 "require-replicated is set, but the database does not "
                 "replicate a write before it acknowledges it: " +
                     durability.details);
  }
  if (durability.level == Durability::Level::kNone && options.ownership.warn) {
    options.ownership.warn("the database may lose what it has acknowledged: " +
                           durability.details);
  }
  auto ownership = Ownership::Join(conninfo, options.ownership);
  if (!ownership.ok()) return ownership.status();
  auto group_writer = std::make_unique<PostgresWriter>(
      WriterOptions(options, database->conninfo), ownership->get());
  return std::unique_ptr<Storage>(
      new PostgresStorage(*std::move(database), options, *std::move(ownership),
                          std::move(group_writer)));
}

}  // namespace revisit::server
