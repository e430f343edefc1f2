// revisit deletions list
#ifndef REVISIT_CLIENT_CLI_COMMANDS_DELETIONS_COMMAND_H_
#define REVISIT_CLIENT_CLI_COMMANDS_DELETIONS_COMMAND_H_

#include <string>

#include "absl/status/status.h"
#include "client/cli/flags.h"
#include "client/revisit/client.h"
#include "client/terminal/terminal.h"

namespace revisit::client {

void AddDeletionsCommand(const Command& program);

// Lists the loop closures and rejections of a vehicle that were deleted, the
// last one first, of all pages. As JSON: {"deletedPosePairs": [...]}.
absl::Status RunDeletionsList(const Client& client, const std::string& vehicle,
                              const Terminal& terminal);

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_CLI_COMMANDS_DELETIONS_COMMAND_H_
