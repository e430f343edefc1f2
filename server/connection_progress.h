// Which connections bring something that is of use: a call, or a message of
// one.
//
// gRPC as Debian 12 has it (1.51) stores the headers of a call as they come
// until they end, and holds a client to a limit only once that client has
// agreed to it: one connection whose headers never end fills the memory.
// Between its first and its last header frame nothing else may come on a
// connection, so that a long time without progress tells it from those that
// work.
#ifndef REVISIT_SERVER_CONNECTION_PROGRESS_H_
#define REVISIT_SERVER_CONNECTION_PROGRESS_H_

#include <atomic>
#include <cstdint>
#include <memory>
#include <string>
#include <unordered_map>

#include "server/mutex.h"

namespace revisit::server {

// Counts calls and messages. Null stands for a connection that nobody counts.
using ProgressCounter = std::shared_ptr<std::atomic<std::uint64_t>>;

// Thread-safe.
class ConnectionProgress {
 public:
  // `remote` is the other end, host and port: "127.0.0.1:4711", "::1:4711". A
  // connection takes the place of the one there was from there.
  ProgressCounter Open(const std::string& remote);
  // Of a connection that is gone; not of one that has taken its place.
  void Close(const std::string& remote, const ProgressCounter& counter);
  // `peer` as gRPC tells it: "ipv4:127.0.0.1:4711", "ipv6:%5B::1%5D:4711".
  ProgressCounter Find(const std::string& peer) const;

  // The remote end that gRPC means.
  static std::string RemoteOf(const std::string& peer);

 private:
  mutable Mutex mutex_;
  std::unordered_map<std::string, ProgressCounter> counters_
      ABSL_GUARDED_BY(mutex_);
};

inline void CountProgress(const ProgressCounter& counter) {
  if (counter != nullptr) counter->fetch_add(1, std::memory_order_relaxed);
}

}  // namespace revisit::server

#endif  // REVISIT_SERVER_CONNECTION_PROGRESS_H_
