#include "server/conversion/stored_checks_codec.h"

#include <algorithm>
#include <cmath>
#include <iterator>
#include <optional>
#include <utility>
#include <vector>

#include "absl/strings/numbers.h"
#include "absl/strings/str_cat.h"
#include "absl/strings/str_split.h"
#include "google/protobuf/arena.h"
#include "revisit/v1/candidate.pb.h"
#include "server/base/status.h"
#include "server/conversion/answers.h"
#include "server/conversion/found_evidence.h"
#include "server/conversion/names.h"
#include "server/conversion/page_token.h"
#include "server/fields/enums.h"
#include "server/fields/timestamps.h"
#include "server/records/check_records.h"

namespace revisit::server {
namespace {

constexpr EnumRow<v1::CandidateState, CandidateState> kStates[] = {
    {v1::CANDIDATE_STATE_OPEN, CandidateState::kOpen},
    {v1::CANDIDATE_STATE_CONFIRMED, CandidateState::kConfirmed},
    {v1::CANDIDATE_STATE_REJECTED, CandidateState::kRejected},
    {v1::CANDIDATE_STATE_WITHDRAWN, CandidateState::kWithdrawn}};
// Every state of the API but UNSPECIFIED has a row.
static_assert(std::size(kStates) == v1::CandidateState_ARRAYSIZE - 1);
constexpr EnumRow<v1::CandidateCause, CandidateCause> kCauses[] = {
    {v1::CANDIDATE_CAUSE_CHECK, CandidateCause::kCheck},
    {v1::CANDIDATE_CAUSE_LOOP_CLOSURE, CandidateCause::kLoopClosure},
    {v1::CANDIDATE_CAUSE_REJECTION, CandidateCause::kRejection},
    {v1::CANDIDATE_CAUSE_DELETION, CandidateCause::kDeletion},
    {v1::CANDIDATE_CAUSE_RETENTION, CandidateCause::kRetention},
    {v1::CANDIDATE_CAUSE_SEARCH, CandidateCause::kSearch},
    {v1::CANDIDATE_CAUSE_CONTRADICTION, CandidateCause::kContradiction}};
static_assert(std::size(kCauses) == v1::CandidateCause_ARRAYSIZE - 1);

constexpr std::size_t kMostVehicles = 100;
constexpr char kCursorList[] = "WatchCandidates";

void Encode(const std::string& vehicle_id, std::uint64_t check_sequence,
            const StoredCandidate& candidate, v1::CheckCandidate* message) {
  message->set_name(
      CheckCandidateName(vehicle_id, check_sequence, candidate.number));
  message->set_rank(candidate.rank);
  message->set_latest_rank(candidate.latest_rank);
  message->set_value_square_meters(candidate.value);
  message->set_state(ToProto(kStates, candidate.state));
  message->set_cause(ToProto(kCauses, candidate.cause));
  message->set_actor(candidate.actor);
  EncodeTime(candidate.update_time_ns, message->mutable_update_time());
  message->set_event_number(candidate.event_number);
  if (!candidate.group.empty()) message->set_group(GroupName(candidate.group));
  const bool is_contradicted =
      candidate.cause == CandidateCause::kContradiction;
  const std::string& decision =
      is_contradicted ? candidate.contradicted : candidate.decision;
  if (decision.empty()) return;
  const PairKind kind =
      is_contradicted || candidate.state == CandidateState::kConfirmed
          ? PairKind::kLoopClosure
          : PairKind::kRejectedCandidate;
  if (!candidate.is_own()) {
    message->set_decision(GroupLinkName(kind, candidate.group, decision));
    return;
  }
  message->set_decision(PosePairResourceName(kind, vehicle_id, decision));
}

const v1::Candidate* WithRank(const v1::CandidateSet& set, int rank) {
  const auto found = std::find_if(
      set.candidates().begin(), set.candidates().end(),
      [&](const v1::Candidate& candidate) { return candidate.rank() == rank; });
  return found == set.candidates().end() ? nullptr : &*found;
}

// What was found of a candidate last; null where that is kept no longer.
const v1::Candidate* EvidenceOf(const v1::Check& check,
                                const v1::CheckCandidate& candidate) {
  return candidate.latest_rank() > 0
             ? WithRank(check.latest(), candidate.latest_rank())
             : WithRank(check.candidates(), candidate.rank());
}

// Leaves out what names a vehicle that the caller may not read.
void LeaveOutHidden(const MayReadVehicle& may_read, v1::CandidateSet* set) {
  const auto leave_out = [&](const auto& vehicle_of, auto* all) {
    const auto is_hidden = [&](const auto& one) {
      const std::string& name = vehicle_of(one);
      return !name.empty() && !may_read(name.substr(VehicleName("").size()));
    };
    all->erase(std::remove_if(all->begin(), all->end(), is_hidden), all->end());
  };
  leave_out([](const v1::Candidate& one) { return one.matched_vehicle(); },
            set->mutable_candidates());
  leave_out([](const v1::SearchedVehicle& one) { return one.vehicle(); },
            set->mutable_searched());
  leave_out([](const v1::UnsearchedVehicle& one) { return one.vehicle(); },
            set->mutable_unsearched());
}

// The values of a repeated enum's field, without UNSPECIFIED.
template <typename Enum>
void ReadValues(const google::protobuf::RepeatedField<int>& values,
                bool (*is_valid)(int), const FieldPath& path, const char* field,
                std::set<Enum>* read, Violations* violations) {
  for (int i = 0; i < values.size(); ++i) {
    if (values[i] == 0 || !is_valid(values[i])) {
      AddUnknownValue(values[i], path.At(field, static_cast<std::size_t>(i)),
                      violations);
      continue;
    }
    read->insert(static_cast<Enum>(values[i]));
  }
}

}  // namespace

// ---- The store

std::string ProtoCheckCodec::EncodeFound(const VehicleView& view,
                                         const core::CandidateSet& set,
                                         std::chrono::nanoseconds duration,
                                         const CheckScope* scope) const {
  google::protobuf::Arena arena;
  auto* const message =
      google::protobuf::Arena::CreateMessage<v1::CandidateSet>(&arena);
  EncodeCandidateSet(view, set, /*include_aligned_path=*/false, duration,
                     message, scope == nullptr ? nullptr : scope->group.get());
  return message->SerializeAsString();
}

std::string ProtoCheckCodec::EncodeCheck(const StoredCheck& check) const {
  return EncodeCheckRecord(check);
}

absl::StatusOr<StoredCheck> ProtoCheckCodec::DecodeCheck(
    const std::string& payload) const {
  return DecodeCheckRecord(payload);
}

std::string ProtoCheckCodec::EncodeEvent(const EventOrigin& origin,
                                         std::uint64_t check_sequence,
                                         const StoredCheck& check,
                                         std::size_t index) const {
  StoredEvent event;
  event.vehicle_id = origin.vehicle_id;
  event.vehicle_uid = origin.vehicle_uid;
  event.candidate = check.candidates[index];
  event.check_sequence = check_sequence;
  const bool is_latest = event.candidate->latest_rank > 0;
  FoundEvidence found = FindEvidence(
      is_latest ? check.latest : check.found,
      is_latest ? event.candidate->latest_rank : event.candidate->rank);
  event.revision = found.revision;
  event.evidence = std::move(found.evidence);
  return EncodeEventRecord(event);
}

std::string ProtoCheckCodec::EncodeFarewell(const EventOrigin& origin) const {
  StoredEvent event;
  event.vehicle_id = origin.vehicle_id;
  event.vehicle_uid = origin.vehicle_uid;
  return EncodeEventRecord(event);
}

// ---- Answers

absl::Status EncodeCheck(const std::string& vehicle_id,
                         const CheckRecord& record,
                         const MayReadVehicle& may_read, v1::Check* message) {
  if (!record.damage.ok()) return record.damage;
  const absl::StatusOr<StoredCheck> stored = DecodeCheckRecord(record.payload);
  if (!stored.ok()) return stored.status();
  if (!message->mutable_candidates()->ParseFromString(stored->found)) {
    return Corrupt(absl::StrCat("what stored check ", record.sequence,
                                " of vehicle '", vehicle_id,
                                "' found is not a CandidateSet"));
  }
  if (!stored->latest.empty() &&
      !message->mutable_latest()->ParseFromString(stored->latest)) {
    return Corrupt(absl::StrCat("what stored check ", record.sequence,
                                " of vehicle '", vehicle_id,
                                "' found last is not a CandidateSet"));
  }
  LeaveOutHidden(may_read, message->mutable_candidates());
  if (message->has_latest()) {
    LeaveOutHidden(may_read, message->mutable_latest());
  }
  message->set_stale(stored->stale);
  message->set_name(CheckName(vehicle_id, record.sequence));
  message->set_vehicle_uid(stored->vehicle_uid);
  for (const StoredCandidate& candidate : stored->candidates) {
    if (!candidate.is_own() && !may_read(candidate.matched_vehicle)) continue;
    Encode(vehicle_id, record.sequence, candidate, message->add_states());
  }
  EncodeTime(record.create_time_ns, message->mutable_create_time());
  return absl::OkStatus();
}

absl::Status EncodeEvent(const EventRecord& record,
                         v1::WatchCandidatesResponse* message,
                         std::string* matched_vehicle_id) {
  if (!record.damage.ok()) return record.damage;
  const absl::StatusOr<StoredEvent> stored = DecodeEventRecord(record.payload);
  if (!stored.ok()) return stored.status();
  if (!stored->candidate) {
    v1::VehicleDeleted* const deleted = message->mutable_vehicle_deleted();
    deleted->set_vehicle(VehicleName(stored->vehicle_id));
    deleted->set_vehicle_uid(stored->vehicle_uid);
    deleted->set_number(record.number);
    EncodeTime(record.time_ns, deleted->mutable_event_time());
    return absl::OkStatus();
  }
  v1::CandidateEvent* const event = message->mutable_candidate();
  event->set_check(CheckName(stored->vehicle_id, stored->check_sequence));
  event->set_number(record.number);
  event->set_vehicle_uid(stored->vehicle_uid);
  Encode(stored->vehicle_id, stored->check_sequence, *stored->candidate,
         event->mutable_candidate());
  if (!event->mutable_evidence()->ParseFromString(stored->evidence)) {
    return Corrupt("the evidence of a stored event is not a Candidate");
  }
  event->set_revision(stored->revision);
  *matched_vehicle_id = stored->candidate->matched_vehicle;
  EncodeTime(record.time_ns, event->mutable_event_time());
  return absl::OkStatus();
}

// ---- Filters and cursors

absl::StatusOr<CandidateFilter> DecodeFilter(const v1::CandidateFilter& message,
                                             const FieldPath& path) {
  CandidateFilter filter;
  Violations violations;
  if (static_cast<std::size_t>(message.vehicles_size()) > kMostVehicles) {
    violations.Add(kInvalidField, path.Field("vehicles"),
                   absl::StrCat("got ", message.vehicles_size(),
                                " vehicles; allowed are ", kMostVehicles));
  }
  for (int i = 0; i < message.vehicles_size(); ++i) {
    const absl::StatusOr<std::string> id = ParseVehicleName(
        message.vehicles(i), path.At("vehicles", static_cast<std::size_t>(i)));
    if (!id.ok()) return id.status();
    filter.vehicles.insert(*id);
  }
  ReadValues(message.states(), v1::CandidateState_IsValid, path, "states",
             &filter.states, &violations);
  ReadValues(message.verdicts(), v1::Verdict_IsValid, path, "verdicts",
             &filter.verdicts, &violations);
  filter.least_probability = message.least_probability();
  // Written so that NaN is out of range.
  if (!(filter.least_probability >= 0.0 && filter.least_probability <= 1.0)) {
    violations.Add(
        kInvalidField, path.Field("least_probability"),
        absl::StrCat("got ", filter.least_probability, "; allowed is [0, 1]"));
  }
  filter.least_value = message.least_value_square_meters();
  if (!(filter.least_value >= 0.0 && std::isfinite(filter.least_value))) {
    violations.Add(
        kInvalidField, path.Field("least_value_square_meters"),
        absl::StrCat("got ", filter.least_value, "; allowed is [0, infinity)"));
  }
  if (violations.count() > 0) return violations.ToStatus();
  return filter;
}

bool Matches(const CandidateFilter& filter, const v1::CheckCandidate& candidate,
             const v1::Candidate& evidence) {
  return (filter.states.empty() ||
          filter.states.count(candidate.state()) > 0) &&
         (filter.verdicts.empty() ||
          filter.verdicts.count(evidence.verdict()) > 0) &&
         // A candidate without a probability is as probable as 0.
         evidence.probability() >= filter.least_probability &&
         candidate.value_square_meters() >= filter.least_value;
}

bool Matches(const CandidateFilter& filter, const v1::Check& check,
             const v1::CheckCandidate& candidate) {
  const v1::Candidate* const evidence = EvidenceOf(check, candidate);
  return Matches(
      filter, candidate,
      evidence == nullptr ? v1::Candidate::default_instance() : *evidence);
}

bool Matches(const CandidateFilter& filter, const v1::Check& check) {
  return std::any_of(check.states().begin(), check.states().end(),
                     [&](const v1::CheckCandidate& candidate) {
                       return Matches(filter, check, candidate);
                     });
}

std::string MakeCursor(const EventPosition& position) {
  return MakePageToken(kCursorList,
                       absl::StrCat(position.order, ".", position.key, ".",
                                    position.number, ".", position.checksum));
}

absl::StatusOr<EventPosition> ParseCursor(const std::string& cursor,
                                          const FieldPath& path) {
  const std::optional<std::string> key = OpenToken(kCursorList, cursor);
  EventPosition position;
  const std::vector<std::string> parts =
      absl::StrSplit(absl::string_view(key ? key->c_str() : ""), '.');
  if (parts.size() != 4 ||
      !absl::SimpleAtoi(absl::string_view(parts[0].data(), parts[0].size()),
                        &position.order) ||
      !absl::SimpleAtoi(absl::string_view(parts[1].data(), parts[1].size()),
                        &position.key) ||
      !absl::SimpleAtoi(absl::string_view(parts[2].data(), parts[2].size()),
                        &position.number) ||
      !absl::SimpleAtoi(absl::string_view(parts[3].data(), parts[3].size()),
                        &position.checksum)) {
    return InvalidField("INVALID_CURSOR", path,
                        "no server has given it; take the `cursor` of a "
                        "response, the `watch_cursor` of a list, or leave it "
                        "empty to begin now");
  }
  return position;
}

}  // namespace revisit::server
