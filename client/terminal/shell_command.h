// Commands of the caller's own, run by the shell.
#ifndef REVISIT_CLIENT_TERMINAL_SHELL_COMMAND_H_
#define REVISIT_CLIENT_TERMINAL_SHELL_COMMAND_H_

#include <string>

#include "absl/status/statusor.h"

namespace revisit::client {

// How a command ended.
struct CommandEnd {
  // Its exit code, unless a signal ended it.
  int exit_code = 0;
  // 0 if none did.
  int signal = 0;

  // "exit code 3", or "signal 9 (Killed)".
  std::string text() const;
};

// Runs a command by /bin/sh with this text as its standard input, and waits for
// its end. Its standard output is this process's standard error, since the
// standard output is for results. An error if it cannot be run, or its input
// cannot be kept.
absl::StatusOr<CommandEnd> RunShellCommand(const std::string& command,
                                           const std::string& input);

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_TERMINAL_SHELL_COMMAND_H_
