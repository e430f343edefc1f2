#include "server/sessions/snapshots.h"

#include <algorithm>
#include <limits>
#include <optional>
#include <utility>

#include "core/base/byte_stream.h"
#include "server/storage/storage.h"

namespace revisit::server {
namespace {

constexpr std::uint32_t kPayloadVersion = 1;

// The mark with which a payload begins.
std::string Heading(const VehicleConfig& config) {
  core::ByteWriter writer;
  writer.Put(kPayloadVersion);
  writer.PutCounted(config.uid.data(), config.uid.size());
  writer.Put(static_cast<std::uint32_t>(config.frame));
  writer.PutOptional(config.origin);
  return writer.Take();
}

}  // namespace

std::string EncodeSnapshot(const VehicleConfig& config,
                           const std::vector<core::Jump>& jumps,
                           const core::Drive& drive, std::uint32_t parts) {
  const std::string heading = Heading(config);
  const std::string rest = drive.SaveRest(parts);
  core::ByteWriter writer;
  writer.Reserve(heading.size() + rest.size() +
                 (jumps.size() + 1) * sizeof(core::Jump));
  writer.PutArray(heading.data(), heading.size());
  writer.PutCounted(jumps.data(), jumps.size());
  writer.PutArray(rest.data(), rest.size());
  return writer.Take();
}

bool DecodeSnapshot(const SnapshotRecord& snapshot, const VehicleConfig& config,
                    std::vector<core::Jump>* jumps, core::Drive* drive) {
  core::ByteReader reader(snapshot.payload);
  const std::string expected = Heading(config);
  std::string heading(expected.size(), '\0');
  jumps->clear();
  return reader.GetArray(heading.data(), heading.size()) &&
         heading == expected &&
         reader.GetCounted(snapshot.payload.size(), jumps) &&
         drive->LoadRest(reader.rest()) &&
         drive->last_sequence() == snapshot.last_sequence;
}

bool Snapshots::is_due() const {
  const std::uint64_t poses = vehicle_->snapshot_policy.poses;
  return poses > 0 && vehicle_->poses_since_snapshot >= poses &&
         vehicle_->storage->KeepsSnapshots();
}

void Snapshots::Write(int most_parts, std::function<void()> then) {
  ++writing_;
  Step(std::make_shared<Job>(Job{most_parts, std::move(then)}));
}

void Snapshots::Stop(Clock::time_point until, std::function<void()> then) {
  ++writing_;
  queue_->Post([this, until, then = std::move(then)] {
    until_ = until;
    stopped_ = then;
    const auto job =
        std::make_shared<Job>(Job{std::numeric_limits<int>::max(), [] {}});
    if (is_due()) {
      Step(job);
    } else {
      End(job);
    }
  });
}

// Waits while the store may show poses that the graph does not: from the moment
// at which a revision is handed to the storage until the graph has it, nothing
// of the graph before may follow.
void Snapshots::Step(const JobPtr& job) {
  queue_->SubmitLong(
      {Turn::kReadStored, [this, job](const absl::Status& status) {
         if (status.ok()) {
           WriteNext(job);
         } else {
           Fail(job);
         }
       }});
}

void Snapshots::WriteNext(const JobPtr& job) {
  if (!is_due() || Clock::now() >= until_) {
    End(job);
    return;
  }
  if (!MayWrite()) {
    Fail(job);
    return;
  }
  VehicleState::KeptSnapshot& kept = vehicle_->kept_snapshot;
  const std::string key = vehicle_->drive->StateKey();
  if (kept.state_key != key) {
    kept = {key, 0, kept.series + 1};
  }
  if (kept.parts >= vehicle_->drive->whole_parts()) {
    WriteRest(job);
  } else if (job->parts_left > 0) {
    --job->parts_left;
    WritePart(job);
  } else {
    End(job);
  }
}

bool Snapshots::MayWrite() const {
  return vehicle_->drive != nullptr && !vehicle_->in_doubt &&
         vehicle_->config_is_known && vehicle_->damage.ok();
}

void Snapshots::WritePart(const JobPtr& job) {
  const std::uint32_t number = vehicle_->kept_snapshot.parts;
  vehicle_->storage->PutSnapshotPart(
      vehicle_->key, number, vehicle_->drive->SavePart(number),
      queue_->OnStrand(
          [this, job, number, series = vehicle_->kept_snapshot.series](
              const absl::Status& status) {
            if (!status.ok()) {
              Fail(job);
              return;
            }
            VehicleState::KeptSnapshot& kept = vehicle_->kept_snapshot;
            if (kept.series == series)
              kept.parts = std::max(kept.parts, number + 1);
            Step(job);
          }));
}

void Snapshots::WriteRest(const JobPtr& job) {
  const VehicleState::KeptSnapshot& kept = vehicle_->kept_snapshot;
  SnapshotRecord snapshot;
  snapshot.last_sequence = vehicle_->drive->last_sequence();
  snapshot.part_count = kept.parts;
  snapshot.payload = EncodeSnapshot(vehicle_->config, vehicle_->jumps,
                                    *vehicle_->drive, kept.parts);
  vehicle_->storage->PutSnapshot(
      vehicle_->key, std::move(snapshot),
      queue_->OnStrand([this, job, sequence = vehicle_->drive->last_sequence(),
                        series = kept.series](const absl::Status& status) {
        if (!status.ok()) {
          Fail(job);
          return;
        }
        if (vehicle_->kept_snapshot.series == series) {
          vehicle_->NoteSnapshot(sequence);
        }
        End(job);
      }));
}

// Tries again once as many poses have come as make a snapshot due, from the
// first part on: what was written may be out of step with what is kept.
void Snapshots::Fail(const JobPtr& job) {
  VehicleState::KeptSnapshot& kept = vehicle_->kept_snapshot;
  kept = {"", 0, kept.series + 1};
  if (vehicle_->drive) vehicle_->NoteSnapshot(vehicle_->drive->last_sequence());
  End(job);
}

void Snapshots::End(const JobPtr& job) {
  const bool is_last = --writing_ == 0;
  job->then();
  if (is_last && stopped_) std::exchange(stopped_, nullptr)();
}

}  // namespace revisit::server
