// A revision in the making: poses as they come, then the batches that they
// change. Both lie in a temporary file, so that a revision may be much larger
// than what the server would hold in memory for a caller.
//
// One thread at a time.
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
#include "server/storage/sqlite_database.h"
#include "server/storage/storage.h"

namespace revisit::server {

class RevisionDraft {
 public:
  // Makes the file in `directory`. It has no name, so that it goes with this or
  // with the process, and takes no more than leaves `min_free_bytes` on its
  // file system.
  static absl::StatusOr<std::unique_ptr<RevisionDraft>> Create(
      const std::string& directory, std::int64_t min_free_bytes);

  RevisionDraft(const RevisionDraft&) = delete;
  RevisionDraft& operator=(const RevisionDraft&) = delete;

  // RESOURCE_EXHAUSTED (STORAGE_FULL) if poses are not to be added now.
  absl::Status CheckRoom() { return space_->Check(); }

  // Whether the pose was added: a sequence that came before is not.
  absl::StatusOr<bool> AddPose(std::uint64_t sequence, const std::string& pose);
  std::int64_t pose_count() const { return pose_count_; }
  // First and last of the sequences. REQUIRES: there are poses.
  std::uint64_t first_sequence() const { return first_sequence_; }
  std::uint64_t last_sequence() const { return last_sequence_; }
  // The poses of [first, last], by sequence, until `visit` refuses.
  absl::Status ReadPoses(
      std::uint64_t first, std::uint64_t last,
      const std::function<absl::Status(std::uint64_t sequence,
                                       const std::string& pose)>& visit);

  // Adds a batch, whose revision is not kept.
  absl::Status AddBatch(const BatchRecord& batch);
  bool has_batches() const { return has_batches_; }
  // All batches by first sequence, until `take` refuses.
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
