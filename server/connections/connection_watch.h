// Looks at the connections that are open, cuts those that are harmful, and lets
// those go on that have waited (ConnectionTable says which).
//
// It has a thread of its own, on which nothing of a connection is ever done:
// gRPC has whoever hands it a connection, or runs into one of its events, work
// for that connection for as long as it brings something, so that a flood keeps
// such a thread from whatever else it was to do. Of gRPC the thread asks only
// what its channelz counts, which takes a lock and does no connection's work.
#ifndef REVISIT_SERVER_CONNECTIONS_CONNECTION_WATCH_H_
#define REVISIT_SERVER_CONNECTIONS_CONNECTION_WATCH_H_

#include <chrono>
#include <string>
#include <thread>

#include "core/base/mutex.h"
#include "server/base/logging.h"
#include "server/connections/connection_meter.h"
#include "server/connections/connection_table.h"
#include "server/connections/metered_reads.h"
#include "server/connections/refusals.h"
#include "server/connections/transport_calls.h"

namespace revisit::server {

// Thread-safe.
class ConnectionWatch {
 public:
  // All must outlive this.
  ConnectionWatch(const ConnectionTable::Bounds& bounds, WireContent content,
                  const Log* log, ConnectionMeters* meters, Refusals* refusals);
  // Stops.
  ~ConnectionWatch();

  ConnectionWatch(const ConnectionWatch&) = delete;
  ConnectionWatch& operator=(const ConnectionWatch&) = delete;

  // accept4() with these flags. No connection is cut by a descriptor that is
  // given out anew meanwhile.
  int Accept(int listener, int flags);
  // As ConnectionTable::Add(), now.
  const char* Add(int descriptor, const std::string& host, int port);

  void Start();
  void Stop();

 private:
  void Run();
  // Whether the next look should come soon.
  bool Look();

  const Log* const log_;
  ConnectionMeters* const meters_;
  Refusals* const refusals_;
  Mutex mutex_;
  // Asked by the table, while mutex_ is held.
  TransportCalls transport_calls_;
  ConnectionTable table_ ABSL_GUARDED_BY(mutex_);
  // An eventfd that asks the thread to stop.
  const int end_;
  std::thread thread_;
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_CONNECTIONS_CONNECTION_WATCH_H_
