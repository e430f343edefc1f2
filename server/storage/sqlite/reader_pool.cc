#include "server/storage/sqlite/reader_pool.h"

#include <cstddef>
#include <utility>

namespace revisit::server {
namespace {

constexpr std::size_t kMostIdle = 4;

}  // namespace

absl::Status ReaderPool::Read(
    const std::function<absl::Status(SqliteDatabase&)>& read) {
  absl::StatusOr<std::unique_ptr<SqliteDatabase>> reader = Take();
  if (!reader.ok()) return reader.status();
  absl::Status status = (*reader)->Prepare("BEGIN").Run();
  if (status.ok()) {
    status = read(**reader);
    // There is nothing to commit, but the moment must end.
    const absl::Status ended = (*reader)->Prepare("COMMIT").Run();
    if (status.ok()) status = ended;
  }
  GiveBack(*std::move(reader));
  return status;
}

void ReaderPool::CloseAll() {
  const MutexLock guard(&mutex_);
  idle_.clear();
}

absl::StatusOr<std::unique_ptr<SqliteDatabase>> ReaderPool::Take() {
  {
    const MutexLock guard(&mutex_);
    if (!idle_.empty()) {
      std::unique_ptr<SqliteDatabase> reader = std::move(idle_.back());
      idle_.pop_back();
      return reader;
    }
  }
  return SqliteDatabase::Open(path_, mode_, vfs_);
}

void ReaderPool::GiveBack(std::unique_ptr<SqliteDatabase> reader) {
  // One whose moment did not end would show it to the next reader.
  if (reader->InTransaction()) return;
  const MutexLock guard(&mutex_);
  if (idle_.size() < kMostIdle) idle_.push_back(std::move(reader));
}

}  // namespace revisit::server
