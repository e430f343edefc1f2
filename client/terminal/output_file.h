// Results that go to a file or to the terminal.
#ifndef REVISIT_CLIENT_TERMINAL_OUTPUT_FILE_H_
#define REVISIT_CLIENT_TERMINAL_OUTPUT_FILE_H_

#include <fstream>
#include <functional>
#include <ostream>
#include <string>

#include "absl/status/status.h"

namespace revisit::client {

// A file that gets its name when it is whole: a file of this name stays as it
// is until then. A pipe or a device is written to as the parts come.
class OutputFile {
 public:
  explicit OutputFile(std::string path);
  // Removes what was not finished.
  ~OutputFile();

  OutputFile(const OutputFile&) = delete;
  OutputFile& operator=(const OutputFile&) = delete;

  std::ostream& stream() { return stream_; }

  absl::Status Open();
  absl::Status Finish();

 private:
  std::string path_;
  // The unfinished file, to be removed; empty if there is none.
  std::string aside_;
  std::ofstream stream_;
};

// Lets `write` fill the file of this path, or the terminal if the path is
// empty. A file gets its name only if `write` answers OK.
absl::Status WriteTo(const std::string& path, std::ostream& terminal,
                     const std::function<absl::Status(std::ostream&)>& write);

// An error if the output has failed, with the reason, such as a full disk.
absl::Status CheckOutput(std::ostream& out);

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_TERMINAL_OUTPUT_FILE_H_
