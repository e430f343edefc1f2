// How far the write-ahead log is known to have been flushed.
//
// A small file beside the store, written after each commit and not flushed
// itself: so it never says more than is true, costs one write to the page
// cache, and is exact after the server was killed. After a power failure it may
// say less. With it a log that was cut short, even at a boundary of commits, is
// told from one that ends where it should.
#ifndef REVISIT_SERVER_STORAGE_DURABLE_MARK_H_
#define REVISIT_SERVER_STORAGE_DURABLE_MARK_H_

#include <memory>
#include <optional>
#include <string>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "server/storage/write_ahead_log.h"

namespace revisit::server {

// The file `<store>.mark`. One thread at a time.
class DurableMark {
 public:
  static absl::StatusOr<std::unique_ptr<DurableMark>> Open(
      const std::string& store_path);
  ~DurableMark();

  DurableMark(const DurableMark&) = delete;
  DurableMark& operator=(const DurableMark&) = delete;

  // What the mark of a store says, also while another process writes it.
  // Nothing if there is none, or if it is not whole.
  static std::optional<LogPosition> Read(const std::string& store_path);
  std::optional<LogPosition> Read() const;
  // What was flushed. If it cannot be written the older one stays, which is
  // still true.
  void Write(const LogPosition& flushed);
  // Nothing is known any more: REQUIRED before the log is emptied. Flushed.
  absl::Status Clear();

 private:
  DurableMark(std::string path, int file)
      : path_(std::move(path)), file_(file) {}

  const std::string path_;
  const int file_;
  // Whether the file as it is has been flushed, so that nothing older can come
  // back after a power failure.
  bool is_flushed_ = false;
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_STORAGE_DURABLE_MARK_H_
