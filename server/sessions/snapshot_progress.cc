#include "server/sessions/snapshot_progress.h"

#include <algorithm>

#include "core/drive/pose_graph.h"

namespace revisit::server {

void SnapshotProgress::See(const core::Drive& drive) {
  const std::uint64_t poses = drive.last_sequence();
  const bool is_worth_it =
      static_cast<double>(drive.graph().size()) <=
      policy_.most_nodes_per_pose * static_cast<double>(poses);
  poses_since_ = is_worth_it ? poses - sequence_ : 0;
}

void SnapshotProgress::Begin(const core::Drive& drive, std::uint32_t parts,
                             std::uint64_t sequence) {
  KeepParts(drive.StateKey(), parts);
  sequence_ = sequence;
}

void SnapshotProgress::BeginUnlessKept(const core::Drive& drive) {
  const std::string key = drive.StateKey();
  if (state_key_ != key) KeepParts(key, 0);
}

void SnapshotProgress::PartWritten(std::uint32_t number, std::uint64_t series) {
  if (series_ == series) parts_ = std::max(parts_, number + 1);
}

void SnapshotProgress::Written(const core::Drive& drive, std::uint64_t sequence,
                               std::uint64_t series) {
  if (series_ != series) return;
  sequence_ = sequence;
  See(drive);
}

void SnapshotProgress::Forget() { KeepParts("", 0); }

void SnapshotProgress::PutOff(const core::Drive& drive) {
  sequence_ = drive.last_sequence();
  See(drive);
}

void SnapshotProgress::KeepParts(const std::string& state_key,
                                 std::uint32_t parts) {
  state_key_ = state_key;
  parts_ = parts;
  ++series_;
}

}  // namespace revisit::server
