// Decisions about stored candidates, by whoever has looked at them, and their
// way back.
#ifndef REVISIT_CLIENT_CLI_COMMANDS_CANDIDATE_DECISIONS_H_
#define REVISIT_CLIENT_CLI_COMMANDS_CANDIDATE_DECISIONS_H_

#include <string>
#include <vector>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "client/revisit/client.h"
#include "revisit/v1/check.pb.h"

namespace revisit::client {

// A decision that was made.
struct CandidateDecision {
  enum class Kind {
    // A loop closure was added.
    kConfirmed,
    // A loop closure that others contradict stays.
    kUpheld,
    // A rejected candidate was added; before, the loop closure of a
    // contradicted
    // candidate was deleted.
    kRejected,
  };
  Kind kind = Kind::kConfirmed;
  // Name of the candidate.
  std::string candidate;
  // Name of the loop closure or the rejected candidate that decided.
  std::string made;
  // The loop closures that were deleted for it.
  std::vector<v1::LoopClosure> deleted;
};

// Whether the candidate is open because its loop closure contradicts others.
bool IsContradicted(const v1::CheckCandidate& candidate);

// By what the server orders open candidates: its value, with those first whose
// loop closure contradicts others.
double OrderingValue(const v1::CheckCandidate& candidate);

// Confirms an open candidate: adds a loop closure of the poses of its evidence
// with this note. Where it is contradicted, adds the loop closure that
// confirmed it again as it is, which upholds it; unless that is gone.
absl::StatusOr<CandidateDecision> ConfirmCandidate(
    const Client& client, const v1::CheckCandidate& candidate,
    const v1::Candidate& evidence, const std::string& note);

// Rejects an open candidate with this note. Where it is contradicted, first
// deletes the loop closure that confirmed it: one pair of poses is not both.
absl::StatusOr<CandidateDecision> RejectCandidate(
    const Client& client, const v1::CheckCandidate& candidate,
    const v1::Candidate& evidence, const std::string& note);

// Takes a decision back: deletes what was added, and adds the loop closures
// that were deleted. FAILED_PRECONDITION for one that upheld a loop closure,
// which was there before and stays.
absl::Status UndoDecision(const Client& client,
                          const CandidateDecision& decision);

// Whether a decision can never be made any more: the candidate, its poses or
// its vehicle are gone, or somebody else has decided.
bool IsTooLate(const absl::Status& status);

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_CLI_COMMANDS_CANDIDATE_DECISIONS_H_
