// The settings as options of a command line: one line each in the .cc, with
// key, range and help.
#ifndef REVISIT_SERVER_SETTINGS_OPTION_TABLE_H_
#define REVISIT_SERVER_SETTINGS_OPTION_TABLE_H_

#include <cstddef>
#include <functional>
#include <string>
#include <vector>

#include "absl/status/status.h"
#include "server/settings/settings.h"

namespace CLI {
class App;
class Option;
}  // namespace CLI

namespace revisit::server {

// Columns of the help before the descriptions.
inline constexpr std::size_t kNameColumns = 34;

// The description with line breaks, so that the help fits 80 columns.
std::string Wrapped(const std::string& description);

class OptionTable {
 public:
  struct Entry {
    std::string key;
    CLI::Option* option;
    // The present value in the form of the file.
    std::function<std::string()> value_text;
  };

  // Adds an option to the app for each setting; parsing assigns the settings.
  // Both must outlive this.
  OptionTable(CLI::App* app, ServerSettings* settings);

  // Sets a setting to a value from the environment or the file.
  // INVALID_ARGUMENT if there is no such setting or the value is malformed or
  // out of range; the message begins with `where`.
  absl::Status Set(const std::string& key, const std::string& value,
                   const std::string& where);

  // All settings in the form of the file.
  std::string Print() const;

 private:
  std::vector<Entry> entries_;
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_SETTINGS_OPTION_TABLE_H_
