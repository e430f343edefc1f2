// How far the snapshot of one drive has come: what the store has of it, and
// when the next one is due.
#ifndef REVISIT_SERVER_SESSIONS_SNAPSHOT_PROGRESS_H_
#define REVISIT_SERVER_SESSIONS_SNAPSHOT_PROGRESS_H_

#include <atomic>
#include <cstdint>
#include <functional>
#include <limits>
#include <string>
#include <utility>

#include "core/drive/drive.h"

namespace revisit::server {

// When graphs are kept as snapshots (snapshots.h).
struct SnapshotPolicy {
  // A snapshot is due once so many poses have come since the last one; 0: none
  // is written or used, and those that are there are removed; marks are neither
  // written nor used.
  std::uint64_t poses = 0;
  // None is written of a graph that has more nodes for each pose: a snapshot is
  // as large as its nodes, and where many servers read from one store, the
  // poses are read sooner.
  double most_nodes_per_pose = std::numeric_limits<double>::infinity();
  // Called with what an operator should know; may be empty.
  std::function<void(const std::string&)> warn;
};

// Beside it, what searches have learned from marks (core::Search::SaveMarks()):
// it goes where the parts begin anew.
//
// Belongs to the session's strand, but for is_due() and has_new_marks().
class SnapshotProgress {
 public:
  explicit SnapshotProgress(SnapshotPolicy policy)
      : policy_(std::move(policy)) {}

  const SnapshotPolicy& policy() const { return policy_; }

  // From any thread: whether as many poses have come since the last snapshot as
  // the policy says.
  bool is_due() const {
    return policy_.poses > 0 && poses_since_ >= policy_.poses;
  }

  // From any thread: whether the store lacks marks that searches have learned.
  bool has_new_marks() const { return has_new_marks_; }

  // How many parts the store has of the drive, from the first on.
  std::uint32_t parts() const { return parts_; }
  // Grows whenever the parts are others, so that an answer of the storage is
  // known to be about these.
  std::uint64_t series() const { return series_; }

  // Call after every change of the drive.
  void See(const core::Drive& drive);

  // The drive is another, of which the store has these parts, and a snapshot up
  // to this pose; 0 if it has none. See() has to follow.
  void Begin(const core::Drive& drive, std::uint32_t parts,
             std::uint64_t sequence);
  // Begins with the first part, unless those that are kept are of this drive as
  // it is now.
  void BeginUnlessKept(const core::Drive& drive);
  // A part was written while the series was this one.
  void PartWritten(std::uint32_t number, std::uint64_t series);
  // A snapshot up to this pose was written while the series was this one.
  void Written(const core::Drive& drive, std::uint64_t sequence,
               std::uint64_t series);
  // Call after every search of the drive, with core::Search::marks_version().
  void SeeMarks(std::uint64_t version);
  // The marks of this version were read from the store; false: what it has of
  // them is of no use.
  void MarksRead(std::uint64_t version, bool are_usable);
  // They were written, or tried to be, while the series was this one.
  void MarksTried(std::uint64_t version, std::uint64_t series);

  // The store may have other parts than it had: the next snapshot begins with
  // the first part.
  void Forget();
  // No other is due before more poses have come, and no marks before more are
  // learned.
  void PutOff(const core::Drive& drive);

 private:
  void KeepParts(const std::string& state_key, std::uint32_t parts);
  void KeepMarks(std::uint64_t version);

  const SnapshotPolicy policy_;
  // core::Drive::StateKey() of the parts.
  std::string state_key_;
  std::uint32_t parts_ = 0;
  std::uint64_t series_ = 0;
  // The pose up to which there is a snapshot, or was tried to be.
  std::uint64_t sequence_ = 0;
  std::atomic<std::uint64_t> poses_since_{0};
  // The version of the marks that searches know, and of those that the store
  // has, or was tried to be given; 0 if it has none.
  std::uint64_t marks_ = 0;
  std::uint64_t stored_marks_ = 0;
  std::atomic<bool> has_new_marks_{false};
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_SESSIONS_SNAPSHOT_PROGRESS_H_
