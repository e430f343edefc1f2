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

bool ReadHeading(const VehicleConfig& config, core::ByteReader* reader) {
  const std::string expected = Heading(config);
  std::string heading(expected.size(), '\0');
  return reader->GetArray(heading.data(), heading.size()) &&
         heading == expected;
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
  jumps->clear();
  return ReadHeading(config, &reader) &&
         reader.GetCounted(snapshot.payload.size(), jumps) &&
         drive->LoadRest(reader.rest()) &&
         drive->last_sequence() == snapshot.last_sequence;
}

std::string EncodeMarks(const VehicleConfig& config, core::Search* search) {
  return Heading(config) + search->SaveMarks();
}

bool DecodeMarks(const std::string& marks, const VehicleConfig& config,
                 core::Search* search) {
  core::ByteReader reader(marks);
  return ReadHeading(config, &reader) && search->LoadMarks(reader.rest());
}

bool Snapshots::is_due() const {
  return vehicle_->snapshots.is_due() && vehicle_->storage->KeepsSnapshots();
}

bool Snapshots::has_new_marks() const {
  return vehicle_->snapshots.has_new_marks() &&
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
    if (is_due() || has_new_marks()) {
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
  const bool may_write_graph = is_due() && Clock::now() < until_;
  if (!may_write_graph && !has_new_marks()) {
    End(job);
    return;
  }
  if (!MayWrite()) {
    Fail(job);
    return;
  }
  if (!may_write_graph) {
    WriteMarks(job);
    return;
  }
  vehicle_->snapshots.BeginUnlessKept(*vehicle_->loaded);
  if (vehicle_->snapshots.parts() >= vehicle_->loaded->whole_parts()) {
    WriteRest(job);
  } else if (job->parts_left > 0) {
    --job->parts_left;
    WritePart(job);
  } else {
    End(job);
  }
}

bool Snapshots::MayWrite() const {
  return static_cast<bool>(vehicle_->loaded) && !vehicle_->in_doubt() &&
         vehicle_->head.config_is_known() && vehicle_->head.damage().ok();
}

void Snapshots::WritePart(const JobPtr& job) {
  const std::uint32_t number = vehicle_->snapshots.parts();
  vehicle_->storage->PutSnapshotPart(
      vehicle_->head.key(), number, vehicle_->loaded->SavePart(number),
      queue_->OnStrand(
          [this, job, number,
           series = vehicle_->snapshots.series()](const absl::Status& status) {
            if (!status.ok()) {
              Fail(job);
              return;
            }
            vehicle_->snapshots.PartWritten(number, series);
            Step(job);
          }));
}

void Snapshots::WriteRest(const JobPtr& job) {
  const std::uint32_t parts = vehicle_->snapshots.parts();
  SnapshotRecord snapshot;
  snapshot.last_sequence = vehicle_->loaded->last_sequence();
  snapshot.part_count = parts;
  snapshot.payload =
      EncodeSnapshot(vehicle_->head.config(), vehicle_->loaded.jumps(),
                     *vehicle_->loaded, parts);
  vehicle_->storage->PutSnapshot(
      vehicle_->head.key(), std::move(snapshot),
      queue_->OnStrand(
          [this, job, sequence = vehicle_->loaded->last_sequence(),
           series = vehicle_->snapshots.series()](const absl::Status& status) {
            if (!status.ok()) {
              Fail(job);
              return;
            }
            vehicle_->snapshots.Written(*vehicle_->loaded, sequence, series);
            Step(job);
          }));
}

// Marks that cannot be written are tried again once more of them are learned.
void Snapshots::WriteMarks(const JobPtr& job) {
  vehicle_->NoteSearched();
  core::Search* const search = vehicle_->loaded.search();
  vehicle_->storage->PutMarks(
      vehicle_->head.key(), EncodeMarks(vehicle_->head.config(), search),
      queue_->OnStrand(
          [this, job, version = search->marks_version(),
           series = vehicle_->snapshots.series()](const absl::Status&) {
            vehicle_->snapshots.MarksTried(version, series);
            End(job);
          }));
}

// Tries again once as many poses have come as make a snapshot due, from the
// first part on: what was written may be out of step with what is kept.
void Snapshots::Fail(const JobPtr& job) {
  vehicle_->snapshots.Forget();
  if (vehicle_->loaded) vehicle_->snapshots.PutOff(*vehicle_->loaded);
  End(job);
}

void Snapshots::End(const JobPtr& job) {
  const bool is_last = --writing_ == 0;
  job->then();
  if (is_last && stopped_) std::exchange(stopped_, nullptr)();
}

}  // namespace revisit::server
