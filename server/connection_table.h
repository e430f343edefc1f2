// Which connections are open, from where, and what they bring. gRPC closes them
// without a word, so the table finds out when it needs to know: a descriptor
// that was given anew was closed before, and whoever stands in the way of a new
// connection is asked whether it is still there.
#ifndef REVISIT_SERVER_CONNECTION_TABLE_H_
#define REVISIT_SERVER_CONNECTION_TABLE_H_

#include <chrono>
#include <cstddef>
#include <cstdint>
#include <functional>
#include <optional>
#include <string>
#include <unordered_map>
#include <unordered_set>
#include <utility>
#include <vector>

#include "server/connection_progress.h"

namespace revisit::server {

// Thread-compatible.
class ConnectionTable {
 public:
  // What tells the socket behind a descriptor from all others there ever were;
  // nothing if there is none.
  using Cookie = std::function<std::optional<std::uint64_t>(int)>;

  // Bytes that have come on a connection; nothing if that cannot be told.
  using Received = std::function<std::optional<std::uint64_t>(int)>;

  // Calls held in memory for the connection whose other end this is; nothing
  // if that cannot be told.
  using Held = std::function<std::optional<std::uint64_t>(const std::string&)>;

  struct Bounds {
    // Those of Limits; 0 is off.
    int max_connections = 0;
    int max_connections_per_address = 0;
    std::int64_t max_idle_bytes = 0;
    // Of one connection, those that were reset included; 0 is off.
    std::int64_t max_held_calls = 0;
  };

  // `progress` outlives this.
  ConnectionTable(const Bounds& bounds, Cookie cookie, Received received,
                  Held held, ConnectionProgress* progress);
  ~ConnectionTable();

  ConnectionTable(const ConnectionTable&) = delete;
  ConnectionTable& operator=(const ConnectionTable&) = delete;

  // Why this new connection is one too many; null if there is room, and then it
  // is in the table. `host` and `port` are the other end's; a port of 0 says
  // that progress cannot be counted.
  const char* Add(int descriptor, const std::string& host, int port,
                  std::chrono::steady_clock::time_point now);

  // A connection that does more harm than good, and the bound it is beyond.
  struct Harmful {
    int descriptor;
    std::string host;
    const char* bound;
  };

  // Connections on which more than max_idle_bytes have come and no progress was
  // made, or that hold more than max_held_calls. They are no longer in the
  // table.
  std::vector<Harmful> TakeHarmful();

  // Those that were open when last looked at.
  std::size_t size() const { return connections_.size(); }

 private:
  struct Connection {
    std::string host;
    std::uint64_t cookie;
    std::string remote;
    ProgressCounter counter;
    // When last looked at, and the bytes that had come when progress was last
    // seen.
    std::uint64_t progress = 0;
    std::uint64_t bytes = 0;
    // Those that had come when the calls it holds were counted.
    std::uint64_t counted_bytes = 0;
  };

  void Remove(int descriptor);
  const char* BoundPassed(int descriptor, Connection* connection) const;
  bool IsOpen(int descriptor, const Connection& connection) const;
  void SweepAll();
  void SweepHost(const std::string& host);
  std::size_t CountOf(const std::string& host) const;

  const std::size_t max_connections_;
  const std::size_t max_connections_per_address_;
  const std::uint64_t max_idle_bytes_;
  const std::uint64_t max_held_calls_;
  const Cookie cookie_;
  const Received received_;
  const Held held_;
  ConnectionProgress* const progress_;
  std::unordered_map<int, Connection> connections_;
  std::unordered_map<std::string, std::unordered_set<int>> by_host_;
  std::chrono::steady_clock::time_point last_sweep_{};
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_CONNECTION_TABLE_H_
