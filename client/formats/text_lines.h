// Shared by the readers of text files: lines with their numbers, fields,
// numbers in the C locale, and errors that say where.
#ifndef REVISIT_CLIENT_FORMATS_TEXT_LINES_H_
#define REVISIT_CLIENT_FORMATS_TEXT_LINES_H_

#include <cstddef>
#include <cstdint>
#include <memory>
#include <string>
#include <string_view>
#include <vector>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "client/formats/byte_source.h"

namespace revisit::client {

// The lines of a text, counted, without a byte order mark at its beginning and
// without their ends, LF or CR LF. Lines of more than a mebibyte are an error,
// and so is a text that ends in the middle of a number, as a copy that was cut
// does: its last line has no end, and its last number fewer decimals than that
// of any line before.
class Lines {
 public:
  // `path` is for messages.
  Lines(std::unique_ptr<ByteSource> source, std::string path);

  // Reads the next line, without its end, valid until the next call. False at
  // the end of the text or after an error; status() tells them apart.
  bool Next(std::string_view* line);

  // The first line that is neither blank nor begins with '#', without consuming
  // anything; empty if there is none within the first 64 KiB.
  // REQUIRES: nothing was consumed yet.
  std::string_view PeekFirstLine();

  // Bytes as they are, at least one, for parsers that know no lines; empty at
  // the end or after an error. Valid until the next call.
  std::string_view NextChunk();

  const absl::Status& status() const { return status_; }
  const std::string& path() const { return path_; }
  // The number of the line that was read last; 0 before the first.
  std::int64_t number() const { return number_; }

  // INVALID_ARGUMENT with path and the number of the last line read.
  absl::Status Error(const std::string& message) const;

 private:
  // Reads more behind what is there; false at the end or after an error.
  bool Fill();
  void SkipByteOrderMark();
  // Sets an error if a line that was read is cut.
  void LookForCut(std::string_view line, bool has_end);

  const std::unique_ptr<ByteSource> source_;
  const std::string path_;
  std::string buffer_;
  std::size_t begin_ = 0;
  std::int64_t number_ = 0;
  // Fewest decimals of a line's last number, and lines that were looked at.
  std::size_t least_decimals_ = 0;
  std::int64_t looked_at_ = 0;
  bool at_start_ = true;
  bool ended_ = false;
  absl::Status status_;
};

std::vector<std::string_view> SplitAt(char separator, std::string_view line);
// Splits at blanks and tabs, any number of them.
std::vector<std::string_view> SplitAtBlanks(std::string_view line);
std::string_view WithoutBlanks(std::string_view text);

// Quotes text of a file so that it fits into a message.
std::string Quoted(std::string_view text);

// Reads a finite number; `name` says in messages what it is.
absl::StatusOr<double> ReadNumber(std::string_view field, std::string_view name,
                                  const Lines& lines);

// Name of a file without directory and ending, also without that of a
// compressed file; "input" for "-".
std::string StemOf(const std::string& path);

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_FORMATS_TEXT_LINES_H_
