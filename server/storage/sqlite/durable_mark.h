// Keeps which commit is known to have been flushed last.
//
// The mark is a small file beside the store, written after each commit and not
// flushed itself: so it never says more than is true, costs one write to the
// page cache, and is exact after the server was killed. After a power failure
// it may say less. It distinguishes a log that was cut short, even at a
// boundary of commits, from one that ends where it should.
#ifndef REVISIT_SERVER_STORAGE_SQLITE_DURABLE_MARK_H_
#define REVISIT_SERVER_STORAGE_SQLITE_DURABLE_MARK_H_

#include <memory>
#include <optional>
#include <string>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "server/storage/sqlite/store_state.h"
#include "server/storage/sqlite/write_ahead_log.h"

namespace revisit::server {

// The file `<store>.mark`. For one thread at a time.
class DurableMark {
 public:
  static absl::StatusOr<std::unique_ptr<DurableMark>> Open(
      const std::string& store_path);
  ~DurableMark();

  DurableMark(const DurableMark&) = delete;
  DurableMark& operator=(const DurableMark&) = delete;

  // Reads the mark of a store, also while another process writes it; nothing if
  // the file is not whole.
  static std::optional<StoreState> Read(const std::string& store_path);
  // Notes a commit that was flushed. If the file cannot be written, the older
  // mark stays, which is still true.
  void Write(const StoreState& flushed);
  // Notes a commit that was flushed, and flushes the mark. REQUIRED before the
  // log is emptied: without a log, only a mark of the same commit says that
  // none is needed.
  absl::Status Flush(const StoreState& flushed);
  // Notes that nothing is known any more, and flushes the mark.
  absl::Status Clear();

 private:
  DurableMark(std::string path, int file)
      : path_(std::move(path)), file_(file) {}

  const std::string path_;
  const int file_;
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_STORAGE_SQLITE_DURABLE_MARK_H_
