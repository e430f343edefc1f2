#include "server/conversion/field_violations.h"

#include "absl/strings/escaping.h"
#include "absl/strings/string_view.h"

namespace revisit::server {

std::string FieldPath::ToString() const {
  if (name_ == nullptr) return "";
  std::string text = parent_ == nullptr ? "" : parent_->ToString();
  if (!text.empty()) text += ".";
  text += name_;
  if (index_ != kNoIndex) text += "[" + std::to_string(index_) + "]";
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

std::string Quoted(const std::string& text) {
  return "\"" + absl::CEscape(absl::string_view(text.data(), text.size())) +
         "\"";
}

absl::Status InvalidField(const char* reason, const FieldPath& path,
                          const std::string& description) {
  return InvalidFields(reason, {{path.ToString(), description}});
}

}  // namespace revisit::server
