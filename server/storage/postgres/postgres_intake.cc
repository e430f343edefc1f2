#include "server/storage/postgres/postgres_intake.h"

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <utility>
#include <vector>

#include "server/base/status.h"
#include "server/storage/postgres/connection.h"
#include "server/storage/postgres/migrations.h"
#include "server/storage/postgres/postgres_group_changes.h"
#include "server/storage/postgres/postgres_group_reads.h"
#include "server/storage/record_check.h"
#include "server/storage/record_checksum.h"

namespace revisit::server {
namespace {

// Rows that one statement inserts.
constexpr std::size_t kIntakeRows = 128;

constexpr Statement kTakeVehicle = {
    "take_vehicle",
    "WITH v AS (INSERT INTO vehicles (key, id, format, revision, checksum, "
    "payload) VALUES ($1::int8, $2::text, $3::int8, $4::int8, $5::int8, "
    "$6::bytea)) INSERT INTO heads (key, revision) VALUES ($1::int8, "
    "$4::int8)"};
constexpr Statement kSetHead = {
    "set_head",
    "UPDATE heads SET durable_sequence = $2::int8 WHERE key = $1::int8"};
#define REVISIT_TAKE_BATCHES(TABLE)                                      \
  "INSERT INTO " TABLE                                                   \
  " (vehicle_key, first_sequence, count, format, revision, checksum, "   \
  "payload) SELECT $1::int8, f, n, $2::int8, rev, ck, p FROM "           \
  "unnest($3::int8[], $4::int8[], $5::int8[], $6::int8[], $7::bytea[]) " \
  "AS a(f, n, rev, ck, p)"
constexpr Statement kTakeBatches = {"take_batches",
                                    REVISIT_TAKE_BATCHES("batches")};
constexpr Statement kTakeRevised = {"take_revised_batches",
                                    REVISIT_TAKE_BATCHES("revised_batches")};
#undef REVISIT_TAKE_BATCHES
#define REVISIT_TAKE_PAIR(TABLE)                                    \
  "INSERT INTO " TABLE                                              \
  " (vehicle_key, id, format, query_sequence, matched_sequence, "   \
  "create_time_ns, checksum, payload) VALUES ($1::int8, $2::text, " \
  "$3::int8, $4::int8, $5::int8, $6::int8, $7::int8, $8::bytea)"
constexpr Statement kTakeClosure = {"take_loop_closure",
                                    REVISIT_TAKE_PAIR("loop_closures")};
constexpr Statement kTakeRejection = {"take_rejected_candidate",
                                      REVISIT_TAKE_PAIR("rejected_candidates")};
#undef REVISIT_TAKE_PAIR
constexpr Statement kTakeDeletedPair = {
    "take_deleted_pair",
    "INSERT INTO deleted_pose_pairs (vehicle_key, number, kind, id, format, "
    "query_sequence, matched_sequence, create_time_ns, delete_time_ns, "
    "checksum, payload) VALUES ($1::int8, $2::int8, $3::int8, $4::text, "
    "$5::int8, $6::int8, $7::int8, $8::int8, $9::int8, $10::int8, "
    "$11::bytea)"};
constexpr Statement kTakeChecksHead = {
    "take_checks_head",
    "UPDATE heads SET checks_stored = ($2::int8 <> 0), checked_sequence = "
    "$3::int8, last_event = $4::int8 WHERE key = $1::int8"};
constexpr Statement kTakeCheck = {
    "take_check",
    "INSERT INTO checks (vehicle_key, sequence, format, revision, open_count, "
    "create_time_ns, checksum, payload) VALUES ($1::int8, $2::int8, $3::int8, "
    "$4::int8, $5::int8, $6::int8, $7::int8, $8::bytea)"};
constexpr Statement kSetNextKey = {
    "set_next_key",
    "SELECT setval(pg_get_serial_sequence('vehicles', 'key')::regclass, "
    "$1::int8)"};
constexpr Statement kIsEmpty = {
    "is_empty",
    "SELECT NOT EXISTS (SELECT 1 FROM vehicles) AND NOT EXISTS (SELECT 1 FROM "
    "batches) AND NOT EXISTS (SELECT 1 FROM deleted_vehicles) AND NOT EXISTS "
    "(SELECT 1 FROM events) AND NOT EXISTS (SELECT 1 FROM vehicle_groups)"};

class PostgresIntake : public StoreIntake {
 public:
  explicit PostgresIntake(std::unique_ptr<PostgresConnection> connection)
      : connection_(std::move(connection)) {}

  absl::Status AddVehicle(const VehicleRecord& vehicle) override {
    absl::Status status = EndVehicle();
    if (!status.ok()) return status;
    key_ = vehicle.key;
    highest_key_ = std::max(highest_key_, vehicle.key);
    return connection_
        ->Run(kTakeVehicle,
              Parameters()
                  .Add(vehicle.key)
                  .AddText(vehicle.id)
                  .Add(kSharedRowFormat)
                  .Add(Signed(vehicle.revision))
                  .Add(ChecksumOfVehicle(kSharedRowFormat, vehicle))
                  .AddText(vehicle.payload))
        .status();
  }

  absl::Status AddBatch(VehicleKey /*key*/, const BatchRecord& as_sent,
                        const std::optional<BatchRecord>& revised) override {
    as_sent_.push_back(as_sent);
    if (revised) revised_.push_back(*revised);
    durable_sequence_ = as_sent.first_sequence + as_sent.count - 1;
    return as_sent_.size() < kIntakeRows ? absl::OkStatus() : Flush();
  }

  absl::Status AddPosePair(VehicleKey key, PairKind kind,
                           const PosePairRecord& pair) override {
    return connection_
        ->Run(kind == PairKind::kLoopClosure ? kTakeClosure : kTakeRejection,
              Parameters()
                  .Add(key)
                  .AddText(pair.id)
                  .Add(kSharedRowFormat)
                  .Add(Signed(pair.query_sequence))
                  .Add(Signed(pair.matched_sequence))
                  .Add(pair.create_time_ns)
                  .Add(ChecksumOfPosePair(kSharedRowFormat, key, kind, pair))
                  .AddText(pair.payload))
        .status();
  }

  absl::Status AddDeletedPair(VehicleKey key,
                              const DeletedPairRecord& deleted) override {
    return connection_
        ->Run(kTakeDeletedPair,
              Parameters()
                  .Add(key)
                  .Add(Signed(deleted.number))
                  .Add(NumberOf(deleted.kind))
                  .AddText(deleted.pair.id)
                  .Add(kSharedRowFormat)
                  .Add(Signed(deleted.pair.query_sequence))
                  .Add(Signed(deleted.pair.matched_sequence))
                  .Add(deleted.pair.create_time_ns)
                  .Add(deleted.delete_time_ns)
                  .Add(ChecksumOfDeletedPair(kSharedRowFormat, key, deleted))
                  .AddText(deleted.pair.payload))
        .status();
  }

  absl::Status AddChecks(VehicleKey key, const ChecksHead& head,
                         const std::vector<CheckRecord>& checks) override {
    absl::Status status =
        connection_
            ->Run(kTakeChecksHead, Parameters()
                                       .Add(key)
                                       .Add(std::int64_t{head.stores ? 1 : 0})
                                       .Add(Signed(head.checked_sequence))
                                       .Add(Signed(head.last_event)))
            .status();
    for (const CheckRecord& check : checks) {
      if (!status.ok()) break;
      status = connection_
                   ->Run(kTakeCheck,
                         Parameters()
                             .Add(key)
                             .Add(Signed(check.sequence))
                             .Add(kSharedRowFormat)
                             .Add(Signed(check.revision))
                             .Add(std::int64_t{check.open_count})
                             .Add(check.create_time_ns)
                             .Add(ChecksumOfCheck(kSharedRowFormat, key, check))
                             .AddText(check.payload))
                   .status();
    }
    return status;
  }

  absl::Status AddGroup(const GroupRecord& group) override {
    return InsertGroup(*connection_, group).status();
  }

  absl::Status AddMember(const std::string& group_id,
                         const GroupMemberRecord& member) override {
    return InsertMemberRow(*connection_, group_id, member);
  }

  absl::Status AddLink(const std::string& group_id,
                       const GroupLinkRecord& link) override {
    return InsertLinkRow(*connection_, group_id, link);
  }

  absl::Status Commit() override {
    absl::Status status = EndVehicle();
    if (status.ok() && highest_key_ > 0) {
      status = connection_->Run(kSetNextKey, Parameters().Add(highest_key_))
                   .status();
    }
    if (!status.ok()) return status;
    return connection_->RunText("COMMIT").status();
  }

 private:
  absl::Status EndVehicle() {
    absl::Status status = Flush();
    if (!status.ok() || durable_sequence_ == 0) return status;
    return connection_
        ->Run(kSetHead, Parameters().Add(key_).Add(
                            Signed(std::exchange(durable_sequence_, 0))))
        .status();
  }

  absl::Status Flush() {
    absl::Status status = Insert(kTakeBatches, BatchVersion::kAsSent, as_sent_);
    if (status.ok()) {
      status = Insert(kTakeRevised, BatchVersion::kCurrent, revised_);
    }
    as_sent_.clear();
    revised_.clear();
    return status;
  }

  absl::Status Insert(const Statement& statement, BatchVersion version,
                      const std::vector<BatchRecord>& batches) {
    if (batches.empty()) return absl::OkStatus();
    std::vector<std::int64_t> firsts;
    std::vector<std::int64_t> counts;
    std::vector<std::int64_t> revisions;
    std::vector<std::int64_t> checksums;
    std::vector<const std::string*> payloads;
    for (const BatchRecord& batch : batches) {
      firsts.push_back(Signed(batch.first_sequence));
      counts.push_back(batch.count);
      revisions.push_back(Signed(batch.revision));
      checksums.push_back(
          ChecksumOfBatch(kSharedRowFormat, key_, version, batch));
      payloads.push_back(&batch.payload);
    }
    return connection_
        ->Run(statement, Parameters()
                             .Add(key_)
                             .Add(kSharedRowFormat)
                             .Add(firsts)
                             .Add(counts)
                             .Add(revisions)
                             .Add(checksums)
                             .AddBytes(payloads))
        .status();
  }

  // Its end rolls back.
  const std::unique_ptr<PostgresConnection> connection_;
  VehicleKey highest_key_ = 0;
  // The vehicle that is being taken in, and what of it is not written yet.
  VehicleKey key_ = 0;
  std::uint64_t durable_sequence_ = 0;
  std::vector<BatchRecord> as_sent_;
  std::vector<BatchRecord> revised_;
};

}  // namespace

absl::StatusOr<std::unique_ptr<StoreIntake>> FillDatabase(
    const std::string& conninfo) {
  PostgresConnection::Options options;
  options.conninfo = conninfo;
  auto connection = PostgresConnection::Open(options);
  if (!connection.ok()) return connection.status();
  absl::Status status = CheckSchema(**connection);
  if (!status.ok()) return status;
  status = CheckKeepsGroups(**connection);
  if (!status.ok()) return status;
  status =
      (*connection)
          ->RunText("BEGIN; LOCK TABLE vehicles IN SHARE ROW EXCLUSIVE MODE")
          .status();
  if (!status.ok()) return status;
  const auto is_empty = (*connection)->Run(kIsEmpty);
  if (!is_empty.ok()) return is_empty.status();
  if (is_empty->Integer(0, 0) == 0) {
    return Error(absl::StatusCode::kFailedPrecondition, "STORE_UNAVAILABLE",
                 WithoutSecrets(conninfo) +
                     " is not empty: a store is imported into an empty one");
  }
  return std::unique_ptr<StoreIntake>(
      new PostgresIntake(*std::move(connection)));
}

}  // namespace revisit::server
