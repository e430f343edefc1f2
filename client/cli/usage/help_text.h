// The help of a command, for people.
#ifndef REVISIT_CLIENT_CLI_USAGE_HELP_TEXT_H_
#define REVISIT_CLIENT_CLI_USAGE_HELP_TEXT_H_

#include <cstddef>
#include <string>

#include "client/cli/usage/command_usage.h"

namespace revisit::client {

// How the command is typed, such as "revisit find [OPTIONS] VEHICLE".
std::string Synopsis(const CommandUsage& command);

// The flag with what stands for its value, such as "-h, --help" or "VEHICLE,
// --vehicle ID".
std::string FlagTitle(const FlagUsage& flag);

// The help of a flag with its default and its environment variable.
std::string FlagHelp(const FlagUsage& flag);

// Columns of a help on a terminal of this width, 0 if it is not for a terminal:
// lines that are much longer read badly.
std::size_t HelpWidth(std::size_t terminal_width);

// The whole help, at most `width` columns across; less than 40 counts as 40.
std::string HelpText(const CommandUsage& command, std::size_t width);

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_CLI_USAGE_HELP_TEXT_H_
