// Counts what connections bring before gRPC gets it.
//
// gRPC reads its sockets by recvmsg(). The one of this program stands before
// the C library's, as the dynamic linker has it for any symbol that a program
// defines: it counts, and lets a connection that has passed a bound come to its
// end. To ask the kernel from time to time instead (TCP_INFO) is no bound: on a
// loopback 200 MB came between two looks, and whoever asks waits for the
// socket's lock.
#ifndef REVISIT_SERVER_CONNECTIONS_METERED_READS_H_
#define REVISIT_SERVER_CONNECTIONS_METERED_READS_H_

#include "server/connections/connection_meter.h"

namespace revisit::server {

// From now on `meter` counts what is read from the socket behind `descriptor`,
// in place of the one before. Null: nothing does. Thread-safe.
void MeterReads(int descriptor, MeterPointer meter);

}  // namespace revisit::server

#endif  // REVISIT_SERVER_CONNECTIONS_METERED_READS_H_
