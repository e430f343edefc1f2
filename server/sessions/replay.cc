#include "server/sessions/replay.h"

#include <algorithm>
#include <chrono>
#include <cstddef>
#include <string>
#include <utility>

#include "absl/strings/str_cat.h"
#include "core/drive/measured_loop.h"
#include "core/drive/recordings.h"
#include "core/geometry/recording_start.h"
#include "core/settings.h"
#include "server/sessions/snapshots.h"
#include "server/storage/storage.h"

namespace revisit::server {
namespace {

using absl::StrCat;

// Longest that one task replays batches before the strand lets others run.
constexpr std::chrono::milliseconds kReplaySlice{20};

constexpr int kPairsPerRead = 1000;

// A write of this revision leaves that of the vehicle as it is.
constexpr std::uint64_t kNoRevision = 0;

}  // namespace

void AddPair(core::Drive* drive, PairKind kind, const PosePairRecord& pair,
             std::uint64_t revision,
             std::shared_ptr<const core::MeasuredLoop> measured) {
  if (kind == PairKind::kLoopClosure) {
    drive->AddLoopClosure(pair.query_sequence, pair.matched_sequence, revision,
                          std::move(measured));
  } else {
    drive->AddRejection(pair.query_sequence, pair.matched_sequence, revision);
  }
}

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
  absl::StatusOr<VehicleConfig> config = StoredConfig(*record);
  if (!config.ok()) {
    TakeUnknown(*record, config.status());
    return absl::OkStatus();
  }
  vehicle_->head.set_durable_sequence(record->durable_sequence);
  vehicle_->head.set_checks(record->checks);
  MeasuredLoops measured;
  for (const PairKind kind : kPairKinds) {
    const absl::Status read =
        LoadPairs(kind, config->drive.state_space, &measured);
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

absl::StatusOr<VehicleConfig> Replayer::StoredConfig(
    const VehicleRecord& record) const {
  absl::StatusOr<VehicleConfig> config = vehicle_->codec->DecodeVehicle(record);
  if (!config.ok()) return config;
  const std::vector<core::SettingProblem> problems =
      core::FindProblems(config->drive);
  if (!problems.empty()) {
    return vehicle_->Corrupt(StrCat("stored settings: ", problems.front().field,
                                    ": ", problems.front().description));
  }
  return config;
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

absl::Status Replayer::LoadPairs(PairKind kind, core::StateSpace space,
                                 MeasuredLoops* measured) {
  std::string after;
  while (true) {
    const absl::StatusOr<std::vector<PosePairRecord>> page =
        vehicle_->storage->ListPosePairs(vehicle_->head.key(), kind, after,
                                         kPairsPerRead);
    if (absl::IsDataLoss(page.status())) {
      vehicle_->head.NoteDamage(page.status());
      return absl::OkStatus();
    }
    if (!page.ok()) return page.status();
    if (page->empty()) return absl::OkStatus();
    after = page->back().id;
    for (const PosePairRecord& pair : *page) {
      const absl::Status sound = TakePair(kind, space, pair, measured);
      if (!sound.ok()) vehicle_->head.NoteDamage(sound);
    }
  }
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

// Nothing was measured of rejected candidates: they are only seen to decode.
absl::Status Replayer::TakePair(PairKind kind, core::StateSpace space,
                                const PosePairRecord& pair,
                                MeasuredLoops* measured) {
  if (!pair.damage.ok()) return pair.damage;
  MeasuredLoops none;
  MeasuredLoops* const take = kind == PairKind::kLoopClosure ? measured : &none;
  if (!take->Add(*vehicle_, space, pair).ok()) {
    return vehicle_->Corrupt(StrCat("stored ", WordsOf(kind).noun, " '",
                                    pair.id, "' does not decode"));
  }
  vehicle_->pairs.Add(kind, pair);
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
  replay_.emplace();
  replay_->config = std::move(config);
  replay_->revision = revision;
  replay_->is_load = is_load;
  replay_->measured = std::move(measured);
  replay_->then = std::move(then);
  replay_->drive = std::make_unique<core::Drive>(replay_->config.drive);
  Post();
}

void Replayer::Post() {
  queue_->PostLong([this] { Continue(); });
}

void Replayer::Continue() {
  absl::StatusOr<bool> all = ReplaySome();
  if (all.ok() && !*all && gives_up_) all = ShuttingDown();
  if (all.ok() && !*all) {
    vehicle_->loaded.NoteInTheMaking(*replay_->drive);
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
    vehicle_->loaded.Take(
        std::move(done.drive), std::move(done.jumps),
        {done.parts, done.snapshot ? done.snapshot->last_sequence : 0});
    vehicle_->head.Adopt(done.config, done.revision);
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
  if (replay_->snapshot && !LoadSnapshot(is_time_left)) return false;
  return ReplayBatches(is_time_left);
}

void Replayer::FindSnapshot() {
  replay_->may_use_snapshot = false;
  if (!vehicle_->storage->KeepsSnapshots()) return;
  absl::StatusOr<std::optional<SnapshotRecord>> found =
      vehicle_->storage->GetSnapshot(vehicle_->head.key());
  if (!found.ok()) {
    GiveUpSnapshot(std::string(found.status().message()));
  } else if (*found && vehicle_->snapshots.policy().poses == 0) {
    DropSnapshot();
  } else if (*found &&
             (*found)->last_sequence > vehicle_->head.durable_sequence()) {
    GiveUpSnapshot("it has poses that are not stored");
  } else {
    replay_->snapshot = *std::move(found);
  }
}

bool Replayer::LoadSnapshot(const std::function<bool()>& is_time_left) {
  const SnapshotRecord& snapshot = *replay_->snapshot;
  if (replay_->parts < snapshot.part_count) {
    bool is_usable = true;
    const absl::Status reading = vehicle_->storage->ReadSnapshotParts(
        vehicle_->head.key(), replay_->parts, snapshot.part_count,
        [&](absl::string_view part) {
          is_usable = replay_->drive->LoadPart(part);
          if (is_usable) ++replay_->parts;
          return is_usable && is_time_left();
        });
    if (!reading.ok() || !is_usable) {
      GiveUpSnapshot(reading.ok()
                         ? "its parts are of other settings or another version"
                         : std::string(reading.message()));
      return true;
    }
    if (replay_->parts < snapshot.part_count) return false;
  }
  if (!replay_->has_rest) {
    if (!DecodeSnapshot(snapshot, replay_->config, &replay_->jumps,
                        replay_->drive.get())) {
      GiveUpSnapshot("it is of other settings or another version");
      return true;
    }
    replay_->has_rest = true;
    replay_->next_sequence = snapshot.last_sequence + 1;
  }
  const absl::StatusOr<bool> measured = replay_->measured.ReadPoses(
      *vehicle_, replay_->config, snapshot.last_sequence, is_time_left);
  if (!measured.ok()) {
    GiveUpSnapshot(std::string(measured.status().message()));
    return true;
  }
  return *measured;
}

void Replayer::GiveUpSnapshot(const std::string& cause) {
  if (vehicle_->snapshots.policy().warn) {
    vehicle_->snapshots.policy().warn(
        StrCat("vehicle '", vehicle_->id,
               "' is loaded without its snapshot: ", cause));
  }
  DropSnapshot();
  replay_->snapshot.reset();
  replay_->parts = 0;
  replay_->has_rest = false;
  replay_->drive = std::make_unique<core::Drive>(replay_->config.drive);
  replay_->jumps.clear();
  replay_->next_sequence = 1;
  replay_->steps = 0;
}

// Waits for nobody: what is written of it later comes behind.
void Replayer::DropSnapshot() {
  vehicle_->storage->DropSnapshot(vehicle_->head.key(),
                                  [](const absl::Status&) {});
}

absl::StatusOr<bool> Replayer::ReplayBatches(
    const std::function<bool()>& is_time_left) {
  if (replay_->next_sequence > vehicle_->head.durable_sequence()) return true;
  absl::Status decoding;
  const absl::Status reading = vehicle_->storage->ReadBatches(
      vehicle_->head.key(), replay_->next_sequence,
      vehicle_->head.durable_sequence(), BatchVersion::kCurrent,
      [&](const BatchRecord& batch) {
        decoding = ReplayBatch(batch);
        return decoding.ok() && is_time_left();
      });
  const absl::Status& unread = reading.ok() ? decoding : reading;
  if (replay_->is_load && absl::IsDataLoss(unread) && replay_->snapshot) {
    // What is sound has to be known from the first pose on.
    GiveUpSnapshot(std::string(unread.message()));
    return false;
  }
  if (replay_->is_load && absl::IsDataLoss(unread)) {
    GoNoFurther(unread);
  } else if (!unread.ok()) {
    return unread;
  }
  return replay_->next_sequence > vehicle_->head.durable_sequence();
}

absl::Status Replayer::ReplayBatch(const BatchRecord& batch) {
  absl::StatusOr<DecodedPoses> poses =
      vehicle_->DecodeStoredPoses(batch, replay_->config);
  if (!poses.ok()) return poses.status();
  const auto known = static_cast<std::ptrdiff_t>(replay_->next_sequence -
                                                 batch.first_sequence);
  if (poses->dropped) {
    if (known > 0) {
      return vehicle_->Corrupt("the snapshot ends within dropped poses");
    }
    replay_->drive->Skip(*poses->dropped, ++replay_->steps);
  } else {
    replay_->measured.Take(poses->samples);
    // A snapshot may end within a row, which several batches share.
    poses->samples.erase(poses->samples.begin(),
                         poses->samples.begin() + known);
    if (replay_->drive->recordings().size() + poses->recordings_begun() >
        core::kMostRecordings) {
      return vehicle_->Corrupt(StrCat("stored poses from sequence ",
                                      replay_->next_sequence, " on begin more ",
                                      "recordings than a vehicle may have"));
    }
    const core::AppendResult applied =
        replay_->drive->Append(poses->samples, ++replay_->steps);
    replay_->jumps.insert(replay_->jumps.end(), applied.jumps.begin(),
                          applied.jumps.end());
  }
  replay_->highest_revision =
      std::max(replay_->highest_revision, batch.revision);
  replay_->next_sequence = batch.first_sequence + batch.count;
  return absl::OkStatus();
}

// Adds the pairs, and gives the graph its revision.
absl::Status Replayer::FinishGraph() {
  if (absl::Status status = CheckPairs(); !status.ok()) return status;
  for (const auto& [kind, pair] : vehicle_->pairs.AsAdded()) {
    AddPair(replay_->drive.get(), kind, *pair, ++replay_->steps,
            kind == PairKind::kLoopClosure ? replay_->measured.Find(*pair)
                                           : nullptr);
  }
  if (replay_->steps >= replay_->revision) {
    const absl::Status status =
        vehicle_->Corrupt(StrCat("stored revision ", replay_->revision,
                                 " is less than the number of changes"));
    if (!replay_->is_load) return status;
    vehicle_->head.NoteDamage(status);
    replay_->revision = replay_->steps + 1;
  }
  return replay_->drive->ChangeSettings(replay_->config.drive,
                                        replay_->revision);
}

// The poses from the next one on cannot be read. Each of them may have brought
// a revision, and those must not come again.
void Replayer::GoNoFurther(const absl::Status& cause) {
  vehicle_->head.NoteDamage(cause);
  const std::uint64_t sound = replay_->next_sequence - 1;
  replay_->revision = std::max(replay_->revision, replay_->highest_revision) +
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
