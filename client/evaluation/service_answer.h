// Answers of the service in the terms in which they are judged.
#ifndef REVISIT_CLIENT_EVALUATION_SERVICE_ANSWER_H_
#define REVISIT_CLIENT_EVALUATION_SERVICE_ANSWER_H_

#include "absl/status/statusor.h"
#include "client/evaluation/evaluation.h"
#include "revisit/v1/candidate.pb.h"

namespace revisit::client {

// The answer to one check. INTERNAL if it says what no server may say.
absl::StatusOr<CheckAnswer> MakeAnswer(const v1::CandidateSet& set);

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_EVALUATION_SERVICE_ANSWER_H_
