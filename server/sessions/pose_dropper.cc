#include "server/sessions/pose_dropper.h"

#include <algorithm>
#include <chrono>
#include <memory>
#include <utility>
#include <vector>

#include "core/drive/dropped_stretch.h"
#include "core/drive/node_range.h"
#include "core/drive/pose_graph.h"
#include "server/sessions/linked_poses.h"
#include "server/sessions/server_clock.h"
#include "server/storage/storage.h"

namespace revisit::server {
namespace {

// Longest that one task looks at nodes, and that one reads rows, before the
// strand lets others run. An append is several tasks, and waits before each; it
// goes on while nodes are looked at, and not while rows are read.
constexpr std::chrono::milliseconds kLookSlice{5};
constexpr std::chrono::milliseconds kReadSlice{20};

// Nodes that are looked at from one look at the clock to the next.
constexpr core::NodeIndex kNodesPerLook = 16;

// Rows that one write merges: all other writes of the storage wait for it.
constexpr std::size_t kRowsPerWrite = 128;

// Most poses of one row: with more, a damaged row could not be told from a
// sound one (kMostClaimedPoses of record_check.h).
constexpr std::uint64_t kPosesPerRow = 1'000'000;

// A row is divided to drop so many of its poses or more. Rows of poses that
// came one by one have fewer, those of recordings several hundred.
constexpr std::uint64_t kLeastDivided = 32;

// What is dropped at a time is at least this share of the nodes.
constexpr double kLeastShare = 0.1;

bool KeepsAll(const core::RetentionOptions& options) {
  return !options.max_age_ns && options.max_passes == 0;
}

}  // namespace

void PoseDropper::Consider() {
  if (is_under_way_ || !vehicle_->loaded || vehicle_->owes_checks ||
      KeepsAll(vehicle_->head.config().drive.retention) ||
      !vehicle_->loaded.is_worth_a_look()) {
    return;
  }
  is_under_way_ = true;
  monitor_->Began();
  queue_->PostLong([this] { BeginLook(); });
}

void PoseDropper::ConsiderLoaded() {
  const core::PoseGraph& graph = vehicle_->loaded->graph();
  const core::NodeIndex size = graph.size();
  if (!vehicle_->head.config().drive.retention.max_age_ns ||
      size < kLeastLookedAt) {
    return;
  }
  const auto tenth =
      static_cast<core::NodeIndex>(kLeastShare * static_cast<double>(size));
  const std::optional<std::int64_t> old = graph.node(tenth).stamp_ns;
  const std::optional<std::int64_t> oldest =
      vehicle_->loaded->OldestStamp(LatestStamp(vehicle_->clock));
  // One node alone may have a wrong stamp: whether it is so, the look finds.
  if (old && oldest && *old < *oldest) vehicle_->loaded.LookAtOnce();
  Consider();
}

void PoseDropper::BeginLook() {
  if (vehicle_->gone_status()) {
    End();
    return;
  }
  vehicle_->loaded.LookLater();
  search_ = vehicle_->loaded->SearchDroppable(LatestStamp(vehicle_->clock));
  drive_series_ = vehicle_->loaded.series();
  LookSome();
}

void PoseDropper::LookSome() {
  if (!IsCurrent() || replayer_->gives_up()) {
    BeginAnew();
    return;
  }
  const auto pause = std::chrono::steady_clock::now() + kLookSlice;
  bool is_done = false;
  do {
    is_done = search_->Advance(kNodesPerLook);
  } while (!is_done && std::chrono::steady_clock::now() < pause);
  if (!is_done) {
    queue_->PostLong([this] { LookSome(); });
    return;
  }
  queue_->PushBack(
      {Turn::kAlone, [this](const absl::Status& status) { Drop(status); }});
  queue_->PumpLater();
}

bool PoseDropper::IsCurrent() const {
  return !vehicle_->gone_status() &&
         drive_series_ == vehicle_->loaded.series() &&
         vehicle_->loaded->Fits(*search_);
}

void PoseDropper::BeginAnew() {
  End();
  if (vehicle_->gone_status() || replayer_->gives_up()) return;
  vehicle_->loaded.LookAtOnce();
  Consider();
}

void PoseDropper::End() {
  if (is_under_way_) monitor_->Ended();
  is_under_way_ = false;
  search_.reset();
  work_.reset();
}

void PoseDropper::Drop(const absl::Status& status) {
  if (!status.ok() || !vehicle_->Writable().ok()) {
    End();
    return;
  }
  if (!IsCurrent()) {
    BeginAnew();
    return;
  }
  queue_->Hold();
  queue_->PostLong([this] {
    FindRanges();
    Step();
  });
}

void PoseDropper::FindRanges() {
  const core::Drive& drive = *vehicle_->loaded;
  const core::PoseGraph& graph = drive.graph();
  work_ = std::make_unique<Work>();
  work_->start = std::chrono::steady_clock::now();
  work_->dropped_before = drive.dropped().count();
  const std::unique_ptr<core::DroppableSearch> search = std::move(search_);
  absl::StatusOr<std::vector<std::uint64_t>> linked =
      ReadLinkedPoses(&vehicle_->storage->Groups(), vehicle_->head.key());
  if (!linked.ok()) {
    monitor_->Withheld(vehicle_->id, linked.status());
    return;
  }
  core::NodeIndex nodes = 0;
  std::vector<core::NodeRange> found;
  for (const core::NodeRange& range : search->Droppable(LoopEnds(*linked))) {
    const core::SequenceRange sequences = core::SequencesOf(graph, range);
    if (sequences.first > sequences.last) continue;
    work_->ranges.push_back(sequences);
    found.push_back(range);
    nodes += range.last - range.first;
  }
  work_->nodes_too_old = search->CountTooOld(found);
  work_->nodes_covered = nodes - work_->nodes_too_old;
  if (static_cast<double>(nodes) <
      kLeastShare * static_cast<double>(graph.size())) {
    work_->ranges.clear();
  }
  work_->referred = *std::move(linked);
  for (const auto& [id, closure] : vehicle_->pairs.loop_closures()) {
    work_->referred.push_back(closure.query_sequence);
    work_->referred.push_back(closure.matched_sequence);
  }
  std::sort(work_->referred.begin(), work_->referred.end());
}

std::vector<core::NodeIndex> PoseDropper::LoopEnds(
    const std::vector<std::uint64_t>& linked) const {
  const core::Drive& drive = *vehicle_->loaded;
  std::vector<core::NodeIndex> ends = drive.LoopEnds();
  for (const std::uint64_t sequence : linked) {
    const auto node = core::NodeOf(drive.graph(), drive.dropped(), sequence);
    if (node) ends.push_back(*node);
  }
  return ends;
}

void PoseDropper::Step() {
  const absl::StatusOr<bool> all = ReadSome();
  const bool must_end = !all.ok() || replayer_->gives_up();
  if (!must_end && !work_->rows.empty()) {
    Write();
  } else if (must_end || *all) {
    Finish();
  } else {
    queue_->PostLong([this] { Step(); });
  }
}

absl::StatusOr<bool> PoseDropper::ReadSome() {
  const auto pause = std::chrono::steady_clock::now() + kReadSlice;
  while (work_->range < work_->ranges.size()) {
    const core::SequenceRange& range = work_->ranges[work_->range];
    // With the rows before and behind it, which say where it begins and ends.
    const std::uint64_t first =
        work_->next_sequence > 0 ? work_->next_sequence
                                 : std::max<std::uint64_t>(range.first, 2) - 1;
    const std::uint64_t last =
        std::min(range.last + 1, vehicle_->head.durable_sequence());
    absl::Status taking;
    const absl::Status reading = vehicle_->storage->ReadBatches(
        vehicle_->head.key(), first, last, BatchVersion::kCurrent,
        [&](const BatchRecord& row) {
          const absl::StatusOr<bool> more = TakeRow(row);
          taking = more.status();
          return more.ok() && *more && std::chrono::steady_clock::now() < pause;
        });
    if (!reading.ok()) return reading;
    if (!taking.ok()) return taking;
    if (work_->next_sequence > last) {
      // A stretch that reaches behind the range has met a dropped row there.
      if (work_->rows.empty() && work_->stretch) {
        Complete(std::nullopt, /*is_end=*/true);
      }
      ++work_->range;
      work_->next_sequence = 0;
      work_->before.reset();
    }
    if (!work_->rows.empty() || std::chrono::steady_clock::now() >= pause)
      break;
  }
  return work_->range == work_->ranges.size();
}

absl::StatusOr<bool> PoseDropper::TakeRow(const BatchRecord& row) {
  const absl::StatusOr<DecodedPoses> poses =
      vehicle_->DecodeStoredPoses(row, vehicle_->head.config());
  if (!poses.ok()) return poses.status();
  const bool is_dropped = poses->dropped.has_value();
  if (!is_dropped) {
    const absl::Status divided = Divide(row);
    if (!divided.ok()) return divided;
    if (!work_->rows.empty()) return false;
  }
  const bool joins = is_dropped || MayDrop(row);
  const std::optional<core::Pose> first_pose =
      is_dropped ? std::nullopt
                 : std::make_optional(poses->samples.front().pose);
  if (work_->stretch) {
    const bool is_full = work_->stretch->count + row.count > kPosesPerRow;
    if (!joins || is_full || work_->stretch->rows >= kRowsPerWrite) {
      Complete(first_pose, /*is_end=*/!joins || is_full);
      // The row is read again after the write.
      if (!work_->rows.empty()) return false;
    }
  }
  if (joins) Join(row, *poses);
  if (is_dropped) {
    work_->before.reset();
  } else {
    work_->before = poses->samples.back().pose;
  }
  work_->next_sequence = row.first_sequence + row.count;
  return true;
}

void PoseDropper::Join(const BatchRecord& row, const DecodedPoses& poses) {
  if (!work_->stretch) {
    work_->stretch.emplace(Stretch{
        core::DroppedStretchMaker(vehicle_->loaded->resampler_options()),
        row.first_sequence});
    if (work_->before && !poses.dropped) {
      work_->stretch->maker.Begin(*work_->before);
    }
  }
  Stretch& stretch = *work_->stretch;
  if (poses.dropped) {
    stretch.maker.Add(*poses.dropped);
  } else {
    for (const core::PoseSample& sample : poses.samples) {
      stretch.maker.Add(sample);
    }
    stretch.has_poses = true;
  }
  stretch.count += row.count;
  ++stretch.rows;
}

bool PoseDropper::MayDrop(const BatchRecord& row) const {
  const core::SequenceRange& range = work_->ranges[work_->range];
  const std::uint64_t last = row.first_sequence + row.count - 1;
  if (row.first_sequence < range.first || last > range.last) return false;
  const auto referred = std::lower_bound(
      work_->referred.begin(), work_->referred.end(), row.first_sequence);
  return referred == work_->referred.end() || *referred > last;
}

absl::Status PoseDropper::Divide(const BatchRecord& row) {
  const core::SequenceRange& range = work_->ranges[work_->range];
  const std::uint64_t end = row.first_sequence + row.count;
  const std::uint64_t from = std::max(row.first_sequence, range.first);
  const std::uint64_t to = std::min(end, range.last + 1);
  if (from >= to || to - from < kLeastDivided || to - from == row.count) {
    return absl::OkStatus();
  }
  const absl::StatusOr<BatchVersions> whole = ReadVersions(row);
  if (!whole.ok()) return whole.status();
  std::vector<BatchVersions> rows;
  const std::uint64_t ends[] = {row.first_sequence, from, to, end};
  for (int i = 0; i < 3; ++i) {
    if (ends[i] == ends[i + 1]) continue;
    const std::uint64_t count = ends[i + 1] - ends[i];
    absl::StatusOr<BatchRecord> sent = PartOf(whole->as_sent, ends[i], count);
    if (!sent.ok()) return sent.status();
    rows.push_back({*std::move(sent)});
    if (!whole->revised) continue;
    absl::StatusOr<BatchRecord> revised =
        PartOf(*whole->revised, ends[i], count);
    if (!revised.ok()) return revised.status();
    rows.back().revised = *std::move(revised);
  }
  work_->rows = std::move(rows);
  return absl::OkStatus();
}

absl::StatusOr<BatchVersions> PoseDropper::ReadVersions(
    const BatchRecord& current) const {
  BatchVersions versions;
  const absl::Status reading = vehicle_->storage->ReadBatches(
      vehicle_->head.key(), current.first_sequence, current.first_sequence,
      BatchVersion::kAsSent, [&](BatchRecord sent) {
        versions.as_sent = std::move(sent);
        return false;
      });
  if (!reading.ok()) return reading;
  if (versions.as_sent.revision != current.revision ||
      versions.as_sent.payload != current.payload) {
    versions.revised = current;
  }
  return versions;
}

absl::StatusOr<BatchRecord> PoseDropper::PartOf(const BatchRecord& row,
                                                std::uint64_t first,
                                                std::uint64_t count) const {
  absl::StatusOr<std::string> payload = vehicle_->codec->SliceBatch(
      row.payload, first - row.first_sequence, count);
  if (!payload.ok()) return payload.status();
  BatchRecord part;
  part.first_sequence = first;
  part.count = static_cast<std::uint32_t>(count);
  part.revision = row.revision;
  part.payload = *std::move(payload);
  return part;
}

void PoseDropper::Complete(const std::optional<core::Pose>& next, bool is_end) {
  Stretch& stretch = *work_->stretch;
  if (stretch.has_poses) {
    core::DroppedStretchMaker maker = stretch.maker;
    if (next) maker.End(*next);
    BatchRecord merged;
    merged.first_sequence = stretch.first_sequence;
    merged.count = static_cast<std::uint32_t>(stretch.count);
    merged.revision = NextRevision();
    merged.payload = vehicle_->codec->EncodeDropped(maker.Take());
    work_->rows.push_back({std::move(merged)});
  }
  // What is written now is one row, to be merged with those that follow.
  stretch.rows = 1;
  stretch.has_poses = false;
  if (is_end) work_->stretch.reset();
}

// From here on the store lacks poses that the graph has.
void PoseDropper::Write() {
  queue_->set_store_lead(VehicleQueue::StoreLead::kPoses);
  const std::uint64_t revision = NextRevision();
  vehicle_->storage->ReplaceBatches(
      vehicle_->head.key(), std::exchange(work_->rows, {}), revision,
      queue_->OnStrand([this, revision](const absl::Status& status) {
        if (!status.ok()) {
          vehicle_->NoteFailedWrite(status);
          Finish();
          return;
        }
        work_->revision = revision;
        queue_->PostLong([this] { Step(); });
      }));
}

std::uint64_t PoseDropper::NextRevision() const {
  return std::max(work_->revision, vehicle_->head.revision()) + 1;
}

void PoseDropper::Finish() {
  const std::shared_ptr<const Work> work = std::move(work_);
  End();
  queue_->Release([&] {
    if (work->revision == 0 || vehicle_->gone_status()) {
      queue_->set_store_lead(VehicleQueue::StoreLead::kNone);
      return;
    }
    replayer_->Rebuild(vehicle_->head.config(), work->revision,
                       [this, work](const absl::Status& status) {
                         if (status.ok()) Report(*work);
                       });
  });
}

void PoseDropper::Report(const Work& work) const {
  const core::DroppedStretches& dropped = vehicle_->loaded->dropped();
  monitor_->Dropped({vehicle_->id, dropped.count() - work.dropped_before,
                     dropped.KeptFrom(1), work.nodes_too_old,
                     work.nodes_covered,
                     std::chrono::steady_clock::now() - work.start});
}

}  // namespace revisit::server
