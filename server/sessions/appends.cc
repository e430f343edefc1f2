#include "server/sessions/appends.h"

#include <algorithm>
#include <string>
#include <utility>

#include "absl/strings/str_cat.h"
#include "core/drive/recordings.h"
#include "core/geometry/pose.h"
#include "core/geometry/recording_start.h"
#include "core/settings.h"
#include "server/base/sequences.h"
#include "server/sessions/check_changes.h"
#include "server/sessions/search_turns.h"
#include "server/sessions/server_clock.h"
#include "server/storage/storage.h"

namespace revisit::server {
namespace {

using absl::StatusCode;
using absl::StrCat;

// Appends of so many poses are answered before the first of them is over, and
// before other work of the vehicle gets its turn: they take less than a
// millisecond.
constexpr std::size_t kAnsweredTogether = 1024;

absl::Status CheckConsecutive(const DecodedBatch& batch) {
  if (batch.samples.empty()) {
    return InvalidFields("BATCH_SIZE",
                         {{"poses", "got 0; allowed is at least 1"}});
  }
  const std::uint64_t first = batch.samples.front().sequence;
  if (first == 0) {
    return InvalidFields("INVALID_FIELD", {{"poses[0].sequence",
                                            "got 0; allowed is at least 1"}});
  }
  for (std::size_t i = 0; i < batch.samples.size(); ++i) {
    const auto gap = FindSequenceGap(first + i - 1, batch.samples[i].sequence);
    if (gap) {
      return InvalidFields("INVALID_FIELD",
                           {{StrCat("poses[", i, "].sequence"), *gap}});
    }
  }
  return absl::OkStatus();
}

}  // namespace

struct Appends::Pending {
  AppendRequest request;
  std::shared_ptr<AppendObserver> observer;
  // The poses that came, also where only a part of them is new.
  std::uint64_t first_sequence = 0;
  std::uint64_t last_sequence = 0;
  // Nothing until decoded. Samples and payload are those to write.
  std::optional<DecodedBatch> decoded;
  // The revision that the write makes; 0 if there is nothing to write.
  std::uint64_t revision = 0;
  // See Acknowledgement; once applied.
  std::vector<core::Finding> findings;
  std::optional<StampAhead> stamp_ahead;
  // Set once it is known what to answer; answered in order.
  std::optional<absl::Status> result;
};

// The checks of an append that has landed.
struct Appends::Checks {
  PendingPtr append;
  absl::StatusOr<core::SearchOptions> options;
  std::vector<core::NodeIndex> due;
  // The check that `search` is of.
  std::size_t next = 0;
  SearchTurns search;
};

void Appends::Submit(AppendRequest request,
                     std::shared_ptr<AppendObserver> observer) {
  if (pending_.fetch_add(1) >= max_pending_) {
    pending_.fetch_sub(1);
    Refuse(std::move(observer));
    return;
  }
  auto append = std::make_shared<Pending>();
  append->request = std::move(request);
  append->observer = std::move(observer);
  queue_->RunOrPost([this, append = std::move(append)]() mutable {
    if (queue_->MayAppendHere()) {
      Run(append, absl::OkStatus(), /*may_block=*/false);
      return;
    }
    queue_->PushBack(
        {Turn::kAppend, [this, append](const absl::Status& status) {
           Run(append, status, /*may_block=*/true);
         }});
    queue_->PumpLater();
  });
}

void Appends::Refuse(std::shared_ptr<AppendObserver> observer) {
  const absl::Status full =
      Error(StatusCode::kResourceExhausted, "QUEUE_FULL",
            StrCat("vehicle '", vehicle_->id, "': ", max_pending_,
                   " batches wait to be stored, which is the limit"));
  queue_->Post([observer = std::move(observer), full] {
    observer->OnStaged(full);
    observer->OnDurable(full);
    observer->OnOver();
  });
}

void Appends::Run(const PendingPtr& append, const absl::Status& status,
                  bool may_block) {
  const absl::StatusOr<Taken> taken =
      status.ok() ? TakeOn(append, may_block) : status;
  if (!taken.ok()) {
    Conclude(append, taken.status());
  } else if (*taken != Taken::kYes) {
    const Turn turn = *taken == Taken::kWhenIdle ? Turn::kAlone : Turn::kAppend;
    queue_->PushFront({turn, [this, append](const absl::Status& later) {
                         Run(append, later, /*may_block=*/true);
                       }});
    if (!may_block) queue_->PumpLater();
  }
}

absl::StatusOr<Appends::Taken> Appends::TakeOn(const PendingPtr& append,
                                               bool may_block) {
  if (absl::Status status = vehicle_->Writable(); !status.ok()) return status;
  if (absl::Status status = Decode(append.get()); !status.ok()) return status;
  const std::uint64_t first = append->first_sequence;
  const std::uint64_t staged = vehicle_->head.staged().sequence;
  if (first > staged + 1) return SequenceGap(first);
  return first <= staged ? TakeOnKnown(append, may_block) : TakeOnNew(append);
}

absl::StatusOr<Appends::Taken> Appends::TakeOnKnown(const PendingPtr& append,
                                                    bool may_block) {
  const std::uint64_t first = append->first_sequence;
  const std::uint64_t last = append->last_sequence;
  const std::uint64_t durable = vehicle_->head.durable_sequence();
  if (last > durable && vehicle_->head.staged().sequence > durable) {
    return Taken::kWhenIdle;
  }
  if (!may_block) return Taken::kWhereReadsMayBlock;
  const absl::Status same =
      CompareWithStored(*append->decoded, first, std::min(last, durable));
  if (!same.ok()) return same;
  if (last <= durable) {
    Conclude(append, absl::OkStatus());
    return Taken::kYes;
  }
  const absl::Status sliced = KeepFrom(durable + 1 - first, &*append->decoded);
  if (!sliced.ok()) return sliced;
  return TakeOnNew(append);
}

absl::StatusOr<Appends::Taken> Appends::TakeOnNew(const PendingPtr& append) {
  absl::Status status = CheckRecordings(*append->decoded);
  if (status.ok()) status = TakeOrigin(*append->decoded);
  if (!status.ok()) return status;
  Write(append);
  return Taken::kYes;
}

void Appends::Conclude(const PendingPtr& append, const absl::Status& result) {
  append->result = result;
  in_flight_->Add();
  unanswered_.push_back(append);
  append->observer->OnStaged(result);
  AnswerInOrder();
}

absl::Status Appends::SequenceGap(std::uint64_t first) const {
  const std::string expected = StrCat(vehicle_->head.staged().sequence + 1);
  return Error(
      StatusCode::kFailedPrecondition, "SEQUENCE_GAP",
      StrCat("vehicle '", vehicle_->id, "': got a batch from sequence ", first,
             ", expected ", expected),
      {{"expected_sequence", expected}});
}

// An append that is run again is decoded already.
absl::Status Appends::Decode(Pending* append) {
  if (append->decoded) return absl::OkStatus();
  const VehicleConfig& config = vehicle_->head.staged().config;
  absl::Status wanted = append->observer->StillWanted();
  if (wanted.ok()) {
    wanted = CheckMeant(vehicle_->id, config, append->request.vehicle_uid);
  }
  if (!wanted.ok()) return wanted;
  absl::StatusOr<DecodedBatch> decoded = append->request.decode(config);
  if (!decoded.ok()) return decoded.status();
  if (absl::Status status = CheckConsecutive(*decoded); !status.ok()) {
    return status;
  }
  if (!vehicle_->storage->KeepsColumns()) {
    absl::StatusOr<std::string> payload =
        vehicle_->codec->AsMessages(std::move(decoded->payload));
    if (!payload.ok()) return payload.status();
    decoded->payload = *std::move(payload);
  }
  append->first_sequence = decoded->samples.front().sequence;
  append->last_sequence = decoded->samples.back().sequence;
  append->decoded = *std::move(decoded);
  append->observer->OnDecoded(config, append->decoded->samples);
  return absl::OkStatus();
}

// Whether the vehicle may have the recordings that the batch begins, beside
// those of the appends in flight.
absl::Status Appends::CheckRecordings(const DecodedBatch& batch) const {
  const std::size_t begun = batch.recordings_begun();
  if (begun == 0) return absl::OkStatus();
  std::size_t present = vehicle_->loaded->recordings().size();
  for (const PendingPtr& other : unanswered_) {
    if (other->revision > 0) present += other->decoded->recordings_begun();
  }
  if (present + begun <= core::kMostRecordings) return absl::OkStatus();
  const std::string limit = StrCat(core::kMostRecordings);
  return Error(
      StatusCode::kFailedPrecondition, "RECORDING_LIMIT",
      StrCat("vehicle '", vehicle_->id, "' has ", present,
             " recordings, and the batch begins ", begun, " more; allowed are ",
             limit,
             ": go on in the frame of the last one, revise all poses into one "
             "frame, or begin a new vehicle"),
      {{"limit", limit}});
}

// The first batch of a geodetic vehicle may set its origin.
absl::Status Appends::TakeOrigin(const DecodedBatch& batch) {
  if (!batch.origin) return absl::OkStatus();
  const std::optional<GeodeticOrigin>& origin =
      vehicle_->head.staged().config.origin;
  if (!origin) {
    vehicle_->head.StageOrigin(*batch.origin);
    return absl::OkStatus();
  }
  if (!(*origin == *batch.origin)) {
    return Error(StatusCode::kInternal, "INTERNAL",
                 StrCat("vehicle '", vehicle_->id,
                        "': a batch was decoded with another geodetic origin"));
  }
  return absl::OkStatus();
}

// Whether the poses of [first, last] are stored with the same content. Of those
// that were dropped it is not known any more.
absl::Status Appends::CompareWithStored(const DecodedBatch& batch,
                                        std::uint64_t first,
                                        std::uint64_t last) const {
  const absl::StatusOr<std::vector<std::uint64_t>> sent =
      vehicle_->codec->Fingerprints(batch.payload);
  if (!sent.ok()) return sent.status();
  absl::Status result;
  const absl::Status reading = vehicle_->storage->ReadBatches(
      vehicle_->head.key(), first, last, BatchVersion::kAsSent,
      [&](const BatchRecord& record) {
        const auto stored = StoredFingerprints(record);
        if (!stored.ok()) {
          result = stored.status();
          return false;
        }
        if (stored->empty()) return true;
        const std::uint64_t from = std::max(first, record.first_sequence);
        const std::uint64_t to =
            std::min(last, record.first_sequence + record.count - 1);
        for (std::uint64_t sequence = from; sequence <= to; ++sequence) {
          if ((*sent)[sequence - first] ==
              (*stored)[sequence - record.first_sequence]) {
            continue;
          }
          result = Error(
              StatusCode::kAlreadyExists, "SEQUENCE_CONTENT_MISMATCH",
              StrCat("vehicle '", vehicle_->id, "': the pose of sequence ",
                     sequence, " is stored with other content"),
              {{"sequence", StrCat(sequence)}});
          return false;
        }
        return true;
      });
  return reading.ok() ? result : reading;
}

absl::StatusOr<std::vector<std::uint64_t>> Appends::StoredFingerprints(
    const BatchRecord& record) const {
  // It is seen to hold the poses that its row says.
  const absl::Status sound =
      vehicle_->DecodeStoredPoses(record, vehicle_->head.config()).status();
  if (!sound.ok()) return sound;
  return vehicle_->codec->Fingerprints(record.payload);
}

absl::Status Appends::KeepFrom(std::size_t first, DecodedBatch* batch) const {
  const std::size_t count = batch->samples.size() - first;
  absl::StatusOr<std::string> payload =
      vehicle_->codec->SliceBatch(batch->payload, first, count);
  if (!payload.ok()) return payload.status();
  batch->payload = *std::move(payload);
  const auto offset = static_cast<std::ptrdiff_t>(first);
  batch->samples.erase(batch->samples.begin(), batch->samples.begin() + offset);
  return absl::OkStatus();
}

void Appends::Write(const PendingPtr& append) {
  DecodedBatch& batch = *append->decoded;
  const std::uint64_t first = batch.samples.front().sequence;
  std::vector<BatchRecord> rows = RowsOf(&batch);
  std::optional<std::string> vehicle_payload;
  const VehicleHead::Staged& staged = vehicle_->head.staged();
  if (staged.config.origin && !vehicle_->head.config().origin && first == 1) {
    vehicle_payload = vehicle_->codec->EncodeVehicle(staged.config);
  }
  append->revision = staged.revision;
  vehicle_->head.StageUpTo(batch.samples.back().sequence);
  in_flight_->Add();
  unanswered_.push_back(append);
  append->observer->OnStaged(absl::OkStatus());
  vehicle_->storage->AppendBatches(
      vehicle_->head.key(), std::move(rows), std::move(vehicle_payload),
      queue_->Kept([this, append](const absl::Status& result) {
        Arrive(append, result);
      }));
}

std::vector<BatchRecord> Appends::RowsOf(DecodedBatch* batch) {
  std::uint64_t next = batch->samples.front().sequence;
  std::vector<BatchRecord> rows;
  for (BatchPart& part : vehicle_->codec->DivideBatch(
           std::move(batch->payload), batch->samples.size(),
           vehicle_->storage->MostBatchBytes())) {
    BatchRecord& row = rows.emplace_back();
    row.first_sequence = next;
    row.count = static_cast<std::uint32_t>(part.count);
    // Each counts as a change, since each is one when the vehicle is loaded.
    row.revision = vehicle_->head.StageRow();
    row.payload = std::move(part.payload);
    next += part.count;
  }
  return rows;
}

void Appends::Arrive(const PendingPtr& append, const absl::Status& result) {
  bool is_first;
  {
    const MutexLock lock(&arrived_mutex_);
    is_first = arrived_.empty();
    arrived_.emplace_back(append, result);
  }
  if (is_first) queue_->Post([this] { TakeArrived(); });
}

void Appends::TakeArrived() {
  std::vector<std::pair<PendingPtr, absl::Status>> arrived;
  {
    const MutexLock lock(&arrived_mutex_);
    arrived.swap(arrived_);
  }
  for (const auto& [append, result] : arrived) append->result = result;
  AnswerInOrder();
  queue_->Pump();
}

void Appends::AnswerInOrder() {
  std::vector<PendingPtr> over;
  std::size_t answered_poses = 0;
  while (!in_flight_->checking() && !unanswered_.empty() &&
         unanswered_.front()->result) {
    if (answered_poses >= kAnsweredTogether) {
      AnswerLater();
      break;
    }
    const PendingPtr append = std::move(unanswered_.front());
    unanswered_.pop_front();
    in_flight_->Remove();
    if (append->revision == 0) {
      Answer(*append, *append->result);
      over.push_back(append);
    } else if (Land(append)) {
      over.push_back(append);
    }
    answered_poses += append->last_sequence - append->first_sequence + 1;
  }
  for (const PendingPtr& append : over) append->observer->OnOver();
  if (in_flight_->idle() && in_flight_->failing()) {
    in_flight_->Recover();
    vehicle_->head.Adopt(vehicle_->head.revision());
  }
}

void Appends::AnswerLater() {
  queue_->Post([this] {
    AnswerInOrder();
    queue_->Pump();
  });
}

// A write came back.
bool Appends::Land(const PendingPtr& append) {
  const absl::Status status = ResultOf(*append);
  if (!status.ok()) {
    Answer(*append, status);
    return true;
  }
  std::vector<core::NodeIndex> due = Apply(append.get());
  Answer(*append, absl::OkStatus());
  if (!due.empty()) append->observer->OnChecksDue(PosesOf(due));
  if (due.empty() || append->request.checks == nullptr) return true;
  RunChecks(append, std::move(due));
  return false;
}

// The result of a write, in the light of those before it.
absl::Status Appends::ResultOf(const Pending& append) {
  const absl::Status& written = *append.result;
  if (in_flight_->failing()) {
    // Stored behind one that was not: the store is no prefix of what was
    // staged, which its contract rules out.
    if (written.ok()) vehicle_->Leave(vehicle_->OutOfStep());
    return in_flight_->failure();
  }
  if (written.ok()) return written;
  // The store expected another batch than this session does.
  const bool out_of_step = written.code() == StatusCode::kFailedPrecondition;
  in_flight_->Fail(out_of_step ? vehicle_->OutOfStep() : written);
  vehicle_->NoteFailedWrite(written);
  return in_flight_->failure();
}

// Applies what is durable. Returns the nodes at which a check fell due.
std::vector<core::NodeIndex> Appends::Apply(Pending* append) {
  const std::vector<core::PoseSample>& samples = append->decoded->samples;
  core::AppendResult applied =
      vehicle_->loaded.Append(samples, append->revision);
  append->findings = std::move(applied.findings);
  append->stamp_ahead = FindAhead(samples);
  vehicle_->head.Advance(samples.back().sequence, append->revision,
                         append->decoded->origin);
  checks_->Consider();
  dropper_->Consider();
  return std::move(applied.checks_due);
}

std::vector<std::uint64_t> Appends::PosesOf(
    const std::vector<core::NodeIndex>& nodes) const {
  std::vector<std::uint64_t> sequences;
  for (const core::NodeIndex node : nodes) {
    sequences.push_back(PoseOf(vehicle_->loaded->graph(), node));
  }
  return sequences;
}

std::optional<StampAhead> Appends::FindAhead(
    const std::vector<core::PoseSample>& samples) {
  const std::int64_t latest_ns = LatestStamp(vehicle_->clock);
  std::optional<StampAhead> ahead;
  bool has_stamp = false;
  for (const core::PoseSample& sample : samples) {
    if (!sample.stamp_ns) continue;
    has_stamp = true;
    if (*sample.stamp_ns <= latest_ns || ahead) continue;
    ahead = StampAhead{sample.sequence,
                       *sample.stamp_ns - latest_ns + kMostAheadNanoseconds};
  }
  if (!has_stamp) return std::nullopt;
  const bool was_ahead = std::exchange(was_ahead_, ahead.has_value());
  return was_ahead ? std::nullopt : ahead;
}

void Appends::RunChecks(const PendingPtr& append,
                        std::vector<core::NodeIndex> due) {
  in_flight_->set_checking(true);
  auto checks = std::make_shared<Checks>();
  checks->append = append;
  checks->due = std::move(due);
  queue_->PostSearch(append->request.checks->flow, [this, checks] {
    checks->options =
        checks->append->request.checks->options(vehicle_->head.config());
    CheckOn(checks);
  });
}

void Appends::CheckOn(const ChecksPtr& checks) {
  AppendObserver* const observer = checks->append->observer.get();
  std::optional<absl::StatusOr<core::CandidateSet>> answer;
  if (checks->options.ok()) {
    answer = checks->search.Take(vehicle_->View(), checks->due[checks->next],
                                 *checks->options,
                                 [observer] { return observer->ShouldStop(); });
  } else {
    answer = checks->options.status();
  }
  if (answer) {
    observer->OnCandidates(vehicle_->View(), *answer,
                           checks->search.all_turns());
    checks->search = SearchTurns();
    ++checks->next;
  }
  if (checks->next < checks->due.size()) {
    queue_->PostSearch(checks->append->request.checks->flow,
                       [this, checks] { CheckOn(checks); });
    return;
  }
  observer->OnOver();
  in_flight_->set_checking(false);
  // In the lane of short work again.
  AnswerLater();
}

void Appends::Answer(const Pending& append, const absl::Status& status) {
  pending_.fetch_sub(1);
  if (!status.ok()) {
    append.observer->OnDurable(status);
    return;
  }
  append.observer->OnDurable(Acknowledgement{
      vehicle_->head.durable_sequence(), vehicle_->head.revision(),
      vehicle_->loaded.JumpsAt(append.first_sequence, append.last_sequence),
      append.findings, append.stamp_ahead,
      append.revision == 0 ? 0 : append.decoded->samples.size()});
}

}  // namespace revisit::server
