#include "client/formats/text_lines.h"

#include <algorithm>
#include <charconv>
#include <cmath>
#include <system_error>
#include <utility>

#include "absl/strings/str_cat.h"

namespace revisit::client {
namespace {

constexpr std::size_t kLongestLine = 1 << 20;
constexpr std::size_t kPeekedBytes = 1 << 16;
constexpr std::size_t kReadBytes = 1 << 16;
constexpr std::string_view kBlanks = " \t";
constexpr std::string_view kByteOrderMark = "\xef\xbb\xbf";
// Lines that have to agree on the decimals of their last numbers.
constexpr std::int64_t kLinesBeforeCut = 10;

bool IsDigit(char c) { return c >= '0' && c <= '9'; }

// Decimals of the number at the end of a line; 0 also without one.
std::size_t DecimalsAtEnd(std::string_view line) {
  std::size_t begin = line.size();
  while (begin > 0 && IsDigit(line[begin - 1])) --begin;
  return begin > 0 && line[begin - 1] == '.' ? line.size() - begin : 0;
}

std::string_view WithoutCarriageReturn(std::string_view line) {
  if (!line.empty() && line.back() == '\r') line.remove_suffix(1);
  return line;
}

}  // namespace

Lines::Lines(std::unique_ptr<ByteSource> source, std::string path)
    : source_(std::move(source)), path_(std::move(path)) {}

bool Lines::Fill() {
  if (ended_ || !status_.ok()) return false;
  buffer_.erase(0, begin_);
  begin_ = 0;
  const std::size_t size = buffer_.size();
  buffer_.resize(size + kReadBytes);
  const auto count = source_->Read(buffer_.data() + size, kReadBytes);
  buffer_.resize(size + (count.ok() ? *count : 0));
  if (!count.ok()) status_ = count.status();
  ended_ = count.ok() && *count == 0;
  return count.ok() && *count > 0;
}

void Lines::SkipByteOrderMark() {
  at_start_ = false;
  while (buffer_.size() < kByteOrderMark.size() &&
         buffer_ == kByteOrderMark.substr(0, buffer_.size()) && Fill()) {
  }
  if (std::string_view(buffer_).substr(0, kByteOrderMark.size()) ==
      kByteOrderMark) {
    begin_ = kByteOrderMark.size();
  }
}

bool Lines::Next(std::string_view* line) {
  if (at_start_) SkipByteOrderMark();
  std::size_t searched = begin_;
  for (;;) {
    const std::size_t end = buffer_.find('\n', searched);
    const bool last = end == std::string::npos;
    if (!last || (ended_ && begin_ < buffer_.size())) {
      *line = std::string_view(buffer_).substr(
          begin_, (last ? buffer_.size() : end) - begin_);
      begin_ = last ? buffer_.size() : end + 1;
      ++number_;
      *line = WithoutCarriageReturn(*line);
      LookForCut(*line, !last);
      return status_.ok();
    }
    const std::size_t length = buffer_.size() - begin_;
    if (length > kLongestLine) {
      ++number_;
      status_ = Error("the line is longer than a mebibyte");
    }
    if (!status_.ok() || ended_) return false;
    // Fill() moves what is there to the beginning.
    searched = length;
    if (!Fill() && !status_.ok()) return false;
  }
}

std::string_view Lines::PeekFirstLine() {
  if (at_start_) SkipByteOrderMark();
  for (std::size_t from = begin_;;) {
    const std::size_t end = buffer_.find('\n', from);
    if (end == std::string::npos && buffer_.size() < kPeekedBytes) {
      const std::size_t skipped = from - begin_;
      if (Fill()) {
        from = begin_ + skipped;
        continue;
      }
      from = begin_ + skipped;
      if (!status_.ok()) return {};
    }
    const std::string_view line =
        WithoutBlanks(WithoutCarriageReturn(std::string_view(buffer_).substr(
            from, end == std::string::npos ? end : end - from)));
    if (!line.empty() && line[0] != '#') return line;
    if (end == std::string::npos) return {};
    from = end + 1;
  }
}

void Lines::LookForCut(std::string_view line, bool has_end) {
  // A text that has begun without decimals may go on so.
  if (looked_at_ > 0 && least_decimals_ == 0) return;
  if (line.empty() ||
      !(IsDigit(line.back()) || line.back() == '.' || line.back() == '-')) {
    return;
  }
  const std::size_t decimals = DecimalsAtEnd(line);
  if (!has_end && looked_at_ >= kLinesBeforeCut && decimals < least_decimals_) {
    status_ = Error(absl::StrCat(
        "the text ends in the middle of a number: the lines before have at "
        "least ",
        least_decimals_, " decimals at their ends, and this one, ",
        Quoted(
            line.substr(line.size() - std::min<std::size_t>(line.size(), 16))),
        ", has no end; if it is whole, end the line"));
    return;
  }
  // Lines of names and of whole numbers, at the beginning, do not count.
  if (looked_at_ == 0 && decimals == 0) return;
  least_decimals_ =
      looked_at_ == 0 ? decimals : std::min(least_decimals_, decimals);
  ++looked_at_;
}

std::string_view Lines::NextChunk() {
  if (at_start_) SkipByteOrderMark();
  if (begin_ == buffer_.size() && !Fill()) return {};
  const std::string_view chunk = std::string_view(buffer_).substr(begin_);
  begin_ = buffer_.size();
  return chunk;
}

absl::Status Lines::Error(const std::string& message) const {
  return absl::InvalidArgumentError(
      absl::StrCat(path_, ":", number_, ": ", message));
}

std::vector<std::string_view> SplitAt(char separator, std::string_view line) {
  std::vector<std::string_view> fields;
  for (;;) {
    const std::size_t end = line.find(separator);
    fields.push_back(line.substr(0, end));
    if (end == std::string_view::npos) return fields;
    line.remove_prefix(end + 1);
  }
}

std::vector<std::string_view> SplitAtBlanks(std::string_view line) {
  std::vector<std::string_view> fields;
  for (;;) {
    const std::size_t begin = line.find_first_not_of(kBlanks);
    if (begin == std::string_view::npos) return fields;
    line.remove_prefix(begin);
    const std::size_t end = line.find_first_of(kBlanks);
    fields.push_back(line.substr(0, end));
    if (end == std::string_view::npos) return fields;
    line.remove_prefix(end);
  }
}

std::string_view WithoutBlanks(std::string_view text) {
  const std::size_t begin = text.find_first_not_of(kBlanks);
  if (begin == std::string_view::npos) return {};
  return text.substr(begin, text.find_last_not_of(kBlanks) - begin + 1);
}

std::string Quoted(std::string_view text) {
  constexpr std::size_t kLongest = 40;
  std::string quoted = "\"";
  for (const char c : text.substr(0, kLongest)) {
    quoted += c >= ' ' && c <= '~' ? c : '?';
  }
  return quoted + (text.size() > kLongest ? "...\"" : "\"");
}

absl::StatusOr<double> ReadNumber(std::string_view field, std::string_view name,
                                  const Lines& lines) {
  double value = 0.0;
  // A plus is a sign to people, but not to from_chars.
  const std::size_t skipped =
      field.size() > 1 && field[0] == '+' && field[1] != '-' ? 1 : 0;
  const auto [end, error] = std::from_chars(field.data() + skipped,
                                            field.data() + field.size(), value);
  if (error != std::errc() || end != field.data() + field.size() ||
      !std::isfinite(value)) {
    return lines.Error("expected a finite number for " + std::string(name) +
                       ", got " + Quoted(field));
  }
  return value;
}

std::string StemOf(const std::string& path) {
  if (path == "-") return "input";
  const std::size_t slash = path.rfind('/');
  std::string file = slash == std::string::npos ? path : path.substr(slash + 1);
  for (const std::string_view ending : {".gz", ".zst"}) {
    if (file.size() > ending.size() &&
        std::string_view(file).substr(file.size() - ending.size()) == ending) {
      file.resize(file.size() - ending.size());
    }
  }
  const std::size_t dot = file.rfind('.');
  return dot == std::string::npos || dot == 0 ? file : file.substr(0, dot);
}

}  // namespace revisit::client
