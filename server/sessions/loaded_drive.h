// The drive of one vehicle in memory, and what is kept beside it.
#ifndef REVISIT_SERVER_SESSIONS_LOADED_DRIVE_H_
#define REVISIT_SERVER_SESSIONS_LOADED_DRIVE_H_

#include <atomic>
#include <cstdint>
#include <memory>
#include <string>
#include <vector>

#include "core/drive/drive.h"
#include "core/search/search.h"
#include "server/sessions/snapshot_progress.h"

namespace revisit::server {

// Graphs of fewer nodes are not worth a look for what to drop.
inline constexpr core::NodeIndex kLeastLookedAt = 1000;

// Belongs to the session's strand, but for resident_nodes() and
// resident_bytes(). Tells the progress of snapshots of every change.
class LoadedDrive {
 public:
  explicit LoadedDrive(SnapshotProgress* snapshots) : snapshots_(snapshots) {}

  // False until the vehicle was loaded.
  explicit operator bool() const { return drive_ != nullptr; }
  // REQUIRES, like all that follows but for Take() and NoteInTheMaking(): there
  // is one.
  const core::Drive& operator*() const { return *drive_; }
  const core::Drive* operator->() const { return drive_.get(); }
  // Asks this drive.
  core::Search* search() const { return search_.get(); }
  // Grows whenever the drive is another.
  std::uint64_t series() const { return series_; }
  // As series(), but differs from those of all vehicles and servers too: while
  // it is the same, nodes are only added.
  const std::string& nodes_id() const { return nodes_id_; }
  // The jumps of the drive, by sequence; those of [first, last].
  const std::vector<core::Jump>& jumps() const { return jumps_; }
  std::vector<core::Jump> JumpsAt(std::uint64_t first,
                                  std::uint64_t last) const;

  // The part of a drive's snapshot that the store has: see
  // SnapshotProgress::Begin().
  struct Kept {
    std::uint32_t parts = 0;
    std::uint64_t sequence = 0;
  };
  // Replaces the drive. The pose dropper looks at it once it has grown.
  void Take(std::unique_ptr<core::Drive> drive, std::vector<core::Jump> jumps,
            const Kept& kept);
  core::AppendResult Append(const std::vector<core::PoseSample>& samples,
                            std::uint64_t revision);
  // Changes the drive: calls `apply(&drive)`.
  template <typename Apply>
  void Change(Apply apply) {
    apply(drive_.get());
    NoteSize();
  }

  // Call after every search.
  void NoteSearched() { snapshots_->SeeMarks(search_->marks_version()); }

  // ---- When the drive is looked at for what to drop (pose_dropper.h)

  bool is_worth_a_look() const;
  void LookAtOnce() { look_at_ = 0; }
  // The next look is when there are a tenth more nodes: the same whenever the
  // vehicle was loaded.
  void LookLater();

  // ---- Memory: see VehicleSession::Residency

  // A drive that will take the place of this one takes memory too.
  void NoteInTheMaking(const core::Drive& other) { Count(&other); }
  // There is no other any more.
  void NoteSize();
  std::int64_t resident_nodes() const { return resident_nodes_.load(); }
  std::int64_t resident_bytes() const { return resident_bytes_.load(); }

 private:
  void Count(const core::Drive* in_the_making);

  SnapshotProgress* const snapshots_;
  std::unique_ptr<core::Drive> drive_;
  std::unique_ptr<core::Search> search_;
  std::uint64_t series_ = 0;
  std::string nodes_id_;
  std::vector<core::Jump> jumps_;
  // Nodes with which the drive is looked at for what to drop.
  core::NodeIndex look_at_ = 0;
  std::atomic<std::int64_t> resident_nodes_{0};
  std::atomic<std::int64_t> resident_bytes_{0};
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_SESSIONS_LOADED_DRIVE_H_
