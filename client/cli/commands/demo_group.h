// The last part of revisit demo: its two days as two vehicles of one group.
#ifndef REVISIT_CLIENT_CLI_COMMANDS_DEMO_GROUP_H_
#define REVISIT_CLIENT_CLI_COMMANDS_DEMO_GROUP_H_

#include <string>

#include "absl/status/statusor.h"
#include "client/evaluation/evaluate_options.h"
#include "client/terminal/terminal.h"

namespace revisit::client {

inline constexpr char kDemoGroup[] = "demo";
// The vehicle of the second day, which asks.
inline constexpr char kDemoAsking[] = "demo-day-2";

// Makes both vehicles and the group on the server at this address, and prints
// what the second day finds in the first one before and after a loop closure
// between them. The drive is the first of `options.files`. Draws both days in
// one map beside `options.map`, and returns its name.
absl::StatusOr<std::string> RunDemoGroup(const EvaluateOptions& options,
                                         const std::string& address,
                                         const Terminal& terminal);

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_CLI_COMMANDS_DEMO_GROUP_H_
