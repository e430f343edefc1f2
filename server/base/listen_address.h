// HOST:PORT, where a server listens.
#ifndef REVISIT_SERVER_BASE_LISTEN_ADDRESS_H_
#define REVISIT_SERVER_BASE_LISTEN_ADDRESS_H_

#include <string>

#include "absl/status/statusor.h"

namespace revisit::server {

struct ListenAddress {
  // A name or an address, without the brackets of IPv6; never empty.
  std::string host;
  // A number from 0 to 65535.
  std::string port;
};

// INVALID_ARGUMENT for a text that has another form; whether there is such a
// host is not looked at.
absl::StatusOr<ListenAddress> ParseListenAddress(const std::string& text);

}  // namespace revisit::server

#endif  // REVISIT_SERVER_BASE_LISTEN_ADDRESS_H_
