// revisit help, revisit completion, revisit man-pages
#ifndef REVISIT_CLIENT_CLI_COMMANDS_HELP_COMMAND_H_
#define REVISIT_CLIENT_CLI_COMMANDS_HELP_COMMAND_H_

#include <functional>
#include <string>

#include "client/cli/flags.h"
#include "client/cli/usage/man_page.h"

namespace revisit::client {

// All commands of the program, once they have been added.
using UsageSource = std::function<CommandUsage()>;

// Adds `help`, which prints the help of a command.
void AddHelpCommand(const Command& program, const UsageSource& usage);

// Adds `completion`, which prints a script for a shell.
void AddCompletionCommand(const Command& program, const UsageSource& usage);

// Adds the hidden command by which the build writes the manual pages.
void AddManPagesCommand(const Command& program, const UsageSource& usage,
                        const ManPageFoot& foot);

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_CLI_COMMANDS_HELP_COMMAND_H_
