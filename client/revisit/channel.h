// Channels with the arguments that the client library wants.
#ifndef REVISIT_CLIENT_REVISIT_CHANNEL_H_
#define REVISIT_CLIENT_REVISIT_CHANNEL_H_

#include <memory>
#include <string>

#include "absl/status/statusor.h"

namespace grpc {
class Channel;
}

namespace revisit::client {

struct ChannelOptions {
  // A gRPC target such as "127.0.0.1:50051".
  std::string address;
  // File (PEM) of the authorities that may have issued the server's
  // certificate. If empty, the channel is in plaintext.
  std::string tls_authorities_file;
  // Files (PEM) of the client's own certificate, with those that issued it, and
  // its key. If empty, none is shown. They are read once, when the channel is
  // made.
  std::string tls_certificate_file;
  std::string tls_key_file;
  // File with a bearer token; white space around it is ignored. It is read
  // again for each call and each connection of a stream, so a renewed token
  // takes effect once it replaces the file. If empty, no token is sent.
  std::string token_file;
};

// Makes a channel, which connects on first use. It tries again soon after a
// connection failed, so that the library's own back-off decides, breaks a
// connection that takes no bytes for 15 s, and takes answers of up to 64 MiB. A
// channel made elsewhere serves as well if it does the same.
//
// In plaintext a token is sent to this machine only: calls to other addresses
// fail. INVALID_ARGUMENT if a file cannot be read or holds something else, or
// certificate and key do not belong together or do not come together and with
// authorities.
absl::StatusOr<std::shared_ptr<grpc::Channel>> MakeChannel(
    const ChannelOptions& options);

// Makes a channel in plaintext, without a token.
std::shared_ptr<grpc::Channel> MakeInsecureChannel(const std::string& address);

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_REVISIT_CHANNEL_H_
