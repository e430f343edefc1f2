// Which connections are open, and from where. gRPC closes them without a word,
// so the table finds out when it needs to know: a descriptor that was given
// anew was closed before, and whoever stands in the way of a new connection is
// asked whether it is still there.
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
#include <vector>

namespace revisit::server {

// Thread-compatible.
class ConnectionTable {
 public:
  // What tells the socket behind a descriptor from all others there ever were;
  // nothing if there is none.
  using Cookie = std::function<std::optional<std::uint64_t>(int)>;

  // The limits of Limits; 0 is off.
  ConnectionTable(int max_connections, int max_connections_per_address,
                  Cookie cookie);

  // Why this new connection is one too many; null if there is room, and then it
  // is in the table.
  const char* Add(int descriptor, const std::string& peer,
                  std::chrono::steady_clock::time_point now);

  // Those that were open when last looked at.
  std::size_t size() const { return connections_.size(); }

 private:
  struct Connection {
    std::string peer;
    std::uint64_t cookie;
  };

  void Remove(int descriptor);
  bool IsOpen(int descriptor, const Connection& connection) const;
  void SweepAll();
  void SweepPeer(const std::string& peer);
  std::size_t CountOf(const std::string& peer) const;

  const std::size_t max_connections_;
  const std::size_t max_connections_per_address_;
  const Cookie cookie_;
  std::unordered_map<int, Connection> connections_;
  std::unordered_map<std::string, std::unordered_set<int>> by_peer_;
  std::chrono::steady_clock::time_point last_sweep_{};
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_CONNECTION_TABLE_H_
