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

std::string Quoted(const std::string& text) {
  return absl::StrCat(
      "\"", absl::CEscape(absl::string_view(text.data(), text.size())), "\"");
}

absl::Status InvalidField(const char* reason, const FieldPath& path,
                          const std::string& description) {
  return InvalidFields(reason, {{path.ToString(), description}});
}

}  // namespace revisit::server
