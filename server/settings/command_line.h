// The command line of revisitd: flags, subcommands and help.
#ifndef REVISIT_SERVER_SETTINGS_COMMAND_LINE_H_
#define REVISIT_SERVER_SETTINGS_COMMAND_LINE_H_

#include <memory>
#include <optional>
#include <string>
#include <vector>

#include "absl/status/status.h"
#include "server/settings/option_table.h"
#include "server/settings/settings.h"

namespace revisit::server {

// One parser and the settings that it fills.
class CommandLine {
 public:
  // Begins with these settings.
  explicit CommandLine(const ServerSettings& settings = {});
  ~CommandLine();

  CommandLine(const CommandLine&) = delete;
  CommandLine& operator=(const CommandLine&) = delete;

  // INVALID_ARGUMENT for arguments that are malformed or out of range.
  absl::Status Parse(const std::vector<std::string>& arguments);

  // The table of settings, for values that come from elsewhere.
  OptionTable& table();

  const ServerSettings& settings() const { return settings_; }
  // The file that --config names; empty if none.
  const std::string& config() const { return config_; }
  // The text that is printed instead of serving: help or version.
  const std::optional<std::string>& print() const { return print_; }
  bool print_config() const { return print_config_; }
  // The task of the subcommand, if one was given.
  std::optional<StoreTask> Task() const;

 private:
  struct Parser;

  ServerSettings settings_;
  std::string config_;
  bool print_config_ = false;
  std::optional<std::string> print_;
  const std::unique_ptr<Parser> parser_;
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_SETTINGS_COMMAND_LINE_H_
