// revisit contradictions
#ifndef REVISIT_CLIENT_CLI_COMMANDS_CONTRADICTIONS_COMMAND_H_
#define REVISIT_CLIENT_CLI_COMMANDS_CONTRADICTIONS_COMMAND_H_

#include <string>

#include "absl/status/status.h"
#include "client/cli/flags.h"
#include "client/revisit/client.h"
#include "client/terminal/terminal.h"

namespace revisit::client {

void AddContradictionsCommand(const Command& program);

// Lists the loop closures that contradict others, the least probable first,
// each with its poses and who decided. As names: those of the loop closures. As
// JSON: v1::FindContradictionsResponse.
absl::Status RunContradictions(const Client& client, const std::string& vehicle,
                               const Terminal& terminal);

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_CLI_COMMANDS_CONTRADICTIONS_COMMAND_H_
