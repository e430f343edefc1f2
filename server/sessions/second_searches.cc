#include "server/sessions/second_searches.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <utility>

#include "core/drive/drive.h"
#include "core/drive/dropped_stretch.h"
#include "core/drive/node_range.h"
#include "core/drive/pose_graph.h"
#include "server/sessions/contradicted_closures.h"
#include "server/storage/storage.h"

namespace revisit::server {
namespace {

// Rows of one page of a look, some milliseconds.
constexpr int kChecksPerLook = 100;
constexpr std::chrono::milliseconds kJudgingSlice{10};
// Fewer closures than these say nothing about each other.
constexpr std::size_t kLeastClosures = 3;
// Changes of values below this part are not worth a write.
constexpr double kValueStep = 0.01;
// How far places of different vehicles lie from each other along a path.
constexpr double kElsewhere = std::numeric_limits<double>::infinity();

bool IsUndecided(CandidateState state) {
  return state == CandidateState::kOpen || state == CandidateState::kWithdrawn;
}

}  // namespace

void SecondSearches::NoteStale(std::size_t count) {
  if (policy_.monitor != nullptr && count != stale_) {
    policy_.monitor->Stale(static_cast<std::int64_t>(count) -
                           static_cast<std::int64_t>(stale_));
  }
  stale_ = count;
  is_behind_.store(count > 0 || (seen_ && looked_ != seen_) || MustJudge());
}

bool SecondSearches::MustJudge() const {
  return changes_->MayWork() && changes_->HasCandidates() &&
         judged_ != vehicle_->pairs.version() &&
         vehicle_->pairs.loop_closures().size() >= kLeastClosures;
}

void SecondSearches::Allow() {
  allowed_ = std::min(allowed_ + policy_.searches_per_change,
                      kMostChangesAllowed * policy_.searches_per_change);
}

void SecondSearches::AllowMore() {
  Allow();
  search_.TryAgain();
  may_judge_ = true;
  Consider();
}

void SecondSearches::Consider() {
  if (!changes_->MayWork() || !changes_->HasCandidates()) return;
  const CheckBasis::Version now = basis_->version();
  if (seen_ != now) {
    seen_ = now;
    Allow();
    NoteStale(stale_);
  }
  // The group may have said more than was known when checks were stored.
  if (is_at_work_ || !basis_->knows_ties()) return;
  if (looked_ != now || looks_again_ || (may_judge_ && MustJudge())) {
    Look();
  } else if (!waiting_.empty() && allowed_ > 0 && search_.MayPost()) {
    Search();
  }
}

void SecondSearches::GiveUp() {
  is_at_work_ = false;
  if (judging_) judged_.reset();
  judging_.reset();
  waiting_.clear();
  looked_.reset();
  NoteStale(0);
}

// ---- The look

void SecondSearches::Look() {
  is_at_work_ = true;
  looks_again_ = false;
  looks_at_ = basis_->version();
  look_from_ = 1;
  waiting_.clear();
  if (may_judge_ && MustJudge()) {
    may_judge_ = false;
    judged_ = vehicle_->pairs.version();
    judging_.emplace(*vehicle_->loaded);
    queue_->PostLong([this] { JudgeClosures(); });
    return;
  }
  LookAtNextPage();
}

void SecondSearches::LookAtNextPage() {
  RunStep([this] { return LookAtPage(); },
          [this](bool ok) {
            if (!ok) return;
            if (look_from_ != 0) {
              LookAtNextPage();
            } else {
              EndLook();
            }
          });
}

void SecondSearches::JudgeClosures() {
  if (!changes_->MayWork()) {
    GiveUp();
    return;
  }
  // It has all it needs of the closures that there were when it began.
  const Clock::time_point end = Clock::now() + kJudgingSlice;
  if (!judging_->Run([end] { return Clock::now() >= end; })) {
    queue_->PostLong([this] { JudgeClosures(); });
    return;
  }
  contradicted_.clear();
  for (const auto& [id, p_value] :
       NameSuspects(vehicle_->pairs.loop_closures(), judging_->suspects())) {
    contradicted_.insert(id);
  }
  judging_.reset();
  LookAtNextPage();
}

void SecondSearches::RunStep(std::function<absl::StatusOr<ChecksWrite>()> step,
                             std::function<void(bool)> then) {
  steps_.Run(std::move(step), [this, then = std::move(then)](bool ok) {
    if (!ok) GiveUp();
    then(ok);
  });
}

absl::StatusOr<ChecksWrite> SecondSearches::LookAtPage() {
  ChecksWrite write = changes_->Begin();
  if (basis_->version() != looks_at_) {
    // From the beginning, at what there is now.
    looks_at_ = basis_->version();
    look_from_ = 1;
    waiting_.clear();
  }
  const auto page = vehicle_->storage->ListChecks(
      vehicle_->head.key(), look_from_, kLastSequence, false, kChecksPerLook);
  if (!page.ok()) return page.status();
  look_from_ = static_cast<int>(page->size()) < kChecksPerLook
                   ? 0
                   : page->back().sequence + 1;
  core::VarianceReductions reductions = changes_->Reductions();
  for (const CheckRecord& record : *page) LookAt(record, &reductions, &write);
  return write;
}

void SecondSearches::LookAt(const CheckRecord& record,
                            core::VarianceReductions* reductions,
                            ChecksWrite* write) {
  std::optional<StoredCheck> check = changes_->Read(record);
  if (!check) return;
  const std::int64_t now_ns = vehicle_->clock();
  const core::DroppedStretches& dropped = vehicle_->loaded->dropped();
  const bool is_dropped = dropped.Contains(record.sequence);
  bool is_undecided = false;
  bool is_changed = false;
  double value = 0.0;
  for (std::size_t i = 0; i < check->candidates.size(); ++i) {
    StoredCandidate& candidate = check->candidates[i];
    links_->Note(candidate);
    // Links between vehicles have ids of their own.
    if (candidate.is_own() && candidate.state == CandidateState::kConfirmed &&
        candidate.contradicted != candidate.decision &&
        contradicted_.count(candidate.decision) > 0) {
      candidate.contradicted = candidate.decision;
      changes_->Change(record, &*check, i,
                       {CandidateState::kOpen, CandidateCause::kContradiction,
                        "", now_ns, ""},
                       write);
    }
    const bool lost_match =
        candidate.is_own() && dropped.Contains(candidate.matched_sequence);
    if (candidate.state == CandidateState::kOpen &&
        (is_dropped || lost_match)) {
      changes_->Change(record, &*check, i,
                       {CandidateState::kWithdrawn, CandidateCause::kRetention,
                        "", now_ns, ""},
                       write);
      continue;
    }
    is_undecided =
        is_undecided || (IsUndecided(candidate.state) &&
                         candidate.cause != CandidateCause::kRetention);
    const double renewed =
        changes_->ValueOf(record.sequence, candidate, reductions);
    if (std::abs(renewed - candidate.value) >
        kValueStep * std::max(renewed, candidate.value)) {
      candidate.value = renewed;
      is_changed = true;
    }
    value = std::max(value, candidate.value);
  }
  const bool is_stale =
      is_undecided && !is_dropped &&
      basis_->Of(record.sequence, check->candidates) != check->basis;
  if (is_stale) waiting_.push_back({value, record.sequence});
  if (is_stale != check->stale) {
    check->stale = is_stale;
    is_changed = true;
  }
  if (is_changed) changes_->Put(record, *check, write);
}

void SecondSearches::EndLook() {
  std::sort(
      waiting_.begin(), waiting_.end(), [](const Waiting& a, const Waiting& b) {
        // The earlier of equal ones is searched first.
        return a.value != b.value ? a.value < b.value : a.sequence > b.sequence;
      });
  looked_ = looks_at_;
  is_at_work_ = false;
  NoteStale(waiting_.size());
  links_->Consider();
  Consider();
}

// ---- Searches

void SecondSearches::Search() {
  is_at_work_ = true;
  search_.Restart();
  PostTurn();
}

void SecondSearches::PostTurn() {
  search_.Post([this] { TakeTurn(); }, [this] { is_at_work_ = false; });
}

void SecondSearches::TakeTurn() {
  if (!changes_->MayWork()) {
    GiveUp();
    return;
  }
  const auto leave = [this] {
    is_at_work_ = false;
    Consider();
  };
  if (basis_->version() != looked_ || waiting_.empty() || !search_.is_ready()) {
    leave();
    return;
  }
  const auto node =
      vehicle_->loaded->graph().NodeAtOrBefore(waiting_.back().sequence);
  if (!node) {
    waiting_.pop_back();
    leave();
    return;
  }
  const std::optional<core::CandidateSet> set = search_.TakeTurn(*node);
  if (!set) {
    PostTurn();
    return;
  }
  --allowed_;
  if (policy_.monitor != nullptr) policy_.monitor->SearchedAgain();
  if (const CheckScopePtr& scope = search_.scope()) {
    basis_->Learn(scope->group_id, scope->ties);
  }
  RunStep([this, answer = Read(*set)] { return Compare(answer); },
          [this](bool ok) {
            if (!ok) return;
            is_at_work_ = false;
            Consider();
          });
}

SecondSearches::Answer SecondSearches::Read(
    const core::CandidateSet& set) const {
  const core::PoseGraph& graph = vehicle_->loaded->graph();
  const double keep = vehicle_->head.config().keep_probability;
  Answer answer;
  answer.sequence = waiting_.back().sequence;
  const CheckScope* const scope = search_.scope().get();
  answer.bytes = changes_->codec()->EncodeFound(vehicle_->View(), set,
                                                search_.duration(), scope);
  for (const core::Candidate& candidate : set.candidates) {
    Found& found = answer.found.emplace_back();
    found.candidate.latest_rank = candidate.rank;
    found.candidate.probability = ProbabilityOf(candidate);
    SetMatch(graph, candidate, scope, &found.candidate);
    found.is_kept = IsWorthKeeping(candidate, keep);
  }
  if (scope == nullptr) return answer;
  answer.scope = search_.scope();
  for (std::size_t d = 0; d < scope->vehicles.size(); ++d) {
    if (d == scope->search.asking) continue;
    answer.others.emplace(scope->vehicles[d].uid,
                          &scope->search.drives->view(d).graph);
  }
  for (const core::UnsearchedDrive& unsearched : set.unsearched) {
    answer.others.erase(scope->vehicles[unsearched.drive].uid);
  }
  return answer;
}

const core::PoseGraph* SecondSearches::GraphOf(const StoredCandidate& candidate,
                                               const Answer& answer) const {
  if (candidate.is_own()) return &vehicle_->loaded->graph();
  const auto other = answer.others.find(candidate.matched_uid);
  return other == answer.others.end() ? nullptr : other->second;
}

std::vector<std::optional<SecondSearches::Found>> SecondSearches::TakeSame(
    const StoredCheck& check, const Answer& answer,
    std::vector<Found>* found) const {
  std::vector<std::optional<Found>> same(check.candidates.size());
  for (std::size_t i = 0; i < check.candidates.size(); ++i) {
    const StoredCandidate& kept = check.candidates[i];
    const core::PoseGraph* const graph = GraphOf(kept, answer);
    if (graph == nullptr) continue;
    const double place = TravelledAt(*graph, kept.matched_sequence);
    const auto away = [&](const Found& one) {
      if (one.candidate.matched_uid != kept.matched_uid) return kElsewhere;
      return std::abs(TravelledAt(*graph, one.candidate.matched_sequence) -
                      place);
    };
    const auto nearest = std::min_element(
        found->begin(), found->end(),
        [&](const Found& a, const Found& b) { return away(a) < away(b); });
    if (nearest == found->end() || away(*nearest) > core::kPlaceRadiusMeters) {
      continue;
    }
    same[i] = *nearest;
    found->erase(nearest);
  }
  return same;
}

absl::StatusOr<ChecksWrite> SecondSearches::Compare(const Answer& answer) {
  ChecksWrite write = changes_->Begin();
  // What was found is about what there was when the search was made.
  if (basis_->version() != looked_) return write;
  if (!waiting_.empty() && waiting_.back().sequence == answer.sequence) {
    waiting_.pop_back();
    NoteStale(waiting_.size());
  }
  const auto rows = vehicle_->storage->ListChecks(
      vehicle_->head.key(), answer.sequence, answer.sequence, false, 1);
  if (!rows.ok()) return rows.status();
  if (rows->empty()) return write;
  const CheckRecord& record = rows->front();
  std::optional<StoredCheck> check = changes_->Read(record);
  if (!check) return write;

  std::vector<Found> found = answer.found;
  const std::vector<std::optional<Found>> same =
      TakeSame(*check, answer, &found);
  check->latest = answer.bytes;
  check->stale = false;
  const std::int64_t now_ns = vehicle_->clock();
  core::VarianceReductions reductions = changes_->Reductions();
  for (std::size_t i = 0; i < same.size(); ++i) {
    StoredCandidate& candidate = check->candidates[i];
    candidate.latest_rank = same[i] ? same[i]->candidate.latest_rank : 0;
    // Places in vehicles that were not searched are as probable as they were.
    if (GraphOf(candidate, answer) == nullptr) continue;
    candidate.probability = same[i] ? same[i]->candidate.probability : 0.0;
    candidate.value =
        changes_->ValueOf(record.sequence, candidate, &reductions);
  }
  for (std::size_t i = 0; i < same.size(); ++i) {
    const StoredCandidate& candidate = check->candidates[i];
    const bool is_kept = same[i] && same[i]->is_kept;
    const bool is_open = candidate.state == CandidateState::kOpen;
    // One that closures contradict stays until somebody has looked.
    const bool goes = is_open && !is_kept &&
                      GraphOf(candidate, answer) != nullptr &&
                      candidate.cause != CandidateCause::kContradiction;
    const bool comes_back = candidate.state == CandidateState::kWithdrawn &&
                            candidate.cause == CandidateCause::kSearch &&
                            is_kept;
    if (!goes && !comes_back) continue;
    changes_->Change(record, &*check, i,
                     {goes ? CandidateState::kWithdrawn : CandidateState::kOpen,
                      CandidateCause::kSearch, "", now_ns, ""},
                     &write);
  }
  for (const Found& one : found) {
    if (!one.is_kept) continue;
    StoredCandidate& late = check->candidates.emplace_back(one.candidate);
    late.number = static_cast<std::uint32_t>(check->candidates.size());
    late.cause = CandidateCause::kSearch;
    late.update_time_ns = now_ns;
    changes_->Decide(record.sequence, &late);
    late.value = changes_->ValueOf(record.sequence, late, &reductions);
    changes_->Tell(record.sequence, &*check, check->candidates.size() - 1,
                   &write);
    links_->LookAt(record.sequence, late);
  }
  check->basis =
      basis_->Of(record.sequence, check->candidates,
                 answer.scope == nullptr ? nullptr : answer.scope->ties);
  if (answer.scope != nullptr && !basis_->IsTiedBy(answer.scope->ties)) {
    looks_again_ = true;
  }
  changes_->Put(record, *check, &write);
  return write;
}

}  // namespace revisit::server
