// The choice of the uncertainty that is claimed for a recording where nobody
// has named one.
#ifndef REVISIT_CLIENT_TRAJECTORY_CLAIM_CHOICE_H_
#define REVISIT_CLIENT_TRAJECTORY_CLAIM_CHOICE_H_

#include <deque>
#include <string>

#include "absl/status/status.h"
#include "client/formats/reader.h"
#include "client/formats/sample.h"
#include "client/trajectory/dead_reckoning.h"

namespace revisit::client {

// INVALID_ARGUMENT if the recording `file` has positions without a heading and
// says nothing of their errors: they may be a receiver's, or add up along the
// drive.
absl::Status CheckThatErrorsAreKnown(const std::string& file,
                                     const Sample& first, Frame frame);

// The source, by the first samples of a recording and whether its vehicle takes
// error transitions. REQUIRES: a sample.
UncertaintyOptions::Source ChooseSource(const std::deque<Sample>& first,
                                        bool is_filter);

// Says for people which covariances are claimed of those that the file states,
// and which flag claims others; empty if there is nothing to say. `chosen` is
// what ChooseSource() has answered.
std::string ChoiceText(const std::deque<Sample>& first,
                       UncertaintyOptions::Source chosen);

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_TRAJECTORY_CLAIM_CHOICE_H_
