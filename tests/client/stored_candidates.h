// Checks and events of stored candidates, as a server has them.
#ifndef REVISIT_TESTS_CLIENT_STORED_CANDIDATES_H_
#define REVISIT_TESTS_CLIENT_STORED_CANDIDATES_H_

#include <cstdint>
#include <string>
#include <vector>

#include "revisit/v1/pose_graph_service.pb.h"

namespace revisit::client {

inline std::string CheckName(const std::string& vehicle,
                             std::uint64_t sequence) {
  return "vehicles/" + vehicle + "/checks/" + std::to_string(sequence);
}

// The event of this number, about candidate 1 of the check at pose 100 times
// the number, which matched the pose of the number. The vehicle's uid is "uid
// of VEHICLE".
inline v1::WatchCandidatesResponse EventOf(
    const std::string& vehicle, std::uint64_t number,
    v1::CandidateState state = v1::CANDIDATE_STATE_OPEN) {
  v1::WatchCandidatesResponse response;
  v1::CandidateEvent* const event = response.mutable_candidate();
  event->set_check(CheckName(vehicle, 100 * number));
  event->set_number(number);
  event->set_vehicle_uid("uid of " + vehicle);
  event->mutable_candidate()->set_name(event->check() + "/candidates/1");
  event->mutable_candidate()->set_rank(1);
  event->mutable_candidate()->set_state(state);
  event->mutable_evidence()->set_rank(1);
  event->mutable_evidence()->mutable_query()->set_sequence(100 * number);
  event->mutable_evidence()->mutable_matched()->set_sequence(number);
  return response;
}

// A check whose candidates have these states, in the order of rank. The first
// one has the probability 0.9, the next ones a tenth of the one before each,
// and they match poses 10, 20, ...
inline v1::Check CheckOf(const std::string& vehicle, std::uint64_t sequence,
                         const std::vector<v1::CandidateState>& states) {
  v1::Check check;
  check.set_name(CheckName(vehicle, sequence));
  check.mutable_candidates()->mutable_query()->set_sequence(sequence);
  check.mutable_candidates()->set_revision(7);
  double probability = 0.9;
  for (const v1::CandidateState state : states) {
    const int rank = check.states_size() + 1;
    v1::Candidate* const evidence =
        check.mutable_candidates()->add_candidates();
    evidence->set_rank(rank);
    evidence->mutable_query()->set_sequence(sequence);
    evidence->mutable_matched()->set_sequence(10 *
                                              static_cast<std::uint64_t>(rank));
    evidence->set_probability(probability);
    evidence->set_verdict(rank == 1 ? v1::VERDICT_ACCEPTED
                                    : v1::VERDICT_AMBIGUOUS);
    probability *= 0.1;
    v1::CheckCandidate* const candidate = check.add_states();
    candidate->set_name(check.name() + "/candidates/" + std::to_string(rank));
    candidate->set_rank(rank);
    candidate->set_state(state);
    candidate->set_cause(v1::CANDIDATE_CAUSE_CHECK);
    candidate->mutable_update_time()->set_seconds(60);
  }
  return check;
}

// Has a later search, at revision 9, find one candidate of the check alone,
// with this probability, so that it has this value.
inline void SearchAgain(v1::Check* check, int candidate, double probability,
                        double value) {
  v1::CheckCandidate* const state = check->mutable_states(candidate - 1);
  v1::CandidateSet* const latest = check->mutable_latest();
  *latest = check->candidates();
  latest->clear_candidates();
  latest->set_revision(9);
  v1::Candidate* const found = latest->add_candidates();
  if (state->rank() > 0) {
    *found = check->candidates().candidates(state->rank() - 1);
  }
  found->set_rank(1);
  found->set_probability(probability);
  state->set_latest_rank(1);
  state->set_value_square_meters(value);
}

}  // namespace revisit::client

#endif  // REVISIT_TESTS_CLIENT_STORED_CANDIDATES_H_
