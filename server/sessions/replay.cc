#include "server/sessions/replay.h"

#include <algorithm>
#include <chrono>
#include <optional>
#include <string>
#include <utility>
#include <vector>

#include "absl/strings/str_cat.h"
#include "core/drive/drive.h"
#include "core/search/search.h"
#include "server/sessions/snapshots.h"
#include "server/storage/storage.h"

namespace revisit::server {
namespace {

using absl::StrCat;

// Longest that one task replays batches before the strand lets others run.
constexpr std::chrono::milliseconds kReplaySlice{20};

// A write of this revision leaves that of the vehicle as it is.
constexpr std::uint64_t kNoRevision = 0;

}  // namespace

void Replayer::Load() {
  queue_->Hold();
  const absl::Status status = StartLoad();
  if (status.ok()) return;
  queue_->Release([&] {
    vehicle_->Leave(absl::IsNotFound(status) ? VehicleNotFound(vehicle_->id)
                                             : status);
  });
}

absl::Status Replayer::StartLoad() {
  const absl::StatusOr<VehicleRecord> record =
      vehicle_->storage->TakeVehicle(vehicle_->id);
  if (!record.ok()) return record.status();
  vehicle_->head.Found(record->key, record->epoch);
  absl::StatusOr<VehicleConfig> config = vehicle_->DecodeConfig(*record);
  if (!config.ok()) {
    TakeUnknown(*record, config.status());
    return absl::OkStatus();
  }
  vehicle_->head.set_durable_sequence(record->durable_sequence);
  vehicle_->head.set_checks(record->checks);
  MeasuredLoops measured;
  for (const PairKind kind : kPairKinds) {
    const absl::Status read = ReadPairs(
        *vehicle_, record->key, kind, config->drive.state_space,
        [this](const absl::Status& damage) {
          vehicle_->head.NoteDamage(damage);
        },
        &vehicle_->pairs, &measured);
    if (!read.ok()) return read;
  }
  const absl::Status looked = LookAtDeletedPairs();
  if (!looked.ok()) return looked;
  const bool is_sound = record->damage.ok() && !config->damaged;
  Start(*std::move(config), record->revision, /*is_load=*/true,
        std::move(measured), [this](const absl::Status& status) {
          if (status.ok()) {
            FinishLoad();
          } else {
            vehicle_->Leave(status);
          }
        });
  replay_->may_use_snapshot = is_sound;
  return absl::OkStatus();
}

void Replayer::FinishLoad() {
  const bool is_marked = vehicle_->head.config().damaged;
  if (is_marked) {
    vehicle_->head.NoteDamage(vehicle_->Corrupt(
        "damage was found in it before, although none is found now"));
  }
  if (!vehicle_->head.damage().ok()) {
    vehicle_->head.set_damage(Damaged(vehicle_->head.damage()));
    if (!is_marked) KeepMark();
  } else {
    TakeMarks();
  }
  vehicle_->Report();
}

void Replayer::KeepMark() {
  VehicleConfig marked = vehicle_->head.config();
  marked.damaged = true;
  queue_->Hold();
  vehicle_->storage->UpdateVehicle(
      vehicle_->head.key(), vehicle_->codec->EncodeVehicle(marked), kNoRevision,
      queue_->OnStrand([this, marked](const absl::Status& status) {
        if (status.ok()) {
          vehicle_->head.Adopt(marked, vehicle_->head.revision());
        }
        // Nothing but this mark was written, so that memory stays what it is;
        // the next load finds the damage again.
        if (absl::IsAborted(status)) vehicle_->NoteFailedWrite(status);
        queue_->Release([] {});
      }));
}

// Without its settings, a vehicle's poses cannot be read.
void Replayer::TakeUnknown(const VehicleRecord& record,
                           const absl::Status& cause) {
  vehicle_->head.LoseConfig();
  vehicle_->loaded.Take(
      std::make_unique<core::Drive>(vehicle_->head.config().drive), {}, {});
  vehicle_->head.Adopt(record.revision);
  vehicle_->head.set_damage(
      Damaged(record.damage.ok() ? cause : record.damage));
  vehicle_->Report();
  queue_->Release([] {});
}

absl::Status Replayer::Damaged(const absl::Status& cause) const {
  const std::string durable = StrCat(vehicle_->head.durable_sequence());
  const std::string remedy =
      vehicle_->head.config_is_known()
          ? StrCat(durable,
                   " poses before it are sound and can be read, writes and "
                   "searches are refused until an operator gives up the rest "
                   "(AcceptDataLoss with durable_sequence ",
                   durable, ") or deletes the vehicle")
          : "without its settings it can only be deleted";
  return Error(absl::StatusCode::kDataLoss, "STORE_CORRUPT",
               StrCat("vehicle '", vehicle_->id, "' is damaged: ",
                      std::string(cause.message()), "; ", remedy),
               {{"vehicle", vehicle_->id}, {"durable_sequence", durable}});
}

absl::Status Replayer::LookAtDeletedPairs() {
  const absl::StatusOr<std::vector<DeletedPairRecord>> all =
      vehicle_->storage->ListDeletedPairs(vehicle_->head.key());
  if (absl::IsDataLoss(all.status())) {
    vehicle_->head.NoteDamage(all.status());
    return absl::OkStatus();
  }
  if (!all.ok()) return all.status();
  for (const DeletedPairRecord& deleted : *all) {
    if (!deleted.pair.damage.ok()) {
      vehicle_->head.NoteDamage(deleted.pair.damage);
    }
  }
  return absl::OkStatus();
}

void Replayer::Rebuild(const VehicleConfig& config, std::uint64_t revision,
                       std::function<void(const absl::Status&)> then) {
  MeasuredLoops measured;
  for (const auto& [id, closure] : vehicle_->pairs.loop_closures()) {
    // Was found to decode when it was loaded or added.
    static_cast<void>(
        measured.Add(*vehicle_, config.drive.state_space, closure));
  }
  Start(config, revision, /*is_load=*/false, std::move(measured),
        [this, then = std::move(then)](const absl::Status& status) {
          if (!status.ok()) vehicle_->Leave(status);
          then(status);
        });
}

void Replayer::Start(VehicleConfig config, std::uint64_t revision, bool is_load,
                     MeasuredLoops measured,
                     std::function<void(const absl::Status&)> then) {
  queue_->Hold();
  replay_.emplace(Replay{DriveReplay(vehicle_, vehicle_->head.key(),
                                     std::move(config), std::move(measured)),
                         revision, is_load, std::move(then)});
  Post();
}

void Replayer::Post() {
  queue_->PostLong([this] { Continue(); });
}

void Replayer::Continue() {
  absl::StatusOr<bool> all = ReplaySome();
  if (all.ok() && !*all && gives_up_) all = ShuttingDown();
  if (all.ok() && !*all) {
    vehicle_->loaded.NoteInTheMaking(replay_->drive.drive());
    Post();
    return;
  }
  Finish(all.ok() ? FinishGraph() : all.status());
}

void Replayer::Finish(const absl::Status& status) {
  Replay done = *std::move(replay_);
  replay_.reset();
  queue_->set_store_lead(VehicleQueue::StoreLead::kNone);
  if (status.ok()) {
    vehicle_->loaded.Take(done.drive.TakeDrive(), done.drive.TakeJumps(),
                          {done.drive.parts(), done.drive.snapshot_sequence()});
    vehicle_->head.Adopt(done.drive.config(), done.revision);
  } else {
    vehicle_->loaded.NoteSize();
  }
  queue_->Release([&] { done.then(status); });
}

absl::StatusOr<bool> Replayer::ReplaySome() {
  // Counted from the first that was read: a store that answers late would leave
  // no time for more than that, and be asked again for each row.
  std::optional<std::chrono::steady_clock::time_point> pause;
  const auto is_time_left = [&pause] {
    const auto now = std::chrono::steady_clock::now();
    if (!pause) pause = now + kReplaySlice;
    return now < *pause;
  };
  if (replay_->may_use_snapshot) FindSnapshot();
  const absl::StatusOr<bool> all =
      replay_->drive.Continue(vehicle_->head.durable_sequence(), is_time_left);
  if (!replay_->is_load || !absl::IsDataLoss(all.status())) return all;
  if (replay_->drive.has_snapshot()) {
    // What is sound has to be known from the first pose on.
    replay_->drive.GiveUpSnapshot(std::string(all.status().message()));
    return false;
  }
  GoNoFurther(all.status());
  return true;
}

void Replayer::FindSnapshot() {
  replay_->may_use_snapshot = false;
  const SnapshotPolicy& policy = vehicle_->snapshots.policy();
  replay_->drive.FindSnapshot(
      vehicle_->head.durable_sequence(),
      {policy.poses > 0, [this, &policy](const std::string& cause) {
         if (!cause.empty() && policy.warn) {
           policy.warn(StrCat("vehicle '", vehicle_->id,
                              "' is loaded without its snapshot: ", cause));
         }
         DropSnapshot();
       }});
}

void Replayer::TakeMarks() {
  const SnapshotPolicy& policy = vehicle_->snapshots.policy();
  if (policy.poses == 0 || has_dropped_snapshot_) return;
  const absl::StatusOr<std::optional<std::string>> marks =
      vehicle_->storage->GetMarks(vehicle_->head.key());
  if (marks.ok() && !*marks) return;
  core::Search* const search = vehicle_->loaded.search();
  const bool are_usable =
      marks.ok() && DecodeMarks(**marks, vehicle_->head.config(), search);
  vehicle_->snapshots.MarksRead(search->marks_version(), are_usable);
  if (are_usable || !policy.warn) return;
  policy.warn(
      StrCat("vehicle '", vehicle_->id, "' is loaded without its marks: ",
             marks.ok() ? "they are of other settings or another version"
                        : std::string(marks.status().message())));
}

// Waits for nobody: what is written of it later comes behind.
void Replayer::DropSnapshot() {
  has_dropped_snapshot_ = true;
  vehicle_->storage->DropSnapshot(vehicle_->head.key(),
                                  [](const absl::Status&) {});
}

// Adds the pairs, and gives the graph its revision.
absl::Status Replayer::FinishGraph() {
  if (absl::Status status = CheckPairs(); !status.ok()) return status;
  DriveReplay& replay = replay_->drive;
  replay.AddPairs(vehicle_->pairs);
  if (replay.steps() >= replay_->revision) {
    const absl::Status status =
        vehicle_->Corrupt(StrCat("stored revision ", replay_->revision,
                                 " is less than the number of changes"));
    if (!replay_->is_load) return status;
    vehicle_->head.NoteDamage(status);
    replay_->revision = replay.steps() + 1;
  }
  return replay.SetRevision(replay_->revision);
}

// The poses from the next one on cannot be read. Each of them may have brought
// a revision, and those must not come again.
void Replayer::GoNoFurther(const absl::Status& cause) {
  vehicle_->head.NoteDamage(cause);
  const std::uint64_t sound = replay_->drive.next_sequence() - 1;
  replay_->revision =
      std::max(replay_->revision, replay_->drive.highest_revision()) +
      (vehicle_->head.durable_sequence() - sound);
  vehicle_->head.set_durable_sequence(sound);
}

// Checks that each pair names stored poses. A load drops pairs that do not; a
// rebuild fails with DATA_LOSS.
absl::Status Replayer::CheckPairs() {
  for (const PairKind kind : kPairKinds) {
    std::vector<std::string> unsound;
    for (const auto& [id, pair] : vehicle_->pairs.Of(kind)) {
      if (pair.matched_sequence >= 1 &&
          pair.query_sequence <= vehicle_->head.durable_sequence()) {
        continue;
      }
      const absl::Status status =
          vehicle_->Corrupt(StrCat("stored ", WordsOf(kind).noun, " '", id,
                                   "' names a pose that is not stored"));
      if (!replay_->is_load) return status;
      vehicle_->head.NoteDamage(status);
      unsound.push_back(id);
    }
    if (!unsound.empty()) vehicle_->pairs.Remove(kind, unsound);
  }
  return absl::OkStatus();
}

}  // namespace revisit::server
