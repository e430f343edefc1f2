#include "server/storage/sqlite/store_intake.h"

#include <cerrno>
#include <cstdio>
#include <filesystem>
#include <system_error>
#include <utility>

#include "server/base/status.h"
#include "server/storage/records.h"
#include "server/storage/sqlite/batch_rows.h"
#include "server/storage/sqlite/check_rows.h"
#include "server/storage/sqlite/group_rows.h"
#include "server/storage/sqlite/link_rows.h"
#include "server/storage/sqlite/member_rows.h"
#include "server/storage/sqlite/pair_rows.h"
#include "server/storage/sqlite/sqlite_database.h"
#include "server/storage/sqlite/store_check.h"
#include "server/storage/sqlite/store_examination.h"
#include "server/storage/sqlite/store_files.h"
#include "server/storage/sqlite/store_opening.h"
#include "server/storage/sqlite/store_state.h"
#include "server/storage/sqlite/vehicle_rows.h"

namespace revisit::server {
namespace {

void RemoveUnfinished(const std::string& path) {
  std::error_code ignored;
  std::filesystem::remove(path, ignored);
  for (const char* suffix : {"-journal", "-wal", "-shm"}) {
    std::filesystem::remove(path + suffix, ignored);
  }
}

class FileIntake : public StoreIntake {
 public:
  FileIntake(std::string path, std::string unfinished, std::uint64_t run,
             std::unique_ptr<SqliteDatabase> database)
      : path_(std::move(path)),
        unfinished_(std::move(unfinished)),
        run_(run),
        database_(std::move(database)) {}

  ~FileIntake() override {
    database_.reset();
    RemoveUnfinished(unfinished_);
  }

  absl::Status AddVehicle(const VehicleRecord& vehicle) override {
    return ImportVehicle(*database_, vehicle);
  }

  absl::Status AddBatch(VehicleKey key, const BatchRecord& as_sent,
                        const std::optional<BatchRecord>& revised) override {
    std::uint64_t expected = as_sent.first_sequence;
    absl::Status status = InsertBatch(*database_, key, as_sent, &expected);
    if (!status.ok() || !revised) return status;
    return ReviseBatchRows(
        *database_, key,
        [&](const std::function<absl::Status(const BatchRecord&)>& take) {
          return take(*revised);
        },
        revised->revision);
  }

  absl::Status AddPosePair(VehicleKey key, PairKind kind,
                           const PosePairRecord& pair) override {
    return InsertPosePair(*database_, key, kind, pair, /*revision=*/0);
  }

  absl::Status AddDeletedPair(VehicleKey key,
                              const DeletedPairRecord& deleted) override {
    return InsertDeletedPair(*database_, key, deleted);
  }

  absl::Status AddChecks(VehicleKey key, const ChecksHead& head,
                         const std::vector<CheckRecord>& checks) override {
    return ImportChecks(*database_, key, head, checks);
  }

  absl::Status AddGroup(const GroupRecord& group) override {
    return InsertGroup(*database_, group);
  }

  absl::Status AddMember(const std::string& group_id,
                         const GroupMemberRecord& member) override {
    return InsertMember(*database_, group_id, member);
  }

  absl::Status AddLink(const std::string& group_id,
                       const GroupLinkRecord& link) override {
    return InsertLink(*database_, group_id, link);
  }

  absl::Status Commit() override {
    const absl::StatusOr<StoreState> state = ReadState(*database_);
    if (!state.ok()) return state.status();
    absl::Status status =
        WriteState(*database_, NextState(*state, run_, /*is_closed=*/true));
    // The end of write-ahead mode makes it one file, without a log beside it.
    if (status.ok()) {
      status = database_->Execute("COMMIT; PRAGMA journal_mode = DELETE");
    }
    if (!status.ok()) return status;
    database_.reset();
    const absl::StatusOr<StoreReport> report =
        CheckStore(unfinished_, StoreUse::kIdle);
    if (!report.ok()) return report.status();
    if (!report->problems.empty()) return Corrupt(report->problems.front());
    status = FlushFile(unfinished_);
    if (!status.ok()) return status;
    if (std::rename(unfinished_.c_str(), path_.c_str()) != 0) {
      return absl::ErrnoToStatus(errno, "cannot name the store " + path_);
    }
    return FlushFile(std::filesystem::path(path_).parent_path().string());
  }

 private:
  const std::string path_;
  const std::string unfinished_;
  const std::uint64_t run_;
  std::unique_ptr<SqliteDatabase> database_;
};

}  // namespace

absl::StatusOr<std::unique_ptr<StoreIntake>> FillFile(const std::string& path) {
  std::error_code error;
  const std::string store =
      std::filesystem::weakly_canonical(path, error).string();
  if (!absl::IsNotFound(CheckDatabaseIsThere(store))) {
    return Error(absl::StatusCode::kFailedPrecondition, "STORE_UNAVAILABLE",
                 "there is a store at " + store +
                     " already: one is imported where there is none");
  }
  const std::string unfinished = store + ".import";
  RemoveUnfinished(unfinished);
  const std::uint64_t run = RandomRun();
  absl::Status status = MakeStore(unfinished, "", run);
  if (!status.ok()) return status;
  absl::StatusOr<std::unique_ptr<SqliteDatabase>> database =
      SqliteDatabase::Open(unfinished, SqliteDatabase::Mode::kReadWrite, "");
  if (!database.ok()) return database.status();
  status = (*database)->Execute("BEGIN IMMEDIATE");
  if (!status.ok()) return status;
  return std::unique_ptr<StoreIntake>(
      new FileIntake(store, unfinished, run, *std::move(database)));
}

}  // namespace revisit::server
