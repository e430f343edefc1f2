// Candidates, printed for people.
#ifndef REVISIT_CLIENT_ANSWERS_CANDIDATE_TEXT_H_
#define REVISIT_CLIENT_ANSWERS_CANDIDATE_TEXT_H_

#include <cstdint>
#include <ostream>
#include <string>

#include "client/terminal/terminal.h"
#include "revisit/v1/candidate.pb.h"
#include "revisit/v1/check.pb.h"

namespace revisit::client {

// The chi-square gate that the verdict of a candidate rests on.
struct DecidingGate {
  // False where the candidate has none, since nothing tells how its frame lies
  // to that of the query.
  bool known = true;
  // Whether it tests the whole aligned path, otherwise the end poses alone.
  bool whole_path = false;
  double squared_distance = 0.0;
  double threshold = 0.0;
  double p_value = 0.0;
  v1::GateVerdict verdict = v1::GATE_VERDICT_UNSPECIFIED;

  // "path", "end" or "none".
  std::string name() const {
    return !known ? "none" : whole_path ? "path" : "end";
  }
  // Whether there are numbers that tell of a distance.
  bool has_distance() const {
    return known && verdict != v1::GATE_VERDICT_ILL_CONDITIONED;
  }
};

// The gate at the end where it rejects, cannot decide, or is the only one;
// otherwise the one on the path. So the gate of an accepted candidate is one
// that it passes, also where the end poses alone would fail.
DecidingGate DecidingGateOf(const v1::Candidate& candidate);

// The recording of a candidate's match: its first sequence. 0 if the server has
// not told it.
std::uint64_t RecordingOfMatch(const v1::Candidate& candidate);

// "sequence 2068, 7012.4 m, 2020-11-26T18:58:17.528Z (1606417097.528 s)": the
// pose before a node, how far it lies along the path, and its time if it has
// one.
std::string PlaceText(const v1::Node& node);

// "-12.0 to +8.0", in metres along the path from the matched node.
std::string IntervalText(const v1::PlaceInterval& interval);

// CheckCandidate.value_square_meters, as people read it.
std::string ValueText(const v1::CheckCandidate& candidate);

// Says that a check is stale.
inline constexpr char kStaleText[] =
    "stale: what this rests on has changed, and it waits to be searched again";

// A line for one check of a stream: its first candidate.
void PrintCheck(const v1::CandidateSet& set, std::ostream& out);

// The members of a group that a search has not searched: a line for each reason
// why. Nothing where it has searched all.
void PrintUnsearched(const v1::CandidateSet& set, std::ostream& out);

// The sequences of each candidate's query and matched node, "2068-1072", each
// on a line: the id under which a loop closure of the two is kept. Of one in
// another vehicle, the two ends "shuttle-7@2068 shuttle-8@1072". `vehicle` is
// the name of the one that asked.
void PrintPairs(const std::string& vehicle, const v1::CandidateSet& set,
                std::ostream& out);

// A table of all candidates below what is known of the query, and above the
// other vehicles in which the search has looked or could not look. Where the
// terminal is wide, it has every number of a candidate, and both gates, and a
// row for each of these vehicles.
void PrintCandidates(const v1::CandidateSet& set, const Terminal& terminal);

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_ANSWERS_CANDIDATE_TEXT_H_
