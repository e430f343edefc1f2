#include "client/cli/commands/candidate_decisions.h"

#include <cstddef>
#include <limits>
#include <optional>
#include <utility>

#include "absl/strings/str_cat.h"
#include "client/answers/names.h"
#include "client/revisit/status.h"
#include "client/trajectory/stored_poses.h"

namespace revisit::client {
namespace {

// "vehicles/a" of the name of anything that the vehicle has.
std::string VehicleOf(const std::string& name) {
  const std::size_t id = name.find('/');
  return id == name.npos ? name : name.substr(0, name.find('/', id + 1));
}

// The loop closure that confirmed a contradicted candidate. None of another
// candidate, and where it is gone: then this is one as any other.
absl::StatusOr<std::optional<v1::LoopClosure>> ClosureOf(
    const Client& client, const v1::CheckCandidate& candidate) {
  if (!IsContradicted(candidate)) return std::nullopt;
  const auto all = ReadLoopClosures(client, VehicleOf(candidate.name()));
  if (!all.ok()) return all.status();
  for (const v1::LoopClosure& closure : *all) {
    if (closure.name() == candidate.decision()) return closure;
  }
  return std::nullopt;
}

template <typename Pair>
void Link(const v1::Candidate& evidence, const std::string& note, Pair* pair) {
  pair->set_query_sequence(evidence.query().sequence());
  pair->set_matched_sequence(evidence.matched().sequence());
  pair->set_note(note);
}

// Adds a loop closure as it was, or is.
absl::Status AddAgain(const Client& client, const v1::LoopClosure& closure,
                      const std::string& candidate) {
  v1::AddLoopClosureRequest request;
  request.set_parent(VehicleOf(closure.name()));
  request.set_loop_closure_id(IdOf(closure.name()));
  request.set_candidate(candidate);
  *request.mutable_loop_closure() = closure;
  return client.AddLoopClosure(request).status();
}

}  // namespace

bool IsContradicted(const v1::CheckCandidate& candidate) {
  return candidate.state() == v1::CANDIDATE_STATE_OPEN &&
         candidate.cause() == v1::CANDIDATE_CAUSE_CONTRADICTION;
}

double OrderingValue(const v1::CheckCandidate& candidate) {
  return IsContradicted(candidate) ? std::numeric_limits<double>::infinity()
                                   : candidate.value_square_meters();
}

absl::StatusOr<CandidateDecision> ConfirmCandidate(
    const Client& client, const v1::CheckCandidate& candidate,
    const v1::Candidate& evidence, const std::string& note) {
  using Kind = CandidateDecision::Kind;
  const auto closure = ClosureOf(client, candidate);
  if (!closure.ok()) return closure.status();
  if (closure->has_value()) {
    if (absl::Status added = AddAgain(client, **closure, candidate.name());
        !added.ok()) {
      return added;
    }
    return CandidateDecision{
        Kind::kUpheld, candidate.name(), (*closure)->name(), {}};
  }
  v1::AddLoopClosureRequest request;
  request.set_parent(VehicleOf(candidate.name()));
  request.set_candidate(candidate.name());
  Link(evidence, note, request.mutable_loop_closure());
  const auto added = client.AddLoopClosure(request);
  if (!added.ok()) return added.status();
  return CandidateDecision{
      Kind::kConfirmed, candidate.name(), added->loop_closure().name(), {}};
}

absl::StatusOr<CandidateDecision> RejectCandidate(
    const Client& client, const v1::CheckCandidate& candidate,
    const v1::Candidate& evidence, const std::string& note) {
  CandidateDecision decision;
  decision.kind = CandidateDecision::Kind::kRejected;
  decision.candidate = candidate.name();
  auto closure = ClosureOf(client, candidate);
  if (!closure.ok()) return closure.status();
  if (closure->has_value()) {
    v1::DeleteLoopClosureRequest request;
    request.set_name((*closure)->name());
    const auto deleted = client.DeleteLoopClosure(request);
    if (!deleted.ok()) return deleted.status();
    decision.deleted.push_back(**std::move(closure));
  }
  v1::RejectCandidateRequest request;
  request.set_parent(VehicleOf(candidate.name()));
  request.set_candidate(candidate.name());
  Link(evidence, note, request.mutable_rejected_candidate());
  const auto added = client.RejectCandidate(request);
  if (!added.ok()) return added.status();
  decision.made = added->rejected_candidate().name();
  return decision;
}

absl::Status UndoDecision(const Client& client,
                          const CandidateDecision& decision) {
  switch (decision.kind) {
    case CandidateDecision::Kind::kUpheld:
      return absl::FailedPreconditionError(absl::StrCat(
          decision.made, " was there before and stays: nothing is undone"));
    case CandidateDecision::Kind::kConfirmed: {
      v1::DeleteLoopClosureRequest request;
      request.set_name(decision.made);
      return client.DeleteLoopClosure(request).status();
    }
    case CandidateDecision::Kind::kRejected:
      break;
  }
  v1::DeleteRejectedCandidateRequest request;
  request.set_name(decision.made);
  absl::Status undone = client.DeleteRejectedCandidate(request).status();
  for (const v1::LoopClosure& closure : decision.deleted) {
    if (!undone.ok()) break;
    undone = AddAgain(client, closure, decision.candidate);
  }
  return undone;
}

bool IsTooLate(const absl::Status& status) {
  return absl::IsNotFound(status) || absl::IsAlreadyExists(status) ||
         absl::IsOutOfRange(status) ||
         DetailsOf(status).reason == "POSE_PAIR_CONFLICT";
}

}  // namespace revisit::client
