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
#include <vector>

#include "server/connections/connection_meter.h"

namespace revisit::server {

// Thread-compatible.
class ConnectionTable {
 public:
  struct Sockets {
    // Unique id (SO_COOKIE) of the socket behind a descriptor, or nullopt.
    std::function<std::optional<std::uint64_t>(int)> cookie;
    // Whether the other side has closed the connection.
    std::function<bool(int)> is_left;
  };

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
    // Processor time per second for all connections together that have not had
    // a call let in, beyond what each is granted from the beginning; 0 gives
    // any that is asked for.
    std::chrono::nanoseconds unadmitted_work{0};
  };

  // `meters` outlives this.
  ConnectionTable(const Bounds& bounds, Sockets sockets, Attach attach,
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

  struct Findings {
    // Each connection is among them once.
    std::vector<Harmful> harmful;
    // Descriptors of connections that wait and whose other side has gone.
    std::vector<int> left;
    // Descriptors of connections that waited and may go on.
    std::vector<int> resumed;
    // Connections still wait: the next look should come soon.
    bool is_urgent = false;
  };

  // Harmful are connections that passed a bound of their meter, or whose calls
  // have held all that a stranger's may for kFullTime. Among those that have
  // not had a call let in, also the oldest beyond max_unadmitted_connections,
  // and, while their calls together hold more than they may, those whose calls
  // hold the most. Processor time is granted to those first that have had the
  // least.
  Findings Look(std::chrono::steady_clock::time_point now);

  // Number of connections that were open when last looked at.
  std::size_t size() const { return connections_.size(); }

 private:
  struct Connection {
    std::string host;
    std::uint64_t cookie = 0;
    // Null, with all that follows, if it is not metered.
    MeterPointer meter;
    std::string remote;
    // Number of the connection, in the order in which they came.
    std::uint64_t number = 0;
    std::chrono::steady_clock::time_point begun;
    // Since when its calls hold all that they may.
    std::optional<std::chrono::steady_clock::time_point> full_since;
    // The bytes that had come when its calls were counted last, and since when
    // no others have.
    std::uint64_t counted_bytes = 0;
    std::chrono::steady_clock::time_point quiet_since;
    // Calls that were over when it was last forgiven.
    std::uint64_t forgiven_calls = 0;
    bool was_told = false;
  };
  // A connection that is closed, while gRPC still holds calls of it.
  struct Leaving {
    std::string remote;
    MeterPointer meter;
    std::chrono::steady_clock::time_point until;
  };
  struct Stranger {
    int descriptor;
    Connection* connection;
    ConnectionMeter::Standing standing;
  };

  void Remove(int descriptor, std::chrono::steady_clock::time_point now);
  void RemoveAll(const std::vector<int>& closed,
                 std::chrono::steady_clock::time_point now);
  // Has the meter learn what gRPC holds for the connection.
  void CountCalls(Connection* connection,
                  const ConnectionMeter::Standing& standing,
                  std::chrono::steady_clock::time_point now) const;
  const char* BoundPassed(Connection* connection,
                          const ConnectionMeter::Standing& standing,
                          std::chrono::steady_clock::time_point now) const;
  void CountLeaving(std::chrono::steady_clock::time_point now);
  // Adds the connection to the harmful.
  void Tell(int descriptor, Connection* connection, const char* bound,
            Findings* findings) const;
  void FindTooMuchMemory(std::vector<Stranger>* strangers,
                         std::chrono::steady_clock::time_point now,
                         Findings* findings) const;
  void FindTooManyConnections(std::vector<Stranger>* strangers,
                              Findings* findings) const;
  void GrantWork(std::vector<Stranger>* strangers,
                 std::chrono::steady_clock::time_point now);
  void ResumeWaiting(Findings* findings);
  bool IsOpen(int descriptor, const Connection& connection) const;
  void SweepAll(std::chrono::steady_clock::time_point now);
  void SweepHost(const std::string& host,
                 std::chrono::steady_clock::time_point now);
  std::size_t CountOf(const std::string& host) const;

  const Bounds bounds_;
  const Sockets sockets_;
  const Attach attach_;
  const Count count_;
  ConnectionMeters* const meters_;
  std::uint64_t last_number_ = 0;
  std::unordered_map<int, Connection> connections_;
  // Connections that were closed for a bound they passed, until Look() returns
  // them.
  std::vector<Harmful> untold_;
  std::vector<Leaving> leaving_;
  std::unordered_map<std::string, std::unordered_set<int>> by_host_;
  std::chrono::steady_clock::time_point last_sweep_{};
  std::chrono::steady_clock::time_point last_whole_look_{};
  // Processor time that may be granted, and when some was added last.
  ConnectionMeter::Work work_{0};
  std::chrono::steady_clock::time_point last_work_{};
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_CONNECTIONS_CONNECTION_TABLE_H_
