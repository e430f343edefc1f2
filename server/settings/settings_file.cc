#include "server/settings/settings_file.h"

#include <fstream>
#include <optional>
#include <set>

#include "absl/status/statusor.h"
#include "absl/strings/str_cat.h"

namespace revisit::server {
namespace {

std::string Trimmed(const std::string& text) {
  const char* space = " \t\r";
  const std::size_t first = text.find_first_not_of(space);
  if (first == std::string::npos) return "";
  return text.substr(first, text.find_last_not_of(space) - first + 1);
}

// The text between quotes; nothing if it is not a well-formed string.
std::optional<std::string> Unquoted(const std::string& text) {
  if (text.size() < 2 || text.back() != '"') return std::nullopt;
  std::string plain;
  for (std::size_t i = 1; i + 1 < text.size(); ++i) {
    char c = text[i];
    if (c == '"') return std::nullopt;
    if (c == '\\') {
      if (++i + 1 >= text.size()) return std::nullopt;
      c = text[i];
      if (c == 'n') {
        c = '\n';
      } else if (c != '"' && c != '\\') {
        return std::nullopt;
      }
    }
    plain += c;
  }
  return plain;
}

struct Line {
  std::string key;
  std::string value;
};

// The key and the value of a line that is neither empty nor a comment.
absl::StatusOr<Line> ParseLine(const std::string& text,
                               const std::string& where) {
  const std::size_t equals = text.find('=');
  if (equals == std::string::npos) {
    return absl::InvalidArgumentError(
        absl::StrCat(where, ": expected KEY = VALUE"));
  }
  Line line{Trimmed(text.substr(0, equals)), Trimmed(text.substr(equals + 1))};
  if (line.value.empty()) return line;
  if (line.value[0] == '"') {
    const std::optional<std::string> plain = Unquoted(line.value);
    if (!plain) {
      return absl::InvalidArgumentError(
          absl::StrCat(where, ": ", line.key, ": malformed string"));
    }
    line.value = *plain;
  } else if (line.value.find('#') != std::string::npos) {
    return absl::InvalidArgumentError(absl::StrCat(
        where, ": ", line.key, ": got ", line.value,
        "; a comment has a line of its own, and a value with # stands in "
        "double quotes"));
  }
  return line;
}

absl::Status Unreadable(const std::string& path) {
  return absl::InvalidArgumentError(
      absl::StrCat("cannot read the file of settings ", path));
}

}  // namespace

absl::Status ReadSettingsFile(const std::string& path,
                              const TakeSetting& take) {
  std::ifstream file(path);
  if (!file) return Unreadable(path);
  std::set<std::string> seen;
  std::string text;
  for (int number = 1; std::getline(file, text); ++number) {
    text = Trimmed(text);
    if (text.empty() || text[0] == '#') continue;
    const std::string where = absl::StrCat(path, ":", number);
    const absl::StatusOr<Line> line = ParseLine(text, where);
    if (!line.ok()) return line.status();
    if (!seen.insert(line->key).second) {
      return absl::InvalidArgumentError(
          absl::StrCat(where, ": ", line->key, " stands twice"));
    }
    if (absl::Status status = take(line->key, line->value, where);
        !status.ok()) {
      return status;
    }
  }
  return file.bad() ? Unreadable(path) : absl::OkStatus();
}

std::string QuotedValue(const std::string& text) {
  std::string quoted = "\"";
  for (const char c : text) {
    if (c == '\n') {
      quoted += "\\n";
      continue;
    }
    if (c == '"' || c == '\\') quoted += '\\';
    quoted += c;
  }
  return quoted + "\"";
}

}  // namespace revisit::server
