// The file of settings: lines KEY = VALUE.
//
//   # A comment has a line of its own.
//   listen = "127.0.0.1:50051"
//   worker-threads = 4
#ifndef REVISIT_SERVER_SETTINGS_SETTINGS_FILE_H_
#define REVISIT_SERVER_SETTINGS_SETTINGS_FILE_H_

#include <functional>
#include <string>

#include "absl/status/status.h"

namespace revisit::server {

// Takes the value of one key. `where` is the place that messages name, such as
// revisitd.conf:3.
using TakeSetting =
    std::function<absl::Status(const std::string& key, const std::string& value,
                               const std::string& where)>;

// Calls `take` for each line, in order, until one is malformed, repeats a key,
// or is not taken. INVALID_ARGUMENT if a line is malformed or repeats a key, or
// the file cannot be read.
absl::Status ReadSettingsFile(const std::string& path, const TakeSetting& take);

// The text as a value of the file: in quotes, with escapes where needed.
std::string QuotedValue(const std::string& text);

}  // namespace revisit::server

#endif  // REVISIT_SERVER_SETTINGS_SETTINGS_FILE_H_
