// Counts what connections bring before gRPC gets it.
//
// gRPC reads its sockets by recvmsg(), and what comes by TLS from OpenSSL by
// SSL_read(). This program defines functions of its own with these names, which
// the dynamic linker prefers to those of the libraries: they count, and answer
// end-of-stream for a connection that has passed a bound, or that nothing has
// come yet for one that has to wait. To ask the kernel from time to time
// instead (TCP_INFO) is no bound: on a loopback 200 MB came between two looks,
// and the asking thread waits for the socket's lock.
#ifndef REVISIT_SERVER_CONNECTIONS_METERED_READS_H_
#define REVISIT_SERVER_CONNECTIONS_METERED_READS_H_

#include "server/connections/connection_meter.h"

namespace revisit::server {

// How clients of a listener speak on their sockets.
enum class WireContent { kHttp2, kTls };

// From now on `meter` counts what is read from the socket behind `descriptor`,
// in place of an earlier meter. Null ends the counting. Thread-safe.
void MeterReads(int descriptor, MeterPointer meter, WireContent content);

// While one exists, its thread begins the TLS of no other connection than the
// one behind the descriptor: what is then read by it is counted with the meter
// of that connection.
class TlsBeginsHere {
 public:
  explicit TlsBeginsHere(int descriptor);
  ~TlsBeginsHere();

  TlsBeginsHere(const TlsBeginsHere&) = delete;
  TlsBeginsHere& operator=(const TlsBeginsHere&) = delete;
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_CONNECTIONS_METERED_READS_H_
