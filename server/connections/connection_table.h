// Which connections are open, from where, and what they bring. gRPC closes them
// without a word, so the table finds out when it needs to know: a descriptor
// that was given anew was closed before, and whoever stands in the way of a new
// connection is asked whether it is still there.
#ifndef REVISIT_SERVER_CONNECTIONS_CONNECTION_TABLE_H_
#define REVISIT_SERVER_CONNECTIONS_CONNECTION_TABLE_H_

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

#include "server/connections/connection_meter.h"

namespace revisit::server {

// Calls of one connection.
struct CallCounts {
  // In memory, those that were reset and are not cleared away included.
  std::uint64_t held = 0;
  // No longer.
  std::uint64_t over = 0;
};

// Thread-compatible.
class ConnectionTable {
 public:
  // What tells the socket behind a descriptor from all others there ever were;
  // nothing if there is none.
  using Cookie = std::function<std::optional<std::uint64_t>(int)>;

  // Has what comes on a connection counted; null: no longer.
  using Attach = std::function<void(int, MeterPointer)>;

  // Of the connection whose other end this is; nothing if that cannot be told.
  using Count = std::function<std::optional<CallCounts>(const std::string&)>;

  struct Bounds {
    // Those of Limits; 0 is off.
    int max_connections = 0;
    int max_connections_per_address = 0;
    int max_unadmitted_connections = 0;
    // Of one connection, those that were reset included; 0 is off.
    std::int64_t max_held_calls = 0;
    // The same of all connections together that have not had a call let in.
    std::int64_t max_unadmitted_calls = 0;
  };

  // `meters` outlives this.
  ConnectionTable(const Bounds& bounds, Cookie cookie, Attach attach,
                  Count count, ConnectionMeters* meters);
  ~ConnectionTable();

  ConnectionTable(const ConnectionTable&) = delete;
  ConnectionTable& operator=(const ConnectionTable&) = delete;

  // Why this new connection is one too many; null if there is room, and then it
  // is in the table. `host` and `port` are the other end's; a port of 0 says
  // that it is not metered.
  const char* Add(int descriptor, const std::string& host, int port,
                  std::chrono::steady_clock::time_point now);

  // A connection that does more harm than good, and the bound it is beyond.
  struct Harmful {
    // Negative if it is closed already.
    int descriptor;
    std::string host;
    const char* bound;
  };

  // Connections that passed a bound of their meter or hold more than
  // max_held_calls; and of those that have not had a call let in the oldest, if
  // they are more than max_unadmitted_connections, and those that hold the most
  // calls, if they hold more than max_unadmitted_calls. Each is told once.
  std::vector<Harmful> TakeHarmful();

  // Those that were open when last looked at.
  std::size_t size() const { return connections_.size(); }

 private:
  struct Connection {
    std::string host;
    std::uint64_t cookie;
    // Null, with all that follows, if it is not metered.
    MeterPointer meter;
    std::string remote;
    // Goes up with each connection.
    std::uint64_t number = 0;
    // When last counted: the calls it holds, and the bytes that had come.
    std::uint64_t held = 0;
    std::uint64_t counted_bytes = 0;
    // Calls that were over when it was last forgiven.
    std::uint64_t forgiven_calls = 0;
    bool was_told = false;
  };

  void Remove(int descriptor);
  void Look(Connection* connection) const;
  const char* BoundPassed(const Connection& connection) const;
  // Adds to `harmful` those of `unadmitted` that are too much.
  void FindTooMany(std::vector<std::pair<int, Connection*>> unadmitted,
                   std::vector<Harmful>* harmful) const;
  bool IsOpen(int descriptor, const Connection& connection) const;
  void SweepAll();
  void SweepHost(const std::string& host);
  std::size_t CountOf(const std::string& host) const;

  const Bounds bounds_;
  const Cookie cookie_;
  const Attach attach_;
  const Count count_;
  ConnectionMeters* const meters_;
  std::uint64_t last_number_ = 0;
  std::unordered_map<int, Connection> connections_;
  // Those that were closed for a bound they passed, until TakeHarmful().
  std::vector<Harmful> untold_;
  std::unordered_map<std::string, std::unordered_set<int>> by_host_;
  std::chrono::steady_clock::time_point last_sweep_{};
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_CONNECTIONS_CONNECTION_TABLE_H_
