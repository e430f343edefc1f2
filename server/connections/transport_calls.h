// The calls that gRPC keeps in memory for each connection, as its channelz
// counts them: those that are open, and those that were reset and are not yet
// cleared away.
//
// gRPC as Debian 12 has it (1.51) bounds the first (max_concurrent_streams),
// not the second: a client that begins calls and resets them at once, faster
// than they are cleared away, fills the memory (CVE-2023-44487).
#ifndef REVISIT_SERVER_CONNECTIONS_TRANSPORT_CALLS_H_
#define REVISIT_SERVER_CONNECTIONS_TRANSPORT_CALLS_H_

#include <cstddef>
#include <cstdint>
#include <optional>
#include <string>
#include <unordered_map>

#include "server/connections/connection_meter.h"

namespace revisit::server {

// Thread-compatible. Knows the connections of all gRPC servers in the process.
class TransportCalls {
 public:
  // The calls of the connection whose other end is `remote`, named as in
  // ConnectionMeters. Nullopt if gRPC does not know such a connection, or not
  // yet. Takes some 10 us, and as much again for each connection that came
  // since the last call.
  std::optional<CallCounts> Count(const std::string& remote);

 private:
  void LearnNew();
  void ForgetClosed();

  // The lowest number of a socket that may be new; numbers only grow.
  std::int64_t next_socket_ = 0;
  std::unordered_map<std::string, std::int64_t> sockets_;
  // Sockets that may be known before those that were closed are forgotten.
  std::size_t most_ = 1024;
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_CONNECTIONS_TRANSPORT_CALLS_H_
