// Counts the bytes that connections bring before gRPC gets them.
//
// gRPC reads its sockets by recvmsg(). This program defines a recvmsg() of its
// own, which the dynamic linker prefers to the C library's: it counts, and
// answers end-of-stream for a connection that has passed a bound. To ask the
// kernel from time to time instead (TCP_INFO) is no bound: on a loopback 200 MB
// came between two looks, and the asking thread waits for the socket's lock.
#ifndef REVISIT_SERVER_CONNECTIONS_METERED_READS_H_
#define REVISIT_SERVER_CONNECTIONS_METERED_READS_H_

#include "server/connections/connection_meter.h"

namespace revisit::server {

// From now on `meter` counts the bytes read from the socket behind
// `descriptor`, in place of an earlier meter. Null ends the counting.
// Thread-safe.
void MeterReads(int descriptor, MeterPointer meter);

}  // namespace revisit::server

#endif  // REVISIT_SERVER_CONNECTIONS_METERED_READS_H_
