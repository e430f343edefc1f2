// Shared by the readers of text files: lines with their numbers, fields,
// numbers in the C locale, and errors that say where.
#ifndef REVISIT_CLIENT_FORMATS_TEXT_LINES_H_
#define REVISIT_CLIENT_FORMATS_TEXT_LINES_H_

#include <istream>
#include <memory>
#include <string>
#include <string_view>
#include <vector>

#include "absl/status/status.h"
#include "absl/status/statusor.h"

namespace revisit::client {

// The lines of a stream, counted. `path` is for messages.
class Lines {
 public:
  Lines(std::istream& input, std::string path);

  // The next line, without its end; false at the end of the stream.
  bool Next(std::string* line);

  // INVALID_ARGUMENT with path and the number of the last line read.
  absl::Status Error(const std::string& message) const;

 private:
  std::istream& input_;
  const std::string path_;
  int number_ = 0;
};

std::vector<std::string_view> SplitAtCommas(std::string_view line);
// Splits at blanks and tabs, any number of them.
std::vector<std::string_view> SplitAtBlanks(std::string_view line);

// Quotes text of a file so that it fits into a message.
std::string Quoted(std::string_view text);

// Reads a finite number; `name` says in messages what it is.
absl::StatusOr<double> ReadNumber(std::string_view field,
                                  const std::string& name, const Lines& lines);

// An error if the first line of a file shows that it is compressed.
absl::Status RefuseCompressed(const std::string& first_line,
                              const Lines& lines);

// NOT_FOUND or PERMISSION_DENIED if a file cannot be opened, INVALID_ARGUMENT
// if it is no file.
absl::StatusOr<std::unique_ptr<std::istream>> OpenText(const std::string& path);

// Name of a file without directory and ending.
std::string StemOf(const std::string& path);

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_FORMATS_TEXT_LINES_H_
