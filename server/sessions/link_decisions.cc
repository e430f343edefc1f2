#include "server/sessions/link_decisions.h"

#include <algorithm>
#include <iterator>
#include <utility>

#include "absl/status/status.h"
#include "server/storage/storage.h"

namespace revisit::server {
namespace {

// Rows of one page of a look, some milliseconds.
constexpr int kChecksPerLinkLook = 100;

CandidateState StateBy(const CheckGroup::Link& link) {
  return link.kind == PairKind::kLoopClosure ? CandidateState::kConfirmed
                                             : CandidateState::kRejected;
}

CandidateCause CauseBy(const CheckGroup::Link& link) {
  return link.kind == PairKind::kLoopClosure ? CandidateCause::kLoopClosure
                                             : CandidateCause::kRejection;
}

}  // namespace

bool LinkDecisions::MayLook() const {
  return scopes_ != nullptr && changes_->MayWork() &&
         changes_->HasCandidates() && !watched_.empty();
}

void LinkDecisions::FollowSettings() {
  const std::string& searched = vehicle_->head.config().check_group;
  for (auto it = watched_.begin(); it != watched_.end();) {
    const bool decides = it->second.has_candidates || it->first == searched;
    it = decides ? std::next(it) : watched_.erase(it);
  }
  if (!searched.empty()) watched_.try_emplace(searched);
}

void LinkDecisions::LookAgain() {
  for (auto& [group, watched] : watched_) watched.asks = true;
}

void LinkDecisions::Note(const StoredCandidate& candidate) {
  if (candidate.is_own() || candidate.group.empty()) return;
  watched_[candidate.group].has_candidates = true;
}

void LinkDecisions::LookAt(std::uint64_t check_sequence,
                           const StoredCandidate& candidate) {
  if (candidate.is_own() || candidate.group.empty()) return;
  Watched& watched = watched_[candidate.group];
  watched.has_candidates = true;
  watched.asks = true;
  watched.new_from =
      std::min(watched.new_from.value_or(check_sequence), check_sequence);
}

void LinkDecisions::Consider() {
  if (scopes_ == nullptr) return;
  FollowSettings();
  is_watching_.store(MayLook());
  if (is_at_work_ || !MayLook()) return;
  const auto next =
      std::find_if(watched_.begin(), watched_.end(),
                   [](const auto& entry) { return entry.second.asks; });
  if (next == watched_.end()) return;
  is_at_work_ = true;
  next->second.asks = false;
  Ask(next->first);
}

void LinkDecisions::Ask(const std::string& group) {
  group_id_ = group;
  scopes_->ReadGroup({group, vehicle_->id, vehicle_->head.key()},
                     queue_->AnswerOnStrand<CheckGroupPtr>(
                         [this](absl::StatusOr<CheckGroupPtr> answer) {
                           if (answer.ok() && MayLook()) {
                             Take(*std::move(answer));
                           } else {
                             // The next look asks again.
                             EndLook();
                           }
                         }));
}

void LinkDecisions::EndLook() {
  is_at_work_ = false;
  Consider();
}

void LinkDecisions::Take(CheckGroupPtr group) {
  if (group_id_ == vehicle_->head.config().check_group) {
    const bool knew = basis_->knows_ties();
    const CheckBasis::Version before = basis_->version();
    basis_->Learn(group_id_, group->ties);
    if (!knew || basis_->version() != before) learned_();
  }
  Watched& watched = watched_[group_id_];
  const bool is_seen =
      watched.is_looked_at && watched.version == group->version;
  if (is_seen && !watched.new_from) {
    EndLook();
    return;
  }
  look_from_ = is_seen ? *watched.new_from : 1;
  watched.new_from.reset();
  group_ = std::move(group);
  LookAtNextPage();
}

void LinkDecisions::LookAtNextPage() {
  steps_.Run([this] { return LookAtPage(); },
             [this](bool ok) {
               if (ok && look_from_ != 0) {
                 LookAtNextPage();
                 return;
               }
               Watched& watched = watched_[group_id_];
               watched.is_looked_at = ok;
               watched.version = group_->version;
               group_.reset();
               EndLook();
             });
}

absl::StatusOr<ChecksWrite> LinkDecisions::LookAtPage() {
  ChecksWrite write = changes_->Begin();
  const auto page =
      vehicle_->storage->ListChecks(vehicle_->head.key(), look_from_,
                                    kLastSequence, false, kChecksPerLinkLook);
  if (!page.ok()) return page.status();
  look_from_ = static_cast<int>(page->size()) < kChecksPerLinkLook
                   ? 0
                   : page->back().sequence + 1;
  for (const CheckRecord& record : *page) LookAt(record, &write);
  return write;
}

void LinkDecisions::LookAt(const CheckRecord& record, ChecksWrite* write) {
  std::optional<StoredCheck> check = changes_->Read(record);
  if (!check) return;
  for (std::size_t i = 0; i < check->candidates.size(); ++i) {
    Note(check->candidates[i]);
    const auto transition = Judge(record.sequence, check->candidates[i]);
    if (transition) changes_->Change(record, &*check, i, *transition, write);
  }
}

std::optional<CandidateTransition> LinkDecisions::Judge(
    std::uint64_t check_sequence, const StoredCandidate& candidate) const {
  // Another group decides, or none that is known.
  if (candidate.is_own() || candidate.group != group_id_) return std::nullopt;
  const bool was_decided = candidate.state == CandidateState::kConfirmed ||
                           candidate.state == CandidateState::kRejected;
  const bool is_decided =
      was_decided && std::any_of(group_->links.begin(), group_->links.end(),
                                 [&](const CheckGroup::Link& link) {
                                   return StateBy(link) == candidate.state &&
                                          link.id == candidate.decision;
                                 });
  if (is_decided) return std::nullopt;
  const std::int64_t now_ns = vehicle_->clock();
  if (const auto* const link = FindLink(check_sequence, candidate)) {
    return CandidateTransition{StateBy(*link), CauseBy(*link), link->decided_by,
                               now_ns, link->id};
  }
  const bool is_open = candidate.state == CandidateState::kOpen;
  if (!IsThere(candidate) && (is_open || was_decided)) {
    return CandidateTransition{CandidateState::kWithdrawn,
                               CandidateCause::kRetention, "", now_ns, ""};
  }
  if (was_decided) {
    return CandidateTransition{CandidateState::kOpen, CandidateCause::kDeletion,
                               "", now_ns, ""};
  }
  return std::nullopt;
}

const CheckGroup::Link* LinkDecisions::FindLink(
    std::uint64_t check_sequence, const StoredCandidate& candidate) const {
  const auto found = std::find_if(
      group_->links.begin(), group_->links.end(),
      [&](const CheckGroup::Link& link) {
        return link.other_uid == candidate.matched_uid &&
               link.other_sequence >= candidate.place_first &&
               link.other_sequence <= candidate.place_last &&
               changes_->AreNear(link.own_sequence, check_sequence);
      });
  return found == group_->links.end() ? nullptr : &*found;
}

bool LinkDecisions::IsThere(const StoredCandidate& candidate) const {
  const auto member = group_->members.find(candidate.matched_vehicle);
  return member != group_->members.end() &&
         (member->second.empty() || member->second == candidate.matched_uid);
}

}  // namespace revisit::server
