#include "server/sessions/stored_checks.h"

#include <algorithm>
#include <cmath>
#include <utility>

#include "absl/strings/str_cat.h"
#include "core/drive/node_range.h"
#include "core/drive/pose_graph.h"
#include "core/search/candidates/candidate.h"
#include "core/search/candidates/value.h"
#include "core/search/search.h"
#include "server/base/status.h"
#include "server/storage/storage.h"

namespace revisit::server {
namespace {

using absl::StatusCode;
using absl::StrCat;

// Checks that are made ahead of their write.
constexpr std::size_t kMostMade = 64;
// Acknowledgements that are remembered to measure the delay of their checks.
constexpr std::size_t kMostLanded = 256;
constexpr int kChecksPerRead = 1000;
// Checks that are looked at in one step for whether they are still kept.
constexpr int kChecksPerTidy = 200;

}  // namespace

absl::Status StoredChecks::CheckNotFound(const std::string& vehicle_id,
                                         const CandidateId& named) {
  return Error(
      StatusCode::kNotFound, "CHECK_NOT_FOUND",
      StrCat("vehicle '", vehicle_id, "' has no stored candidate ",
             named.number, " of a check at sequence ", named.check_sequence));
}

absl::Status StoredChecks::IsInOtherVehicle(const std::string& matched) {
  return InvalidFields(
      "INVALID_FIELD",
      {{"candidate",
        StrCat(
            "it is a place in the history of vehicle '", matched,
            "', on which no pair of this vehicle's poses decides: add a loop "
            "closure between the two to their group")}});
}

bool StoredChecks::Stores() const {
  return changes_.codec() != nullptr &&
         vehicle_->head.config().checks == ChecksKept::kStored;
}

void StoredChecks::NoteDebt(std::int64_t debt) {
  if (debt == debt_.load()) return;
  const std::int64_t before = debt_.exchange(debt);
  if (policy_.monitor != nullptr) policy_.monitor->Owes(debt - before);
  vehicle_->owes_checks = debt > 0;
}

void StoredChecks::NoteLanded() {
  const std::uint64_t durable = vehicle_->head.durable_sequence();
  if (landed_.size() < kMostLanded &&
      (landed_.empty() || landed_.back().sequence < durable)) {
    landed_.push_back({durable, std::chrono::steady_clock::now()});
  }
}

void StoredChecks::Consider() {
  const ChecksHead& head = vehicle_->head.checks();
  // Most vehicles never had to do with stored checks, and come by with every
  // append.
  if (!Stores() && head == ChecksHead() && made_.empty()) return;
  if (!changes_.MayWork()) return;
  TidySoon();
  second_.Consider();
  links_.Consider();
  if (!Stores()) {
    made_.clear();
    landed_.clear();
    NoteDebt(0);
    is_unsettled_.store(false);
    waits_for_group_.store(false);
    // What was owed is so no longer, and the store has to know.
    if (head.stores) WriteSoon();
    return;
  }
  DropStored();
  const std::optional<core::DueCheck> due =
      vehicle_->loaded->NextCheck(made_to_);
  NoteDebt(vehicle_->loaded->ChecksBehind(made_to_) +
           static_cast<std::int64_t>(made_.size()));
  is_unsettled_.store(!due && made_.empty() && !failed_ &&
                      head.checked_sequence <
                          vehicle_->head.durable_sequence());
  if (due) NoteLanded();
  if (!made_.empty() || !head.stores) WriteSoon();
  if (!due || searching_ || made_.size() >= kMostMade || !search_.MayPost()) {
    return;
  }
  searching_ = true;
  waits_for_group_.store(false);
  search_.Post([this] { TakeTurn(); },
               [this] {
                 searching_ = false;
                 waits_for_group_.store(true);
               });
}

void StoredChecks::GoOn() {
  search_.TryAgain();
  links_.LookAgain();
  if (second_.is_behind()) second_.AllowMore();
  Consider();
}

void StoredChecks::TakeTurn() {
  searching_ = false;
  if (!changes_.MayWork() || !Stores()) return;
  const auto end = std::chrono::steady_clock::now() + policy_.turn;
  while (SearchOn() && std::chrono::steady_clock::now() < end &&
         !queue_->IsWanted()) {
  }
  Consider();
}

bool StoredChecks::SearchOn() {
  const std::optional<core::DueCheck> due =
      vehicle_->loaded->NextCheck(made_to_);
  if (!due || made_.size() >= kMostMade || !search_.is_ready()) return false;
  if (due->sequence != due_.sequence || due->node != due_.node ||
      series_ != vehicle_->loaded.series()) {
    due_ = *due;
    series_ = vehicle_->loaded.series();
    search_.RestartTurns();
  }
  const auto found = search_.TakeTurn(due_.node);
  if (found) Take(*found);
  return true;
}

void StoredChecks::Take(const core::CandidateSet& set) {
  const core::PoseGraph& graph = vehicle_->loaded->graph();
  const double keep = vehicle_->head.config().keep_probability;
  Made made;
  made.sequence = due_.sequence;
  made.revision = vehicle_->head.revision();
  for (const core::Candidate& candidate : set.candidates) {
    if (!IsWorthKeeping(candidate, keep)) continue;
    StoredCandidate& kept = made.check.candidates.emplace_back();
    kept.number = static_cast<std::uint32_t>(made.check.candidates.size());
    kept.rank = candidate.rank;
    SetMatch(graph, candidate, search_.scope().get(), &kept);
    kept.probability = ProbabilityOf(candidate);
  }
  if (policy_.monitor != nullptr) {
    policy_.monitor->Made(made.check.candidates.size());
  }
  if (!made.check.candidates.empty()) {
    if (const CheckScopePtr& scope = search_.scope()) {
      basis_.Learn(scope->group_id, scope->ties);
      made.ties = scope->ties;
    }
    made.check.basis =
        basis_.Of(made.sequence, made.check.candidates, made.ties);
    made.version = basis_.version();
    made.check.found = changes_.codec()->EncodeFound(
        vehicle_->View(), set, search_.duration(), search_.scope().get());
  }
  made_to_ = made.sequence;
  made_.push_back(std::move(made));
  search_.Restart();
}

void StoredChecks::DropStored() {
  const std::uint64_t stored = vehicle_->head.checks().checked_sequence;
  made_.erase(made_.begin(),
              std::find_if(made_.begin(), made_.end(), [&](const Made& made) {
                return made.sequence > stored;
              }));
  // Also back, where poses were given up.
  made_to_ = made_.empty() ? stored : made_.back().sequence;
  while (!landed_.empty() && landed_.front().sequence <= stored) {
    landed_.pop_front();
  }
}

void StoredChecks::WriteSoon() {
  if (writing_) return;
  writing_ = true;
  // After a write of unknown fate, once nothing else is under way, since the
  // store is then asked what it has.
  const Turn turn = failed_ ? Turn::kAlone : Turn::kAppend;
  queue_->PushBack({turn, [this](const absl::Status& status) {
                      if (status.ok() && changes_.MayWork()) {
                        Write();
                        return;
                      }
                      writing_ = false;
                      RunSettled();
                    }});
  queue_->PumpLater();
}

void StoredChecks::Write() {
  DropStored();
  ChecksWrite write = MakeWrite();
  const ChecksHead after = write.after;
  if (after == write.before && write.checks.empty()) {
    writing_ = false;
    RunSettled();
    // After a write of unknown fate the store may have had all, so that less is
    // owed than was said.
    Consider();
    return;
  }
  in_flight_->Add();
  vehicle_->storage->PutChecks(
      vehicle_->head.key(), std::move(write),
      queue_->OnStrand([this, after](const absl::Status& status) {
        TakeResult(after, status);
      }));
}

ChecksWrite StoredChecks::MakeWrite() {
  ChecksWrite write = changes_.Begin();
  core::VarianceReductions reductions = changes_.Reductions();
  write.after.stores = Stores();
  for (const Made& made : made_) {
    write.after.checked_sequence = made.sequence;
    if (made.check.candidates.empty()) continue;
    StoredCheck check = made.check;
    check.vehicle_uid = vehicle_->head.config().uid;
    const std::int64_t now_ns = vehicle_->clock();
    for (std::size_t i = 0; i < check.candidates.size(); ++i) {
      StoredCandidate& candidate = check.candidates[i];
      candidate.update_time_ns = now_ns;
      changes_.Decide(made.sequence, &candidate);
      candidate.value = changes_.ValueOf(made.sequence, candidate, &reductions);
      changes_.Tell(made.sequence, &check, i, &write);
    }
    CheckRecord record;
    record.sequence = made.sequence;
    record.revision = made.revision;
    record.create_time_ns = now_ns;
    changes_.Put(record, check, &write);
    // Something changed between its search and now.
    if (made.version != basis_.version() || !basis_.IsTiedBy(made.ties)) {
      second_.LookAgain();
    }
  }
  if (Stores() && !vehicle_->loaded->NextCheck(made_to_)) {
    write.after.checked_sequence = vehicle_->head.durable_sequence();
  }
  return write;
}

void StoredChecks::TakeResult(const ChecksHead& after,
                              const absl::Status& status) {
  in_flight_->Remove();
  writing_ = false;
  failed_ = !status.ok();
  if (status.ok()) {
    vehicle_->head.set_checks(after);
    LookAtLinks(after);
    if (policy_.monitor != nullptr) {
      const auto now = std::chrono::steady_clock::now();
      for (const Made& made : made_) {
        if (made.sequence > after.checked_sequence) break;
        const auto landed = std::find_if(
            landed_.begin(), landed_.end(),
            [&](const Landed& one) { return one.sequence >= made.sequence; });
        if (landed != landed_.end()) {
          policy_.monitor->Stored(now - landed->time);
        }
      }
    }
  } else {
    // Store and memory are compared before the next write.
    vehicle_->NoteFailedWrite(status);
  }
  RunSettled();
  queue_->Pump();
  // A write that failed is made again when something else happens, or the
  // vehicles that owe checks are looked for (Fleet::PayChecks()).
  if (status.ok()) Consider();
}

void StoredChecks::LookAtLinks(const ChecksHead& after) {
  for (const Made& made : made_) {
    if (made.sequence > after.checked_sequence) break;
    for (const StoredCandidate& candidate : made.check.candidates) {
      links_.LookAt(made.sequence, candidate);
    }
  }
}

void StoredChecks::RunSettled() {
  for (const auto& then : std::exchange(settled_, {})) then();
}

void StoredChecks::Settle(std::function<void()> then) {
  Consider();
  if (!is_unsettled() && !writing_) {
    then();
    return;
  }
  settled_.push_back(std::move(then));
  WriteSoon();
}

// ---- What is kept

void StoredChecks::TidySoon() {
  const auto now = std::chrono::steady_clock::now();
  if (tidying_ || !changes_.HasCandidates() ||
      (tidy_from_ == 0 && now < next_tidy_)) {
    return;
  }
  tidying_ = true;
  next_tidy_ = now + policy_.tidy_period;
  steps_.Run([this] { return FindOld(); },
             [this](bool ok) {
               tidying_ = false;
               if (!ok) tidy_from_ = 0;
               if (tidy_from_ != 0) TidySoon();
             });
}

absl::StatusOr<ChecksWrite> StoredChecks::FindOld() {
  Storage* const storage = vehicle_->storage;
  const VehicleKey key = vehicle_->head.key();
  ChecksWrite write = changes_.Begin();
  if (tidy_from_ == 0) {
    tidy_from_ = 1;
    tidy_excess_ = 0;
    // Each check has had an event, so that most vehicles have fewer.
    std::uint64_t count = 0;
    for (std::uint64_t first = 0;
         write.before.last_event > policy_.most_checks;) {
      const auto page =
          storage->ListChecks(key, first, kLastSequence, false, kChecksPerRead);
      if (!page.ok()) return page.status();
      count += page->size();
      if (static_cast<int>(page->size()) < kChecksPerRead) break;
      first = page->back().sequence + 1;
    }
    if (count > policy_.most_checks) tidy_excess_ = count - policy_.most_checks;
  }
  const auto page = storage->ListChecks(key, tidy_from_, kLastSequence, false,
                                        kChecksPerTidy);
  if (!page.ok()) return page.status();
  tidy_from_ = static_cast<int>(page->size()) < kChecksPerTidy
                   ? 0
                   : page->back().sequence + 1;
  const std::int64_t now_ns = vehicle_->clock();
  const auto before = [now_ns](std::chrono::hours kept) {
    return now_ns - std::chrono::nanoseconds(kept).count();
  };
  const CandidateTransition withdrawn{
      CandidateState::kWithdrawn, CandidateCause::kRetention, "", now_ns, ""};
  for (const CheckRecord& record : *page) {
    if (!record.damage.ok()) continue;
    const bool is_old =
        record.create_time_ns <
        before(record.open_count > 0 ? kOpenKept : kDecidedKept);
    if (!is_old && tidy_excess_ == 0) continue;
    if (tidy_excess_ > 0) --tidy_excess_;
    write.removed.push_back(record.sequence);
    std::optional<StoredCheck> check = changes_.Read(record);
    if (!check) continue;
    for (std::size_t i = 0; i < check->candidates.size(); ++i) {
      if (check->candidates[i].state == CandidateState::kOpen) {
        changes_.Change(record, &*check, i, withdrawn, &write);
      }
    }
  }
  // They go, rather than change.
  write.checks.clear();
  return write;
}

// ---- Pairs

absl::StatusOr<std::vector<CheckRecord>> StoredChecks::ChecksNear(
    std::uint64_t sequence) const {
  const core::PoseGraph& graph = vehicle_->loaded->graph();
  std::pair<std::uint64_t, std::uint64_t> place{
      0, vehicle_->head.durable_sequence()};
  if (graph.size() > 0) {
    place = PlaceAround(graph, graph.NodeAtOrBefore(sequence).value_or(0),
                        place.second);
  }
  return vehicle_->storage->ListChecks(vehicle_->head.key(), place.first,
                                       place.second, /*open_only=*/false,
                                       kChecksPerRead);
}

absl::StatusOr<std::optional<ChecksWrite>> StoredChecks::WithPair(
    PairKind kind, const PosePairRecord& pair, bool is_there,
    const std::optional<CandidateId>& named, const std::string& actor) const {
  const bool confirms = kind == PairKind::kLoopClosure;
  const CandidateTransition transition{
      confirms ? CandidateState::kConfirmed : CandidateState::kRejected,
      confirms ? CandidateCause::kLoopClosure : CandidateCause::kRejection,
      actor, pair.create_time_ns, pair.id};
  ChecksWrite write = changes_.Begin();
  bool is_named_found = false;
  std::vector<CheckRecord> records;
  for (const std::uint64_t place :
       {pair.query_sequence, pair.matched_sequence}) {
    absl::StatusOr<std::vector<CheckRecord>> near = ChecksNear(place);
    if (!near.ok()) return near.status();
    for (CheckRecord& record : *near) records.push_back(std::move(record));
  }
  if (named) {
    absl::StatusOr<std::vector<CheckRecord>> found =
        vehicle_->storage->ListChecks(vehicle_->head.key(),
                                      named->check_sequence,
                                      named->check_sequence, false, 1);
    if (!found.ok()) return found.status();
    for (CheckRecord& record : *found) records.push_back(std::move(record));
  }
  std::sort(records.begin(), records.end(),
            [](const CheckRecord& a, const CheckRecord& b) {
              return a.sequence < b.sequence;
            });
  records.erase(std::unique(records.begin(), records.end(),
                            [](const CheckRecord& a, const CheckRecord& b) {
                              return a.sequence == b.sequence;
                            }),
                records.end());
  for (const CheckRecord& record : records) {
    std::optional<StoredCheck> check = changes_.Read(record);
    if (!check) continue;
    for (std::size_t i = 0; i < check->candidates.size(); ++i) {
      const StoredCandidate& candidate = check->candidates[i];
      const bool is_named = named && named->check_sequence == record.sequence &&
                            named->number == candidate.number;
      is_named_found = is_named_found || is_named;
      if (is_named && !candidate.is_own()) {
        return IsInOtherVehicle(candidate.matched_vehicle);
      }
      const bool is_undecided = candidate.state == CandidateState::kOpen ||
                                candidate.state == CandidateState::kWithdrawn;
      // A pair that is there has decided what lies at its places, but for what
      // was opened again because others contradict it.
      const bool is_decided =
          candidate.decision == pair.id && candidate.state == transition.state;
      const bool is_meant =
          (is_named && !is_decided) ||
          (is_undecided && is_there && candidate.contradicted == pair.id) ||
          (is_undecided && !is_there &&
           changes_.IsPair(pair, record.sequence, candidate));
      if (is_meant) changes_.Change(record, &*check, i, transition, &write);
    }
  }
  if (named && !is_named_found) return CheckNotFound(vehicle_->id, *named);
  if (write.checks.empty()) return std::optional<ChecksWrite>();
  return std::optional<ChecksWrite>(std::move(write));
}

absl::StatusOr<std::optional<ChecksWrite>> StoredChecks::WithoutPair(
    PairKind kind, const PosePairRecord& pair, const std::string& actor,
    std::int64_t time_ns) const {
  const CandidateState decided = kind == PairKind::kLoopClosure
                                     ? CandidateState::kConfirmed
                                     : CandidateState::kRejected;
  const CandidateTransition transition{
      CandidateState::kOpen, CandidateCause::kDeletion, actor, time_ns, ""};
  ChecksWrite write = changes_.Begin();
  // Those that were named may lie anywhere.
  std::uint64_t first = 0;
  while (true) {
    const absl::StatusOr<std::vector<CheckRecord>> page =
        vehicle_->storage->ListChecks(vehicle_->head.key(), first,
                                      kLastSequence, false, kChecksPerRead);
    if (!page.ok()) return page.status();
    for (const CheckRecord& record : *page) {
      std::optional<StoredCheck> check = changes_.Read(record);
      if (!check) continue;
      for (std::size_t i = 0; i < check->candidates.size(); ++i) {
        const StoredCandidate& candidate = check->candidates[i];
        if (!candidate.is_own()) continue;
        const bool is_decided =
            candidate.state == decided && candidate.decision == pair.id;
        // Nothing is left that could be upheld.
        const bool is_contradicted =
            candidate.cause == CandidateCause::kContradiction &&
            candidate.contradicted == pair.id;
        if (is_decided || is_contradicted) {
          changes_.Change(record, &*check, i, transition, &write);
        }
      }
    }
    if (static_cast<int>(page->size()) < kChecksPerRead) break;
    first = page->back().sequence + 1;
  }
  if (write.checks.empty()) return std::optional<ChecksWrite>();
  return std::optional<ChecksWrite>(std::move(write));
}

EventRecord StoredChecks::Farewell() const {
  EventRecord event;
  if (changes_.codec() == nullptr) return event;
  event.time_ns = vehicle_->clock();
  event.payload = changes_.codec()->EncodeFarewell(
      {vehicle_->id, vehicle_->head.config().uid});
  return event;
}

}  // namespace revisit::server
