#include "server/base/listen_address.h"

#include <cstddef>

#include "absl/status/status.h"
#include "absl/strings/str_cat.h"

namespace revisit::server {
namespace {

absl::Status Refused(const std::string& text, const char* allowed) {
  return absl::InvalidArgumentError(
      absl::StrCat("got \"", text, "\"; allowed is ", allowed));
}

bool IsPort(const std::string& text) {
  return !text.empty() && text.size() <= 5 &&
         text.find_first_not_of("0123456789") == std::string::npos &&
         std::stoi(text) <= 65535;
}

}  // namespace

absl::StatusOr<ListenAddress> ParseListenAddress(const std::string& text) {
  const std::size_t colon = text.rfind(':');
  if (colon == std::string::npos) {
    return Refused(text,
                   "HOST:PORT, such as 127.0.0.1:50051, or [ADDRESS]:PORT for "
                   "IPv6, such as [::1]:50051");
  }
  ListenAddress address{text.substr(0, colon), text.substr(colon + 1)};
  std::string& host = address.host;
  if (host.size() > 1 && host.front() == '[' && host.back() == ']') {
    host = host.substr(1, host.size() - 2);
  } else if (host.find(':') != std::string::npos) {
    return Refused(text, "HOST:PORT, or [ADDRESS]:PORT for IPv6");
  }
  if (host.empty()) {
    return Refused(text,
                   "HOST:PORT; 0.0.0.0 stands for all addresses of IPv4, and "
                   "[::] for all of IPv6 and IPv4");
  }
  if (!IsPort(address.port)) {
    return Refused(text, "HOST:PORT with a port from 0 to 65535");
  }
  return address;
}

}  // namespace revisit::server
