#include "server/sessions/snapshot_progress.h"

#include <algorithm>
#include <limits>

#include "core/drive/pose_graph.h"

namespace revisit::server {
namespace {

// Marks that the store has and that are to be replaced, by none if no others
// are learned.
constexpr std::uint64_t kUnusable = std::numeric_limits<std::uint64_t>::max();

}  // namespace

void SnapshotProgress::See(const core::Drive& drive) {
  const std::uint64_t poses = drive.last_sequence();
  const bool is_worth_it =
      static_cast<double>(drive.graph().size()) <=
      policy_.most_nodes_per_pose * static_cast<double>(poses);
  poses_since_ = is_worth_it ? poses - sequence_ : 0;
}

void SnapshotProgress::Begin(const core::Drive& drive, std::uint32_t parts,
                             std::uint64_t sequence) {
  // Nothing was searched yet.
  marks_ = 0;
  KeepParts(drive.StateKey(), parts);
  sequence_ = sequence;
}

void SnapshotProgress::BeginUnlessKept(const core::Drive& drive) {
  const std::string key = drive.StateKey();
  if (state_key_ != key) KeepParts(key, 0);
}

void SnapshotProgress::PartWritten(std::uint32_t number, std::uint64_t series) {
  if (series_ != series) return;
  parts_ = std::max(parts_, number + 1);
  if (number == 0) KeepMarks(0);
}

void SnapshotProgress::Written(const core::Drive& drive, std::uint64_t sequence,
                               std::uint64_t series) {
  if (series_ != series) return;
  sequence_ = sequence;
  See(drive);
}

void SnapshotProgress::SeeMarks(std::uint64_t version) {
  marks_ = version;
  KeepMarks(stored_marks_);
}

void SnapshotProgress::MarksRead(std::uint64_t version, bool are_usable) {
  marks_ = version;
  KeepMarks(are_usable ? version : kUnusable);
}

void SnapshotProgress::MarksTried(std::uint64_t version, std::uint64_t series) {
  if (series_ == series) KeepMarks(version);
}

void SnapshotProgress::Forget() { KeepParts("", 0); }

void SnapshotProgress::PutOff(const core::Drive& drive) {
  sequence_ = drive.last_sequence();
  See(drive);
  KeepMarks(marks_);
}

void SnapshotProgress::KeepParts(const std::string& state_key,
                                 std::uint32_t parts) {
  state_key_ = state_key;
  parts_ = parts;
  ++series_;
  KeepMarks(0);
}

void SnapshotProgress::KeepMarks(std::uint64_t version) {
  stored_marks_ = version;
  has_new_marks_ = policy_.poses > 0 && marks_ != version;
}

}  // namespace revisit::server
