// Keeps which connections are open, from where, and what they bring. gRPC
// closes them without notice, so the table finds out when it needs to know: a
// descriptor that is given out anew was closed before, and before a new
// connection is refused, the table checks which of the old ones are still open.
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
  // Calls in memory, including those that were reset and not yet cleared away.
  std::uint64_t held = 0;
  // Calls that have ended and left the memory.
  std::uint64_t over = 0;
};

// Thread-compatible.
class ConnectionTable {
 public:
  // Unique id (SO_COOKIE) of the socket behind a descriptor, or nullopt.
  using Cookie = std::function<std::optional<std::uint64_t>(int)>;

  // Has a meter count the bytes that come on a descriptor; null detaches the
  // meter.
  using Attach = std::function<void(int, MeterPointer)>;

  // The calls of the connection with this remote end, or nullopt if they are
  // not known.
  using Count = std::function<std::optional<CallCounts>(const std::string&)>;

  struct Bounds {
    // The limits of the same names (limits.h); 0 switches one off.
    int max_connections = 0;
    int max_connections_per_address = 0;
    int max_unadmitted_connections = 0;
    // Calls that one connection may hold, including those that were reset; 0
    // switches it off.
    std::int64_t max_held_calls = 0;
    // Calls that all connections together may hold that have not had a call let
    // in; 0 switches it off.
    std::int64_t max_unadmitted_calls = 0;
  };

  // `meters` outlives this.
  ConnectionTable(const Bounds& bounds, Cookie cookie, Attach attach,
                  Count count, ConnectionMeters* meters);
  ~ConnectionTable();

  ConnectionTable(const ConnectionTable&) = delete;
  ConnectionTable& operator=(const ConnectionTable&) = delete;

  // Adds a new connection and returns null, or returns why it is one too many.
  // `host` and `port` are the other end's; with port 0 it is not metered.
  const char* Add(int descriptor, const std::string& host, int port,
                  std::chrono::steady_clock::time_point now);

  // A connection to be closed, and the bound that it has passed.
  struct Harmful {
    // Negative if the connection is closed already.
    int descriptor;
    std::string host;
    const char* bound;
  };

  // Returns connections that passed a bound of their meter or hold more than
  // max_held_calls. Among those that have not had a call let in, also the
  // oldest beyond max_unadmitted_connections, and, while together they hold
  // more than max_unadmitted_calls, those that hold the most. Each connection
  // is returned once.
  std::vector<Harmful> TakeHarmful();

  // Number of connections that were open when last looked at.
  std::size_t size() const { return connections_.size(); }

 private:
  struct Connection {
    std::string host;
    std::uint64_t cookie;
    // Null, with all that follows, if it is not metered.
    MeterPointer meter;
    std::string remote;
    // Number of the connection, in the order in which they came.
    std::uint64_t number = 0;
    // At the last count: the calls it held, and the bytes that had come.
    std::uint64_t held = 0;
    std::uint64_t counted_bytes = 0;
    // Calls that were over when it was last forgiven.
    std::uint64_t forgiven_calls = 0;
    bool was_told = false;
  };

  void Remove(int descriptor);
  void Look(Connection* connection) const;
  const char* BoundPassed(const Connection& connection) const;
  // Adds to `harmful` those of `unadmitted` that are beyond the bounds which
  // they share.
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
  // Connections that were closed for a bound they passed, until TakeHarmful()
  // returns them.
  std::vector<Harmful> untold_;
  std::unordered_map<std::string, std::unordered_set<int>> by_host_;
  std::chrono::steady_clock::time_point last_sweep_{};
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_CONNECTIONS_CONNECTION_TABLE_H_
