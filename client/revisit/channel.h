// Channels with the arguments that the client library wants.
#ifndef REVISIT_CLIENT_REVISIT_CHANNEL_H_
#define REVISIT_CLIENT_REVISIT_CHANNEL_H_

#include <memory>
#include <string>

namespace grpc {
class Channel;
}

namespace revisit::client {

// A plaintext channel to `address` (a gRPC target such as "127.0.0.1:50051").
// It connects on first use. It tries again soon after a connection failed, so
// that the library's own back-off decides, and takes answers of up to 64 MiB. A
// channel made elsewhere serves as well if it does the same.
std::shared_ptr<grpc::Channel> MakeInsecureChannel(const std::string& address);

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_REVISIT_CHANNEL_H_
