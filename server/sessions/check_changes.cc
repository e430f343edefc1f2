#include "server/sessions/check_changes.h"

#include <algorithm>
#include <cmath>
#include <tuple>
#include <utility>

#include "core/drive/node_range.h"

namespace revisit::server {

std::uint64_t PoseOf(const core::PoseGraph& graph, core::NodeIndex index) {
  const core::Node node = graph.node(index);
  return node.sequence + (node.fraction > 0.0 ? 1 : 0);
}

double TravelledAt(const core::PoseGraph& graph, std::uint64_t sequence) {
  const auto node = graph.NodeAtOrBefore(sequence);
  return node ? graph.node(*node).travelled_meters : 0.0;
}

std::pair<std::uint64_t, std::uint64_t> PlaceAround(
    const core::PoseGraph& graph, core::NodeIndex node,
    std::uint64_t last_sequence) {
  const double here = graph.node(node).travelled_meters;
  core::NodeIndex first = node;
  core::NodeIndex last = node;
  while (first > 0 && here - graph.node(first - 1).travelled_meters <=
                          core::kPlaceRadiusMeters) {
    --first;
  }
  while (last + 1 < graph.size() &&
         graph.node(last + 1).travelled_meters - here <=
             core::kPlaceRadiusMeters) {
    ++last;
  }
  return {PoseOf(graph, first), last + 1 < graph.size()
                                    ? PoseOf(graph, last + 1) - 1
                                    : last_sequence};
}

void SetMatch(const core::PoseGraph& graph, const core::Candidate& candidate,
              const CheckScope* scope, StoredCandidate* stored) {
  if (!candidate.drive) {
    stored->matched_sequence = PoseOf(graph, candidate.matched);
    return;
  }
  const std::size_t drive = *candidate.drive;
  const CheckScope::Vehicle& vehicle = scope->vehicles[drive];
  const core::PoseGraph& other = scope->search.drives->view(drive).graph;
  stored->matched_sequence = PoseOf(other, candidate.matched);
  stored->matched_vehicle = vehicle.id;
  stored->matched_uid = vehicle.uid;
  std::tie(stored->place_first, stored->place_last) =
      PlaceAround(other, candidate.matched, vehicle.last_sequence);
  stored->group = scope->group_id;
}

double ProbabilityOf(const core::Candidate& candidate) {
  return candidate.relative ? candidate.relative->probability : 0.0;
}

bool IsWorthKeeping(const core::Candidate& candidate, double keep_probability) {
  return candidate.relative
             ? candidate.relative->probability >= keep_probability
             : candidate.verdict == core::Verdict::kAccepted;
}

bool CheckChanges::MayWork() const {
  return codec_ != nullptr && !vehicle_->gone_status() && vehicle_->loaded &&
         vehicle_->Writable().ok();
}

ChecksWrite CheckChanges::Begin() const {
  ChecksWrite write;
  write.before = write.after = vehicle_->head.checks();
  return write;
}

std::optional<StoredCheck> CheckChanges::Read(const CheckRecord& record) const {
  if (!record.damage.ok()) return std::nullopt;
  absl::StatusOr<StoredCheck> check = codec_->DecodeCheck(record.payload);
  if (!check.ok()) return std::nullopt;
  return *std::move(check);
}

void CheckChanges::Put(const CheckRecord& record, const StoredCheck& check,
                       ChecksWrite* write) const {
  CheckRecord changed = record;
  changed.open_count = OpenCount(check);
  changed.payload = codec_->EncodeCheck(check);
  if (!write->checks.empty() &&
      write->checks.back().sequence == record.sequence) {
    write->checks.back() = std::move(changed);
  } else {
    write->checks.push_back(std::move(changed));
  }
}

void CheckChanges::Change(const CheckRecord& record, StoredCheck* check,
                          std::size_t index,
                          const CandidateTransition& transition,
                          ChecksWrite* write) const {
  StoredCandidate& candidate = check->candidates[index];
  candidate.state = transition.state;
  candidate.cause = transition.cause;
  candidate.actor = transition.actor;
  candidate.update_time_ns = transition.time_ns;
  candidate.decision = transition.decision;
  core::VarianceReductions reductions = Reductions();
  candidate.value = ValueOf(record.sequence, candidate, &reductions);
  Tell(record.sequence, check, index, write);
  Put(record, *check, write);
}

void CheckChanges::Tell(std::uint64_t sequence, StoredCheck* check,
                        std::size_t index, ChecksWrite* write) const {
  StoredCandidate& candidate = check->candidates[index];
  candidate.event_number = ++write->after.last_event;
  EventRecord& event = write->events.emplace_back();
  event.time_ns = candidate.update_time_ns;
  event.payload = codec_->EncodeEvent(
      {vehicle_->id, vehicle_->head.config().uid}, sequence, *check, index);
}

double CheckChanges::TravelledAt(std::uint64_t sequence) const {
  return server::TravelledAt(vehicle_->loaded->graph(), sequence);
}

bool CheckChanges::AreNear(std::uint64_t a, std::uint64_t b) const {
  return std::abs(TravelledAt(a) - TravelledAt(b)) <= core::kPlaceRadiusMeters;
}

bool CheckChanges::IsPair(const PosePairRecord& pair, std::uint64_t query,
                          const StoredCandidate& candidate) const {
  if (!candidate.is_own()) return false;
  const std::uint64_t matched = candidate.matched_sequence;
  return (AreNear(pair.query_sequence, query) &&
          AreNear(pair.matched_sequence, matched)) ||
         (AreNear(pair.query_sequence, matched) &&
          AreNear(pair.matched_sequence, query));
}

void CheckChanges::Decide(std::uint64_t sequence,
                          StoredCandidate* candidate) const {
  for (const PairKind kind : kPairKinds) {
    for (const auto& [id, pair] : vehicle_->pairs.Of(kind)) {
      if (!pair.damage.ok() || !IsPair(pair, sequence, *candidate)) continue;
      const bool confirms = kind == PairKind::kLoopClosure;
      candidate->state =
          confirms ? CandidateState::kConfirmed : CandidateState::kRejected;
      candidate->cause =
          confirms ? CandidateCause::kLoopClosure : CandidateCause::kRejection;
      candidate->decision = id;
      return;
    }
  }
}

double CheckChanges::ValueOf(std::uint64_t sequence,
                             const StoredCandidate& candidate,
                             core::VarianceReductions* reductions) const {
  if (candidate.state != CandidateState::kOpen || !candidate.is_own() ||
      candidate.probability <= 0.0) {
    return 0.0;
  }
  const core::PoseGraph& graph = vehicle_->loaded->graph();
  const auto query = graph.NodeAtOrBefore(sequence);
  const auto matched = graph.NodeAtOrBefore(candidate.matched_sequence);
  if (!query || !matched) return 0.0;
  return candidate.probability * reductions->Of(*query, *matched);
}

std::uint32_t CheckChanges::OpenCount(const StoredCheck& check) {
  return static_cast<std::uint32_t>(
      std::count_if(check.candidates.begin(), check.candidates.end(),
                    [](const StoredCandidate& candidate) {
                      return candidate.state == CandidateState::kOpen;
                    }));
}

}  // namespace revisit::server
