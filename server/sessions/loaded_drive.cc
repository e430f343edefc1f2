#include "server/sessions/loaded_drive.h"

#include <algorithm>
#include <utility>

#include "core/drive/pose_graph.h"
#include "server/sessions/vehicle_uid.h"

namespace revisit::server {

std::vector<core::Jump> LoadedDrive::JumpsAt(std::uint64_t first,
                                             std::uint64_t last) const {
  const auto begin =
      std::lower_bound(jumps_.begin(), jumps_.end(), first,
                       [](const core::Jump& jump, std::uint64_t sequence) {
                         return jump.sequence < sequence;
                       });
  const auto end =
      std::upper_bound(begin, jumps_.end(), last,
                       [](std::uint64_t sequence, const core::Jump& jump) {
                         return sequence < jump.sequence;
                       });
  return {begin, end};
}

void LoadedDrive::Take(std::unique_ptr<core::Drive> drive,
                       std::vector<core::Jump> jumps, const Kept& kept) {
  drive_ = std::move(drive);
  ++series_;
  nodes_id_ = NewUuid();
  search_ = std::make_unique<core::Search>(drive_.get());
  jumps_ = std::move(jumps);
  snapshots_->Begin(*drive_, kept.parts, kept.sequence);
  LookLater();
  NoteSize();
}

bool LoadedDrive::is_worth_a_look() const {
  return drive_->graph().size() >= look_at_;
}

core::AppendResult LoadedDrive::Append(
    const std::vector<core::PoseSample>& samples, std::uint64_t revision) {
  core::AppendResult applied = drive_->Append(samples, revision);
  jumps_.insert(jumps_.end(), applied.jumps.begin(), applied.jumps.end());
  NoteSize();
  return applied;
}

void LoadedDrive::LookLater() {
  const core::NodeIndex nodes = drive_->graph().size();
  look_at_ = kLeastLookedAt;
  while (look_at_ <= nodes) look_at_ += look_at_ / 10;
}

void LoadedDrive::NoteSize() { Count(nullptr); }

void LoadedDrive::Count(const core::Drive* in_the_making) {
  std::int64_t nodes = 0;
  std::int64_t bytes = 0;
  for (const core::Drive* const each :
       {static_cast<const core::Drive*>(drive_.get()), in_the_making}) {
    if (each == nullptr) continue;
    nodes += each->graph().size();
    bytes += static_cast<std::int64_t>(each->bytes());
  }
  resident_nodes_.store(nodes);
  resident_bytes_.store(bytes);
  if (drive_) snapshots_->See(*drive_);
}

}  // namespace revisit::server
