#include "server/security/base64url.h"

#include "absl/strings/escaping.h"
#include "absl/strings/string_view.h"

namespace revisit::server {

std::optional<std::string> DecodeBase64Url(const std::string& text) {
  std::string bytes;
  if (!absl::WebSafeBase64Unescape(absl::string_view(text.data(), text.size()),
                                   &bytes)) {
    return std::nullopt;
  }
  std::string again;
  absl::WebSafeBase64Escape(absl::string_view(bytes.data(), bytes.size()),
                            &again);
  if (again != text) return std::nullopt;
  return bytes;
}

}  // namespace revisit::server
