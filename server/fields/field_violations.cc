#include "server/fields/field_violations.h"

#include <cmath>
#include <cstdint>
#include <set>
#include <utility>

#include "absl/strings/ascii.h"
#include "absl/strings/escaping.h"
#include "absl/strings/str_cat.h"
#include "absl/strings/string_view.h"
#include "core/base/number_text.h"

namespace revisit::server {

using core::NumberText;

namespace {

// The code point at `*at` of valid UTF-8, and `*at` behind it.
std::uint32_t NextCodePoint(const std::string& text, std::size_t* at) {
  const auto head = static_cast<unsigned char>(text[(*at)++]);
  std::uint32_t code_point = head < 0x80   ? head
                             : head < 0xE0 ? head & 0x1Fu
                             : head < 0xF0 ? head & 0x0Fu
                                           : head & 0x07u;
  while (*at < text.size() &&
         (static_cast<unsigned char>(text[*at]) & 0xC0u) == 0x80u) {
    code_point =
        code_point << 6 | (static_cast<unsigned char>(text[(*at)++]) & 0x3Fu);
  }
  return code_point;
}

bool IsForbidden(std::uint32_t c, TextUse use) {
  if (c < 0x20 || (c >= 0x7F && c < 0xA0)) {
    return use == TextUse::kName || (c != '\n' && c != '\t');
  }
  if (use == TextUse::kNote) return false;
  // U+061C, U+200E, U+200F, U+202A to U+202E and U+2066 to U+2069 are Unicode's
  // Bidi_Control.
  return c == 0x061C || c == 0x200B || c == 0x200E || c == 0x200F ||
         (c >= 0x2028 && c <= 0x202E) || (c >= 0x2060 && c <= 0x206F) ||
         c == 0xFEFF;
}

}  // namespace

std::string FieldPath::ToString() const {
  if (name_ == nullptr) return "";
  std::string text = parent_ == nullptr ? "" : parent_->ToString();
  if (!text.empty()) text += ".";
  text += name_;
  if (index_ != kNoIndex) absl::StrAppend(&text, "[", index_, "]");
  return text;
}

void Violations::Add(const char* reason, const FieldPath& path,
                     const std::string& description) {
  if (violations_.empty()) reason_ = reason;
  violations_.push_back({path.ToString(), description});
}

void Violations::Rename(
    const std::function<std::string(const std::string&)>& name_of) {
  std::set<std::pair<std::string, std::string>> seen;
  std::vector<FieldViolation> renamed;
  for (FieldViolation& violation : violations_) {
    violation.field = name_of(violation.field);
    if (seen.emplace(violation.field, violation.description).second) {
      renamed.push_back(std::move(violation));
    }
  }
  violations_ = std::move(renamed);
}

absl::Status Violations::ToStatus() const {
  if (violations_.empty()) return absl::OkStatus();
  return InvalidFields(reason_, violations_);
}

bool CheckFinite(double value, const FieldPath& path, Violations* violations) {
  if (std::isfinite(value)) return true;
  violations->Add(
      kNotFinite, path,
      absl::StrCat("got ", NumberText(value), "; allowed are finite numbers"));
  return false;
}

bool CheckRange(double value, double lowest, double highest,
                const FieldPath& path, Violations* violations) {
  if (!CheckFinite(value, path, violations)) return false;
  if (value >= lowest && value <= highest) return true;
  violations->Add(
      kInvalidField, path,
      absl::StrCat("got ", NumberText(value), "; allowed is [",
                   NumberText(lowest), ", ", NumberText(highest), "]"));
  return false;
}

bool CheckText(const std::string& text, std::size_t most_bytes, TextUse use,
               const FieldPath& path, Violations* violations) {
  if (text.size() > most_bytes) {
    violations->Add(
        kInvalidField, path,
        absl::StrCat("got ", text.size(), " bytes; allowed are ", most_bytes));
    return false;
  }
  for (std::size_t i = 0; i < text.size();) {
    const std::size_t begin = i;
    const std::uint32_t code_point = NextCodePoint(text, &i);
    if (!IsForbidden(code_point, use)) continue;
    violations->Add(
        kInvalidField, path,
        absl::StrCat("got ", Quoted(text.substr(0, 64)),
                     text.size() > 64 ? " and more" : "", ", with U+",
                     absl::AsciiStrToUpper(
                         absl::StrCat(absl::Hex(code_point, absl::kZeroPad4))),
                     " at byte ", begin,
                     use == TextUse::kNote
                         ? "; of control characters, only line feeds and tabs "
                           "are allowed"
                         : "; characters that control, turn around or hide "
                           "text are not allowed"));
    return false;
  }
  return true;
}

std::string Quoted(const std::string& text) {
  return absl::StrCat(
      "\"", absl::CEscape(absl::string_view(text.data(), text.size())), "\"");
}

absl::Status InvalidField(const char* reason, const FieldPath& path,
                          const std::string& description) {
  return InvalidFields(reason, {{path.ToString(), description}});
}

}  // namespace revisit::server
