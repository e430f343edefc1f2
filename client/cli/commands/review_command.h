// revisit review
#ifndef REVISIT_CLIENT_CLI_COMMANDS_REVIEW_COMMAND_H_
#define REVISIT_CLIENT_CLI_COMMANDS_REVIEW_COMMAND_H_

#include <istream>
#include <string>

#include "absl/status/status.h"
#include "client/cli/flags.h"
#include "client/revisit/client.h"
#include "client/terminal/terminal.h"

namespace revisit::client {

void AddReviewCommand(const Command& program);

struct ReviewOptions {
  // Id or name.
  std::string vehicle;
  // Which candidates are shown; of its states, OPEN alone is.
  v1::CandidateFilter filter;
  // Leaves out those of checks that wait to be searched again.
  bool fresh_only = false;
  // Goes with every decision.
  std::string note;
};

// Shows the open candidates of a vehicle, the contradicted and then the most
// valuable first, each as the
// server knows it by then, and does with it what the next line of `answers`
// says: "c" confirms, "r" rejects, "s" or an empty line leaves it open, "u"
// takes the last decision back and shows its candidate again, and "q", or the
// end of the input, ends. Another line is told with what is allowed. A decision
// that comes too late is told and left.
//
// The questions are progress; candidates and decisions are results, and lines
// of JSON where that is asked for: {"candidate", "evidence", "told", "stale"}
// (review_text.h) and {"decision": "confirmed", "upheld", "rejected", "skipped"
// or "undone", "candidate": name}.
absl::Status RunReview(const Client& client, const ReviewOptions& options,
                       std::istream& answers, const Terminal& terminal);

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_CLI_COMMANDS_REVIEW_COMMAND_H_
