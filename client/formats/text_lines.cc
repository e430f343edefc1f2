#include "client/formats/text_lines.h"

#include <cerrno>
#include <charconv>
#include <cmath>
#include <cstring>
#include <fstream>
#include <system_error>
#include <utility>

#include "absl/strings/str_cat.h"

namespace revisit::client {

Lines::Lines(std::istream& input, std::string path)
    : input_(input), path_(std::move(path)) {}

bool Lines::Next(std::string* line) {
  if (!std::getline(input_, *line)) return false;
  ++number_;
  if (!line->empty() && line->back() == '\r') line->pop_back();
  return true;
}

absl::Status Lines::Error(const std::string& message) const {
  return absl::InvalidArgumentError(
      absl::StrCat(path_, ":", number_, ": ", message));
}

std::vector<std::string_view> SplitAtCommas(std::string_view line) {
  std::vector<std::string_view> fields;
  for (;;) {
    const std::size_t comma = line.find(',');
    fields.push_back(line.substr(0, comma));
    if (comma == std::string_view::npos) return fields;
    line.remove_prefix(comma + 1);
  }
}

std::vector<std::string_view> SplitAtBlanks(std::string_view line) {
  constexpr std::string_view kBlanks = " \t";
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

std::string Quoted(std::string_view text) {
  constexpr std::size_t kLongest = 40;
  std::string quoted = "\"";
  for (const char c : text.substr(0, kLongest)) {
    quoted += c >= ' ' && c <= '~' ? c : '?';
  }
  return quoted + (text.size() > kLongest ? "...\"" : "\"");
}

absl::StatusOr<double> ReadNumber(std::string_view field,
                                  const std::string& name, const Lines& lines) {
  double value = 0.0;
  const auto [end, error] =
      std::from_chars(field.data(), field.data() + field.size(), value);
  if (error != std::errc() || end != field.data() + field.size() ||
      !std::isfinite(value)) {
    return lines.Error("expected a finite number for " + name + ", got " +
                       Quoted(field));
  }
  return value;
}

absl::Status RefuseCompressed(const std::string& first_line,
                              const Lines& lines) {
  if (first_line.size() >= 2 && first_line[0] == '\x1f' &&
      first_line[1] == '\x8b') {
    return lines.Error(
        "the file is compressed; expected plain text (gunzip it)");
  }
  return absl::OkStatus();
}

absl::StatusOr<std::unique_ptr<std::istream>> OpenText(
    const std::string& path) {
  errno = 0;
  auto input = std::make_unique<std::ifstream>(path, std::ios::binary);
  if (!*input) {
    const int error = errno;
    const std::string message = path + ": " + std::strerror(error);
    if (error == EACCES) return absl::PermissionDeniedError(message);
    return absl::NotFoundError(message);
  }
  if (input->peek(); input->bad()) {
    return absl::InvalidArgumentError(path + ": cannot be read as a file");
  }
  return std::unique_ptr<std::istream>(std::move(input));
}

std::string StemOf(const std::string& path) {
  const std::size_t slash = path.rfind('/');
  const std::string file =
      slash == std::string::npos ? path : path.substr(slash + 1);
  const std::size_t dot = file.rfind('.');
  return dot == std::string::npos || dot == 0 ? file : file.substr(0, dot);
}

}  // namespace revisit::client
