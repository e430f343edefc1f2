#include "server/fleet/follower.h"

#include <cstddef>
#include <utility>

#include "core/drive/drive.h"
#include "server/sessions/vehicle_uid.h"
#include "server/storage/storage.h"

namespace revisit::server {

absl::StatusOr<bool> Follower::Continue(const VehicleRecord& record,
                                        const DriveReplay::GoOn& go_on) {
  if (!record.damage.ok()) return record.damage;
  if (followed_) {
    const absl::StatusOr<Reached> reached = Advance(record, go_on, &*followed_);
    if (!reached.ok()) return reached.status();
    if (*reached == Reached::kRow) Publish();
    if (*reached != Reached::kNeverWill) return *reached == Reached::kRow;
    // Its view serves on.
    followed_.reset();
  }
  if (!making_) {
    if (absl::Status begun = Begin(record); !begun.ok()) return begun;
    return false;
  }
  const absl::StatusOr<Reached> reached = Advance(record, go_on, &*making_);
  if (!reached.ok()) return reached.status();
  if (*reached == Reached::kNeverWill) making_.reset();
  if (*reached != Reached::kRow) return false;
  followed_ = std::exchange(making_, std::nullopt);
  series_ = NewUuid();
  Publish();
  return true;
}

absl::Status Follower::Begin(const VehicleRecord& record) {
  absl::StatusOr<VehicleConfig> config = vehicle_->DecodeConfig(record);
  if (!config.ok()) return config.status();
  if (config->damaged) return vehicle_->Corrupt("damage was found in it");
  Made made;
  made.key = record.key;
  made.payload = record.payload;
  made.begun_at = record.durable_sequence;
  made.revision = record.revision;
  MeasuredLoops measured;
  absl::Status damage;
  for (const PairKind kind : kPairKinds) {
    const absl::Status read = ReadPairs(
        *vehicle_, record.key, kind, config->drive.state_space,
        [&damage](const absl::Status& found) { damage = found; }, &made.pairs,
        &measured);
    if (!read.ok()) return read;
  }
  if (!damage.ok()) return damage;
  made.replay = std::make_unique<DriveReplay>(
      vehicle_, record.key, *std::move(config), std::move(measured));
  made.replay->FindSnapshot(record.durable_sequence, SnapshotUse());
  making_ = std::move(made);
  ++made_;
  return absl::OkStatus();
}

absl::StatusOr<Follower::Reached> Follower::Advance(
    const VehicleRecord& record, const DriveReplay::GoOn& go_on,
    Made* made) const {
  DriveReplay* const replay = made->replay.get();
  const std::uint64_t up_to =
      made->has_begun ? record.durable_sequence : made->begun_at;
  if (record.key != made->key || record.payload != made->payload ||
      record.durable_sequence < up_to ||
      record.durable_sequence + 1 < replay->next_sequence()) {
    return Reached::kNeverWill;
  }
  const absl::StatusOr<bool> all = replay->Continue(up_to, go_on);
  if (!all.ok()) return all.status();
  if (!*all) return Reached::kAgain;
  if (!made->has_begun) return FinishBegun(record, made);
  if (record.revision - made->revision != replay->rows() - made->rows) {
    return Reached::kNeverWill;
  }
  made->revision = record.revision;
  made->rows = replay->rows();
  return Reached::kRow;
}

// Poses and pairs were read at several moments. Whether nothing but poses has
// come meanwhile is seen once the row is read again.
absl::StatusOr<Follower::Reached> Follower::FinishBegun(
    const VehicleRecord& record, Made* made) const {
  for (const PairKind kind : kPairKinds) {
    for (const auto& [id, pair] : made->pairs.Of(kind)) {
      if (pair.matched_sequence < 1 ||
          pair.query_sequence > record.durable_sequence) {
        return vehicle_->Corrupt("a pair names a pose that is not stored");
      }
      if (pair.query_sequence >= made->replay->next_sequence()) {
        return Reached::kNeverWill;
      }
    }
  }
  made->replay->AddPairs(made->pairs);
  made->pairs = JudgedPairs();
  made->rows = made->replay->rows();
  made->has_begun = true;
  return Reached::kAgain;
}

std::int64_t Follower::bytes() const {
  std::size_t bytes = 0;
  for (const std::optional<Made>* made : {&followed_, &making_}) {
    if (*made) bytes += (*made)->replay->drive().bytes();
  }
  return static_cast<std::int64_t>(bytes);
}

void Follower::Publish() {
  if (history_ != nullptr && history_->series == series_ &&
      history_->revision == followed_->revision) {
    return;
  }
  const DriveReplay& replay = *followed_->replay;
  history_ = std::make_shared<const KnownHistory>(KnownHistory{
      vehicle_->id, followed_->key, replay.config(), followed_->revision,
      replay.next_sequence() - 1, series_, HistoryView(replay.drive())});
}

}  // namespace revisit::server
