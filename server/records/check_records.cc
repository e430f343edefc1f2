#include "server/records/check_records.h"

#include <utility>

#include "absl/status/status.h"
#include "server/base/status.h"
#include "server/fields/enums.h"
#include "server/fields/timestamps.h"
#include "server/records/stored_records.pb.h"

namespace revisit::server {
namespace {

constexpr EnumRow<stored::CandidateState, CandidateState> kStates[] = {
    {stored::CANDIDATE_STATE_OPEN, CandidateState::kOpen},
    {stored::CANDIDATE_STATE_CONFIRMED, CandidateState::kConfirmed},
    {stored::CANDIDATE_STATE_REJECTED, CandidateState::kRejected},
    {stored::CANDIDATE_STATE_WITHDRAWN, CandidateState::kWithdrawn}};
constexpr EnumRow<stored::CandidateCause, CandidateCause> kCauses[] = {
    {stored::CANDIDATE_CAUSE_CHECK, CandidateCause::kCheck},
    {stored::CANDIDATE_CAUSE_LOOP_CLOSURE, CandidateCause::kLoopClosure},
    {stored::CANDIDATE_CAUSE_REJECTION, CandidateCause::kRejection},
    {stored::CANDIDATE_CAUSE_DELETION, CandidateCause::kDeletion},
    {stored::CANDIDATE_CAUSE_RETENTION, CandidateCause::kRetention},
    {stored::CANDIDATE_CAUSE_SEARCH, CandidateCause::kSearch},
    {stored::CANDIDATE_CAUSE_CONTRADICTION, CandidateCause::kContradiction}};

void Write(const StoredCandidate& candidate, stored::CheckCandidate* message) {
  message->set_number(candidate.number);
  message->set_rank(candidate.rank);
  message->set_matched_sequence(candidate.matched_sequence);
  message->set_state(ToProto(kStates, candidate.state));
  message->set_cause(ToProto(kCauses, candidate.cause));
  message->set_actor(candidate.actor);
  EncodeTime(candidate.update_time_ns, message->mutable_update_time());
  message->set_decision(candidate.decision);
  message->set_event_number(candidate.event_number);
  message->set_latest_rank(candidate.latest_rank);
  message->set_probability(candidate.probability);
  message->set_value_square_meters(candidate.value);
  message->set_contradicted(candidate.contradicted);
  message->set_matched_vehicle(candidate.matched_vehicle);
  message->set_matched_uid(candidate.matched_uid);
  message->set_place_first(candidate.place_first);
  message->set_place_last(candidate.place_last);
  message->set_group(candidate.group);
}

absl::StatusOr<StoredCandidate> Read(const stored::CheckCandidate& message) {
  StoredCandidate candidate;
  candidate.number = message.number();
  candidate.rank = message.rank();
  candidate.matched_sequence = message.matched_sequence();
  Violations unknown;
  DecodeEnum(kStates, message.state(), FieldPath(), &candidate.state, &unknown);
  DecodeEnum(kCauses, message.cause(), FieldPath(), &candidate.cause, &unknown);
  if (unknown.count() > 0) {
    return Corrupt("a stored candidate is in no state that is known");
  }
  candidate.actor = message.actor();
  candidate.update_time_ns = ToNanoseconds(message.update_time());
  candidate.decision = message.decision();
  candidate.event_number = message.event_number();
  candidate.latest_rank = message.latest_rank();
  candidate.probability = message.probability();
  candidate.value = message.value_square_meters();
  candidate.contradicted = message.contradicted();
  candidate.matched_vehicle = message.matched_vehicle();
  candidate.matched_uid = message.matched_uid();
  candidate.place_first = message.place_first();
  candidate.place_last = message.place_last();
  candidate.group = message.group();
  return candidate;
}

}  // namespace

std::string EncodeCheckRecord(const StoredCheck& check) {
  stored::Check message;
  message.set_vehicle_uid(check.vehicle_uid);
  message.set_candidates(check.found);
  message.set_latest(check.latest);
  message.set_basis(check.basis);
  message.set_stale(check.stale);
  for (const StoredCandidate& candidate : check.candidates) {
    Write(candidate, message.add_states());
  }
  return message.SerializeAsString();
}

absl::StatusOr<StoredCheck> DecodeCheckRecord(const std::string& payload) {
  stored::Check message;
  if (!message.ParseFromString(payload)) {
    return Corrupt("a stored check is not a Check");
  }
  StoredCheck check;
  check.vehicle_uid = message.vehicle_uid();
  check.found = message.candidates();
  check.latest = message.latest();
  check.basis = message.basis();
  check.stale = message.stale();
  for (const stored::CheckCandidate& state : message.states()) {
    absl::StatusOr<StoredCandidate> candidate = Read(state);
    if (!candidate.ok()) return candidate.status();
    check.candidates.push_back(*std::move(candidate));
  }
  return check;
}

std::string EncodeEventRecord(const StoredEvent& event) {
  stored::Event message;
  message.set_vehicle_id(event.vehicle_id);
  message.set_vehicle_uid(event.vehicle_uid);
  if (!event.candidate) {
    message.mutable_vehicle_deleted();
    return message.SerializeAsString();
  }
  stored::CandidateEvent* const changed = message.mutable_candidate();
  changed->set_check_sequence(event.check_sequence);
  Write(*event.candidate, changed->mutable_candidate());
  changed->set_evidence(event.evidence);
  changed->set_revision(event.revision);
  return message.SerializeAsString();
}

absl::StatusOr<StoredEvent> DecodeEventRecord(const std::string& payload) {
  stored::Event message;
  if (!message.ParseFromString(payload) ||
      message.kind_case() == stored::Event::KIND_NOT_SET) {
    return Corrupt("a stored event is not an Event");
  }
  StoredEvent event;
  event.vehicle_id = message.vehicle_id();
  event.vehicle_uid = message.vehicle_uid();
  if (message.has_vehicle_deleted()) return event;
  const stored::CandidateEvent& changed = message.candidate();
  absl::StatusOr<StoredCandidate> candidate = Read(changed.candidate());
  if (!candidate.ok()) return candidate.status();
  event.candidate = *std::move(candidate);
  event.check_sequence = changed.check_sequence();
  event.evidence = changed.evidence();
  event.revision = changed.revision();
  return event;
}

}  // namespace revisit::server
