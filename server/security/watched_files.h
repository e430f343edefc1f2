// Reads files that may change while the server runs.
#ifndef REVISIT_SERVER_SECURITY_WATCHED_FILES_H_
#define REVISIT_SERVER_SECURITY_WATCHED_FILES_H_

#include <chrono>
#include <string>
#include <vector>

#include "absl/status/statusor.h"

namespace revisit::server {

class Metrics;

// Files whose contents are taken up as they change.
struct FilesState {
  // When the contents in use were taken up.
  std::chrono::system_clock::time_point loaded;
  // Whether there are others since then, which were refused.
  bool refused = false;
};

// `files`: which files these are, in one word.
void CollectFilesMetrics(const char* files, const FilesState& state,
                         Metrics* metrics);

// Not thread-safe.
class WatchedFiles {
 public:
  explicit WatchedFiles(std::vector<std::string> paths);

  // Reads all files. True if anything differs from the last look: contents, or
  // whether a file can be read. It compares contents, because times of files
  // are coarse and do not change when a link is pointed elsewhere.
  bool Look();

  // Contents at the last look, in the order of the paths; INVALID_ARGUMENT if a
  // file could not be read or was larger than 1 MiB.
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
