// The commands and their flags as plain data, of which the help, the manual
// pages and the completion of shells are made.
#ifndef REVISIT_CLIENT_CLI_USAGE_COMMAND_USAGE_H_
#define REVISIT_CLIENT_CLI_USAGE_COMMAND_USAGE_H_

#include <string>
#include <vector>

namespace revisit::client {

struct FlagUsage {
  // Its spellings on a command line, such as "-h" and "--help". Empty for a
  // flag that is only a word in its place.
  std::vector<std::string> names;
  // Stands for a word in its place, such as "FILE"; empty if there is no place
  // for it.
  std::string word;
  // Stands for the value, such as "ADDR" or "text|json"; empty for a switch.
  std::string value;
  // The words that it takes; empty if it takes others too.
  std::vector<std::string> choices;
  std::string help;
  // Empty if the help states it, or there is none.
  std::string default_value;
  // The environment variable that counts where the flag is not given; may be
  // empty.
  std::string environment;
  // The heading of the help below which it stands.
  std::string heading;
  bool required = false;
  // Whether it takes several values.
  bool repeated = false;
};

// The fields of CommandHelp (flags.h), and what hangs on them.
struct CommandUsage {
  // From the program on, such as "revisit vehicle create".
  std::string path;
  // The last word of the path.
  std::string name;
  std::string summary;
  std::string details;
  std::string examples;
  std::string notes;
  // Left out of lists of commands and of completion.
  bool hidden = false;
  // In the order of the help.
  std::vector<FlagUsage> flags;
  std::vector<CommandUsage> commands;

  // The command below this one that has this name; null if there is none.
  const CommandUsage* Find(const std::string& command) const {
    for (const CommandUsage& below : commands) {
      if (below.name == command) return &below;
    }
    return nullptr;
  }
};

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_CLI_USAGE_COMMAND_USAGE_H_
