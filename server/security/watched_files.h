// Files that may change while the server runs.
#ifndef REVISIT_SERVER_SECURITY_WATCHED_FILES_H_
#define REVISIT_SERVER_SECURITY_WATCHED_FILES_H_

#include <string>
#include <vector>

#include "absl/status/statusor.h"

namespace revisit::server {

// Not thread-safe.
class WatchedFiles {
 public:
  explicit WatchedFiles(std::vector<std::string> paths);

  // Reads all files. True if anything is different from the time before: what
  // they hold, or that one cannot be read. Compares contents, since times of
  // files are coarse and do not change by what a link points to.
  bool Look();

  // Of the last look, in the order of the paths; INVALID_ARGUMENT if a file
  // cannot be read or is larger than 1 MiB.
  const absl::StatusOr<std::vector<std::string>>& contents() const {
    return contents_;
  }

 private:
  const std::vector<std::string> paths_;
  absl::StatusOr<std::vector<std::string>> contents_;
  bool looked_ = false;
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_SECURITY_WATCHED_FILES_H_
