// Scripts by which shells complete command lines.
#ifndef REVISIT_CLIENT_CLI_USAGE_COMPLETION_H_
#define REVISIT_CLIENT_CLI_USAGE_COMPLETION_H_

#include <string>

#include "client/cli/usage/command_usage.h"

namespace revisit::client {

enum class Shell { kBash, kZsh, kFish };

// Completes commands, flags, the words that flags take, and names of files and
// of contexts. The script needs no other and asks no server.
std::string CompletionScript(Shell shell, const CommandUsage& program);

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_CLI_USAGE_COMPLETION_H_
