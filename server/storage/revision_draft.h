// A revision that is being received: its poses, then the batches that they
// change. Both lie in a temporary file, so that a revision may be much larger
// than the memory that the server would spend on a caller.
//
// For one thread at a time.
#ifndef REVISIT_SERVER_STORAGE_REVISION_DRAFT_H_
#define REVISIT_SERVER_STORAGE_REVISION_DRAFT_H_

#include <cstdint>
#include <functional>
#include <memory>
#include <optional>
#include <string>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "server/storage/free_space.h"
#include "server/storage/records.h"
#include "server/storage/sqlite/sqlite_database.h"

namespace revisit::server {

class RevisionDraft {
 public:
  // Makes the file in `directory`. It has no name, so that it disappears with
  // this object or the process, and it leaves `min_free_bytes` free on its file
  // system.
  static absl::StatusOr<std::unique_ptr<RevisionDraft>> Create(
      const std::string& directory, std::int64_t min_free_bytes);

  RevisionDraft(const RevisionDraft&) = delete;
  RevisionDraft& operator=(const RevisionDraft&) = delete;

  // RESOURCE_EXHAUSTED (STORAGE_FULL) if there is no room for more poses now.
  absl::Status CheckRoom() { return space_->Check(); }

  // Adds a pose; false if its sequence was added before.
  absl::StatusOr<bool> AddPose(std::uint64_t sequence, const std::string& pose);
  std::int64_t pose_count() const { return pose_count_; }
  // Lowest and highest sequence. REQUIRES: there are poses.
  std::uint64_t first_sequence() const { return first_sequence_; }
  std::uint64_t last_sequence() const { return last_sequence_; }
  // Visits the poses of [first, last], by sequence, until `visit` refuses.
  absl::Status ReadPoses(
      std::uint64_t first, std::uint64_t last,
      const std::function<absl::Status(std::uint64_t sequence,
                                       const std::string& pose)>& visit);

  // Adds a batch. Its revision is not kept.
  absl::Status AddBatch(const BatchRecord& batch);
  bool has_batches() const { return has_batches_; }
  // Passes on all batches, by first sequence, until `take` refuses.
  absl::Status ReadBatches(
      const std::function<absl::Status(const BatchRecord&)>& take);

 private:
  RevisionDraft(std::unique_ptr<SqliteDatabase> database,
                std::unique_ptr<FreeSpaceGuard> space)
      : database_(std::move(database)), space_(std::move(space)) {}

  const std::unique_ptr<SqliteDatabase> database_;
  const std::unique_ptr<FreeSpaceGuard> space_;
  std::int64_t pose_count_ = 0;
  std::uint64_t first_sequence_ = 0;
  std::uint64_t last_sequence_ = 0;
  bool has_batches_ = false;
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_STORAGE_REVISION_DRAFT_H_
