// Which candidates are accepted, and why the others are not.
#ifndef REVISIT_CORE_SEARCH_CANDIDATES_VERDICT_H_
#define REVISIT_CORE_SEARCH_CANDIDATES_VERDICT_H_

#include "core/search/candidates/gate_result.h"
#include "core/search/candidates/relative_evidence.h"

namespace revisit::core {

// Why a candidate is accepted or not: see Decide(). Verdicts are numbered from
// 0 without gaps. A new one has its name in candidate.proto, in kVerdicts of
// server/conversion/answers.cc and in server/telemetry/service_counters.cc, its
// words in client/answers/candidate_text.cc, its style in
// client/map/server_map.cc, and in views/drive.ts and style.css of
// client/console/web.
enum class Verdict {
  kAccepted,
  kRejectedByGate,
  kRejectedByShape,
  kAmbiguous,
  kUninformative,
  kIllConditioned,
};

// The verdict where only the gate decides.
Verdict GateAlone(GateVerdict gate);

// Posterior probabilities of what else may be true.
struct Alternatives {
  // The best other place.
  double runner_up = 0.0;
  // No place of the history.
  double new_place = 0.0;
};

// The verdict on a candidate of a relative alignment, the first that applies:
//
//   rejected by gate   the gate rejects the end's difference, both that of the
//                      two poses and that estimated from the whole path: one
//                      noisy end pose does not count against the path
//   ill-conditioned    the gate has no covariance to decide by
//   rejected by shape  the gate rejects the path
//   accepted           the place is probable enough
//   ambiguous          the history as a whole is probable enough, but no other
//                      place is, nor is any more than ten times as probable
//   uninformative      not even the same shape with coinciding ends would be
//                      probable enough
//   rejected by shape  all others
//
// `gate` is the decision on the two end poses, or null where nothing tells how
// their frames lie to each other: then it does not count. "Probable enough" is
// `acceptance_probability`.
Verdict Decide(const GateResult* gate, const RelativeEvidence& evidence,
               const Alternatives& alternatives, double acceptance_probability);

}  // namespace revisit::core

#endif  // REVISIT_CORE_SEARCH_CANDIDATES_VERDICT_H_
