// revisit checks
#ifndef REVISIT_CLIENT_CLI_COMMANDS_CHECKS_COMMAND_H_
#define REVISIT_CLIENT_CLI_COMMANDS_CHECKS_COMMAND_H_

#include <cstdint>
#include <optional>
#include <string>

#include "absl/status/status.h"
#include "client/cli/flags.h"
#include "client/revisit/client.h"
#include "client/terminal/terminal.h"

namespace revisit::client {

void AddChecksCommand(const Command& program);

struct ChecksOptions {
  // Id or name; "-" for all vehicles.
  std::string vehicle;
  v1::CandidateFilter filter;
  // The order of one vehicle's checks, unless it is UNSPECIFIED or BY_TIME.
  v1::ListChecksOrder order = v1::LIST_CHECKS_ORDER_UNSPECIFIED;
  // Leaves out checks that wait to be searched again.
  bool fresh_only = false;
  // With BY_VALUE: how many looks of each kilometre are recommended; 0 for
  // none.
  int looks_per_kilometer = 0;
};

// Lists the stored checks that have a candidate which the filter lets through,
// of all pages: how many candidates are in each state, and one of those that
// the filter lets through: the best one, or with BY_VALUE the most valuable one
// that is open. As JSON: {"checks": [...], "watchCursor"}, where a watch goes
// on behind the list.
absl::Status RunChecksList(const Client& client, const ChecksOptions& options,
                           const Terminal& terminal);

// Shows one check: what has become of its candidates, above all that was found,
// as `find` prints it: what was told then, and what the last search finds now,
// where it was searched again. As JSON: v1::Check.
absl::Status RunChecksGet(const Client& client, const std::string& vehicle,
                          std::uint64_t sequence, const Terminal& terminal);

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_CLI_COMMANDS_CHECKS_COMMAND_H_
