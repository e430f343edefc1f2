#include "server/conversion/field_violations.h"

#include <cmath>

#include "absl/strings/escaping.h"
#include "absl/strings/str_cat.h"
#include "absl/strings/string_view.h"
#include "core/base/number_text.h"

namespace revisit::server {

using core::NumberText;

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

bool CheckText(const std::string& text, std::size_t most_bytes, TextLines lines,
               const FieldPath& path, Violations* violations) {
  if (text.size() > most_bytes) {
    violations->Add(
        kInvalidField, path,
        absl::StrCat("got ", text.size(), " bytes; allowed are ", most_bytes));
    return false;
  }
  for (std::size_t i = 0; i < text.size(); ++i) {
    const auto byte = static_cast<unsigned char>(text[i]);
    const bool is_break = byte == '\n' || byte == '\t';
    // U+0080 to U+009F are control characters too.
    const bool is_control = byte < 0x20 || byte == 0x7f ||
                            (byte == 0xc2 && i + 1 < text.size() &&
                             static_cast<unsigned char>(text[i + 1]) < 0xa0);
    if (!is_control || (is_break && lines == TextLines::kMany)) continue;
    violations->Add(
        kInvalidField, path,
        absl::StrCat("got ", Quoted(text.substr(0, 64)),
                     text.size() > 64 ? " and more" : "",
                     ", with a control character at byte ", i,
                     lines == TextLines::kMany
                         ? "; of these, only line feeds and tabs are allowed"
                         : "; none is allowed"));
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
