#include "client/evaluation/service_answer.h"

#include <string>

#include "absl/strings/str_cat.h"
#include "client/answers/candidate_text.h"
#include "client/answers/names.h"

namespace revisit::client {
namespace {

absl::StatusOr<CandidateAnswer> MakeCandidate(const v1::Candidate& given) {
  if (!v1::Verdict_IsValid(given.verdict()) ||
      given.verdict() == v1::VERDICT_UNSPECIFIED) {
    return absl::InternalError(
        absl::StrCat("the server gave a candidate no verdict that this "
                     "program knows: ",
                     static_cast<int>(given.verdict())));
  }
  CandidateAnswer candidate;
  candidate.matched = given.matched().index();
  candidate.verdict = given.verdict();
  const DecidingGate gate = DecidingGateOf(given);
  candidate.has_gate = gate.known;
  candidate.path_gate = gate.whole_path;
  candidate.squared_distance = gate.squared_distance;
  candidate.threshold = gate.threshold;
  candidate.p_value = gate.p_value;
  candidate.opposite = given.direction() == v1::DIRECTION_OPPOSITE;
  candidate.frame_state = given.frame_state();
  candidate.confidence = candidate.p_value;
  if (given.has_probability()) {
    const double probability = given.probability();
    if (!(probability >= 0.0 && probability <= 1.0)) {
      return absl::InternalError(absl::StrCat(
          "the server stated a probability of ", std::to_string(probability)));
    }
    candidate.probability = probability;
    candidate.confidence = probability;
  }
  candidate.meters_before = given.place_interval().meters_before();
  candidate.meters_after = given.place_interval().meters_after();
  return candidate;
}

}  // namespace

absl::StatusOr<CheckAnswer> MakeAnswer(const v1::CandidateSet& set) {
  CheckAnswer answer;
  answer.query = set.query().index();
  answer.search_milliseconds =
      1e3 * static_cast<double>(set.search_duration().seconds()) +
      1e-6 * static_cast<double>(set.search_duration().nanos());
  for (const v1::Candidate& given : set.candidates()) {
    const auto candidate = MakeCandidate(given);
    if (!candidate.ok()) return candidate.status();
    answer.candidates.push_back(*candidate);
  }
  if (set.candidates().empty()) {
    answer.empty_reason = Explain(set.empty_reason());
    answer.none_probable =
        set.empty_reason() == v1::EMPTY_REASON_NO_PROBABLE_PLACE;
  }
  return answer;
}

}  // namespace revisit::client
