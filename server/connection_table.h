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

  // The limits of Limits; 0 is off. `progress` outlives this.
  ConnectionTable(int max_connections, int max_connections_per_address,
                  std::int64_t max_idle_bytes, Cookie cookie, Received received,
                  ConnectionProgress* progress);
  ~ConnectionTable();

  ConnectionTable(const ConnectionTable&) = delete;
  ConnectionTable& operator=(const ConnectionTable&) = delete;

  // Why this new connection is one too many; null if there is room, and then it
  // is in the table. `host` and `port` are the other end's; a port of 0 says
  // that progress cannot be counted.
  const char* Add(int descriptor, const std::string& host, int port,
                  std::chrono::steady_clock::time_point now);

  // Connections on which more than max_idle_bytes have come and no progress was
  // made: (descriptor, host). They are no longer in the table.
  std::vector<std::pair<int, std::string>> TakeUseless();

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
  };

  void Remove(int descriptor);
  bool IsOpen(int descriptor, const Connection& connection) const;
  void SweepAll();
  void SweepHost(const std::string& host);
  std::size_t CountOf(const std::string& host) const;

  const std::size_t max_connections_;
  const std::size_t max_connections_per_address_;
  const std::uint64_t max_idle_bytes_;
  const Cookie cookie_;
  const Received received_;
  ConnectionProgress* const progress_;
  std::unordered_map<int, Connection> connections_;
  std::unordered_map<std::string, std::unordered_set<int>> by_host_;
  std::chrono::steady_clock::time_point last_sweep_{};
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_CONNECTION_TABLE_H_
