#include "server/sessions/drive_replay.h"

#include <algorithm>
#include <utility>

#include "absl/strings/str_cat.h"
#include "core/drive/recordings.h"
#include "core/geometry/recording_start.h"
#include "server/sessions/snapshots.h"
#include "server/storage/storage.h"

namespace revisit::server {
namespace {

using absl::StrCat;

constexpr int kPairsPerRead = 1000;

// Takes a pair, or says what is wrong with it. Nothing was measured of rejected
// candidates: they are only seen to decode.
absl::Status TakePair(const VehicleReader& vehicle, PairKind kind,
                      core::StateSpace space, const PosePairRecord& pair,
                      JudgedPairs* pairs, MeasuredLoops* measured) {
  if (!pair.damage.ok()) return pair.damage;
  MeasuredLoops none;
  MeasuredLoops* const take = kind == PairKind::kLoopClosure ? measured : &none;
  if (!take->Add(vehicle, space, pair).ok()) {
    return vehicle.Corrupt(StrCat("stored ", WordsOf(kind).noun, " '", pair.id,
                                  "' does not decode"));
  }
  pairs->Add(kind, pair);
  return absl::OkStatus();
}

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

absl::Status ReadPairs(
    const VehicleReader& vehicle, VehicleKey key, PairKind kind,
    core::StateSpace space,
    const std::function<void(const absl::Status&)>& note_damage,
    JudgedPairs* pairs, MeasuredLoops* measured) {
  std::string after;
  while (true) {
    const absl::StatusOr<std::vector<PosePairRecord>> page =
        vehicle.storage->ListPosePairs(key, kind, after, kPairsPerRead);
    if (absl::IsDataLoss(page.status())) {
      note_damage(page.status());
      return absl::OkStatus();
    }
    if (!page.ok()) return page.status();
    if (page->empty()) return absl::OkStatus();
    after = page->back().id;
    for (const PosePairRecord& pair : *page) {
      const absl::Status sound =
          TakePair(vehicle, kind, space, pair, pairs, measured);
      if (!sound.ok()) note_damage(sound);
    }
  }
}

DriveReplay::DriveReplay(const VehicleReader* vehicle, VehicleKey key,
                         VehicleConfig config, MeasuredLoops measured)
    : vehicle_(vehicle),
      key_(key),
      config_(std::move(config)),
      measured_(std::move(measured)),
      drive_(std::make_unique<core::Drive>(config_.drive)) {}

void DriveReplay::FindSnapshot(std::uint64_t last, SnapshotUse use) {
  snapshot_use_ = std::move(use);
  if (!vehicle_->storage->KeepsSnapshots()) return;
  absl::StatusOr<std::optional<SnapshotRecord>> found =
      vehicle_->storage->GetSnapshot(key_);
  if (!found.ok()) {
    GiveUpSnapshot(std::string(found.status().message()));
  } else if (*found && !snapshot_use_.is_wanted) {
    if (snapshot_use_.left) snapshot_use_.left("");
  } else if (*found && (*found)->last_sequence > last) {
    GiveUpSnapshot("it has poses that are not stored");
  } else {
    snapshot_ = *std::move(found);
  }
}

absl::StatusOr<bool> DriveReplay::Continue(std::uint64_t last,
                                           const GoOn& go_on) {
  if (snapshot_ && !has_measured_ && !LoadSnapshot(go_on)) return false;
  return ReplayBatches(last, go_on);
}

bool DriveReplay::LoadSnapshot(const GoOn& go_on) {
  if (parts_ < snapshot_->part_count) {
    bool is_usable = true;
    const absl::Status reading = vehicle_->storage->ReadSnapshotParts(
        key_, parts_, snapshot_->part_count, [&](absl::string_view part) {
          is_usable = drive_->LoadPart(part);
          if (is_usable) ++parts_;
          return is_usable && go_on();
        });
    if (!reading.ok() || !is_usable) {
      GiveUpSnapshot(reading.ok()
                         ? "its parts are of other settings or another version"
                         : std::string(reading.message()));
      return true;
    }
    if (parts_ < snapshot_->part_count) return false;
  }
  if (!has_rest_) {
    if (!DecodeSnapshot(*snapshot_, config_, &jumps_, drive_.get())) {
      GiveUpSnapshot("it is of other settings or another version");
      return true;
    }
    has_rest_ = true;
    next_sequence_ = snapshot_->last_sequence + 1;
  }
  const absl::StatusOr<bool> measured = measured_.ReadPoses(
      *vehicle_, key_, config_, snapshot_->last_sequence, go_on);
  if (!measured.ok()) {
    GiveUpSnapshot(std::string(measured.status().message()));
    return true;
  }
  has_measured_ = *measured;
  return has_measured_;
}

void DriveReplay::GiveUpSnapshot(const std::string& cause) {
  if (snapshot_use_.left) snapshot_use_.left(cause);
  snapshot_.reset();
  parts_ = 0;
  has_rest_ = false;
  has_measured_ = false;
  drive_ = std::make_unique<core::Drive>(config_.drive);
  jumps_.clear();
  next_sequence_ = 1;
  steps_ = 0;
}

absl::StatusOr<bool> DriveReplay::ReplayBatches(std::uint64_t last,
                                                const GoOn& go_on) {
  if (next_sequence_ > last) return true;
  absl::Status decoding;
  const absl::Status reading = vehicle_->storage->ReadBatches(
      key_, next_sequence_, last, BatchVersion::kCurrent,
      [&](const BatchRecord& batch) {
        decoding = ReplayBatch(batch);
        return decoding.ok() && go_on();
      });
  if (!reading.ok()) return reading;
  if (!decoding.ok()) return decoding;
  return next_sequence_ > last;
}

absl::Status DriveReplay::ReplayBatch(const BatchRecord& batch) {
  absl::StatusOr<DecodedPoses> poses =
      vehicle_->DecodeStoredPoses(batch, config_);
  if (!poses.ok()) return poses.status();
  const auto known =
      static_cast<std::ptrdiff_t>(next_sequence_ - batch.first_sequence);
  if (poses->dropped) {
    if (known > 0) {
      return vehicle_->Corrupt("the snapshot ends within dropped poses");
    }
    drive_->Skip(*poses->dropped, ++steps_);
  } else {
    measured_.Take(poses->samples);
    // A snapshot may end within a row, which several batches share.
    poses->samples.erase(poses->samples.begin(),
                         poses->samples.begin() + known);
    if (drive_->recordings().size() + poses->recordings_begun() >
        core::kMostRecordings) {
      return vehicle_->Corrupt(StrCat("stored poses from sequence ",
                                      next_sequence_, " on begin more ",
                                      "recordings than a vehicle may have"));
    }
    const core::AppendResult applied = drive_->Append(poses->samples, ++steps_);
    jumps_.insert(jumps_.end(), applied.jumps.begin(), applied.jumps.end());
  }
  ++rows_;
  highest_revision_ = std::max(highest_revision_, batch.revision);
  next_sequence_ = batch.first_sequence + batch.count;
  return absl::OkStatus();
}

void DriveReplay::AddPairs(const JudgedPairs& pairs) {
  for (const auto& [kind, pair] : pairs.AsAdded()) {
    AddPair(drive_.get(), kind, *pair, ++steps_,
            kind == PairKind::kLoopClosure ? measured_.Find(*pair) : nullptr);
  }
}

}  // namespace revisit::server
