// An open candidate, printed for somebody who is to decide about it.
#ifndef REVISIT_CLIENT_ANSWERS_REVIEW_TEXT_H_
#define REVISIT_CLIENT_ANSWERS_REVIEW_TEXT_H_

#include <ostream>
#include <string>

#include "nlohmann/json_fwd.hpp"
#include "revisit/v1/check.pb.h"

namespace revisit::client {

// A paragraph: the two places, the value, what was told then and what is found
// now, the difference of the two poses with its standard deviations, and what
// makes a second look necessary.
void PrintForReview(const v1::Check& check, const v1::CheckCandidate& candidate,
                    std::ostream& out);

// The same as JSON: {"candidate": CheckCandidate, "evidence": Candidate,
// "told": Candidate, "stale": bool}. "told" is there where the first search
// found it, and "evidence" is what the last one did.
nlohmann::ordered_json ForReview(const v1::Check& check,
                                 const v1::CheckCandidate& candidate);

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_ANSWERS_REVIEW_TEXT_H_
