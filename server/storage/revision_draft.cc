#include "server/storage/revision_draft.h"

#include <stdlib.h>
#include <unistd.h>

#include <algorithm>
#include <cerrno>
#include <utility>

#include "server/base/status.h"
#include "server/storage/record_check.h"

namespace revisit::server {
namespace {

// The file does not outlive the process, so nothing is flushed and there is no
// journal for rollbacks. In memory, a draft takes the page cache of 2 MiB.
constexpr char kSetUp[] =
    "PRAGMA locking_mode = EXCLUSIVE;"
    "PRAGMA journal_mode = OFF;"
    "PRAGMA synchronous = OFF;"
    "PRAGMA cache_size = -2048;"
    "BEGIN;"
    "CREATE TABLE poses (sequence INTEGER PRIMARY KEY, pose BLOB NOT NULL);"
    "CREATE TABLE batches (first_sequence INTEGER PRIMARY KEY, "
    "count INTEGER NOT NULL, payload BLOB NOT NULL)";

absl::Status Failure(const char* what, const std::string& path) {
  const int cause = errno;
  const std::string message =
      std::string("cannot ") + what + " a temporary file in " + path + ": " +
      std::string(absl::ErrnoToStatus(cause, "").message());
  if (cause == ENOSPC || cause == EDQUOT) return StorageFull(message);
  return Error(absl::StatusCode::kUnavailable, "STORE_UNAVAILABLE", message);
}

}  // namespace

absl::StatusOr<std::unique_ptr<RevisionDraft>> RevisionDraft::Create(
    const std::string& directory, std::int64_t min_free_bytes) {
  auto space = std::make_unique<FreeSpaceGuard>(
      min_free_bytes, [directory] { return FreeBytes(directory); },
      [] { return std::int64_t{0}; });
  if (absl::Status status = space->Check(); !status.ok()) return status;
  std::string path = directory + "/.revision-XXXXXX";
  const int descriptor = mkstemp(path.data());
  if (descriptor < 0) return Failure("make", directory);
  close(descriptor);
  absl::StatusOr<std::unique_ptr<SqliteDatabase>> database =
      SqliteDatabase::Open(path, SqliteDatabase::Mode::kReadWrite, "");
  absl::Status status = database.status();
  // This opens the file, which can then be unlinked.
  if (status.ok()) status = (*database)->Execute(kSetUp);
  if (unlink(path.c_str()) != 0 && status.ok()) {
    status = Failure("unlink", directory);
  }
  if (!status.ok()) return status;
  return std::unique_ptr<RevisionDraft>(
      new RevisionDraft(*std::move(database), std::move(space)));
}

absl::StatusOr<bool> RevisionDraft::AddPose(std::uint64_t sequence,
                                            const std::string& pose) {
  const absl::Status status =
      database_->Prepare("INSERT OR IGNORE INTO poses VALUES (?1, ?2)")
          .Bind(1, Signed(sequence))
          .BindBlob(2, pose)
          .Run();
  if (!status.ok()) return status;
  if (database_->Changes() == 0) return false;
  first_sequence_ =
      pose_count_ == 0 ? sequence : std::min(first_sequence_, sequence);
  last_sequence_ = std::max(last_sequence_, sequence);
  ++pose_count_;
  return true;
}

absl::Status RevisionDraft::ReadPoses(
    std::uint64_t first, std::uint64_t last,
    const std::function<absl::Status(std::uint64_t, const std::string&)>&
        visit) {
  SqliteStatement rows = database_->Prepare(
      "SELECT sequence, pose FROM poses WHERE sequence BETWEEN ?1 AND ?2 "
      "ORDER BY sequence");
  rows.Bind(1, Signed(first)).Bind(2, Signed(last));
  while (true) {
    const absl::StatusOr<bool> row = rows.Step();
    if (!row.ok()) return row.status();
    if (!*row) return absl::OkStatus();
    absl::Status status =
        visit(static_cast<std::uint64_t>(rows.Integer(0)), rows.Bytes(1));
    if (!status.ok()) return status;
  }
}

absl::Status RevisionDraft::AddBatch(const BatchRecord& batch) {
  has_batches_ = true;
  return database_->Prepare("INSERT INTO batches VALUES (?1, ?2, ?3)")
      .Bind(1, Signed(batch.first_sequence))
      .Bind(2, batch.count)
      .BindBlob(3, batch.payload)
      .Run();
}

absl::Status RevisionDraft::ReadBatches(
    const std::function<absl::Status(const BatchRecord&)>& take) {
  SqliteStatement rows = database_->Prepare(
      "SELECT first_sequence, count, payload FROM batches "
      "ORDER BY first_sequence");
  while (true) {
    const absl::StatusOr<bool> row = rows.Step();
    if (!row.ok()) return row.status();
    if (!*row) return absl::OkStatus();
    BatchRecord batch;
    batch.first_sequence = static_cast<std::uint64_t>(rows.Integer(0));
    batch.count = static_cast<std::uint32_t>(rows.Integer(1));
    batch.payload = rows.Bytes(2);
    if (absl::Status status = take(batch); !status.ok()) return status;
  }
}

}  // namespace revisit::server
