#include "server/connection_table.h"

#include <utility>

namespace revisit::server {
namespace {

// A sweep asks the system about every connection: not for each one that is
// turned away in a flood.
constexpr std::chrono::milliseconds kSweepInterval{50};

}  // namespace

ConnectionTable::ConnectionTable(int max_connections,
                                 int max_connections_per_address, Cookie cookie)
    : max_connections_(static_cast<std::size_t>(max_connections)),
      max_connections_per_address_(
          static_cast<std::size_t>(max_connections_per_address)),
      cookie_(std::move(cookie)) {}

const char* ConnectionTable::Add(int descriptor, const std::string& peer,
                                 std::chrono::steady_clock::time_point now) {
  if (max_connections_ == 0 && max_connections_per_address_ == 0) {
    return nullptr;
  }
  Remove(descriptor);
  if (max_connections_ > 0 && connections_.size() >= max_connections_) {
    if (now - last_sweep_ >= kSweepInterval) {
      last_sweep_ = now;
      SweepAll();
    }
    if (connections_.size() >= max_connections_) return "max-connections";
  }
  if (max_connections_per_address_ > 0 &&
      CountOf(peer) >= max_connections_per_address_) {
    SweepPeer(peer);
    if (CountOf(peer) >= max_connections_per_address_) {
      return "max-connections-per-address";
    }
  }
  const std::optional<std::uint64_t> cookie = cookie_(descriptor);
  // Gone already.
  if (!cookie) return nullptr;
  connections_.emplace(descriptor, Connection{peer, *cookie});
  by_peer_[peer].insert(descriptor);
  return nullptr;
}

void ConnectionTable::Remove(int descriptor) {
  const auto found = connections_.find(descriptor);
  if (found == connections_.end()) return;
  const auto peer = by_peer_.find(found->second.peer);
  peer->second.erase(descriptor);
  if (peer->second.empty()) by_peer_.erase(peer);
  connections_.erase(found);
}

bool ConnectionTable::IsOpen(int descriptor,
                             const Connection& connection) const {
  return cookie_(descriptor) == connection.cookie;
}

void ConnectionTable::SweepAll() {
  std::vector<int> closed;
  for (const auto& [descriptor, connection] : connections_) {
    if (!IsOpen(descriptor, connection)) closed.push_back(descriptor);
  }
  for (const int descriptor : closed) Remove(descriptor);
}

void ConnectionTable::SweepPeer(const std::string& peer) {
  std::vector<int> closed;
  for (const int descriptor : by_peer_.at(peer)) {
    if (!IsOpen(descriptor, connections_.at(descriptor))) {
      closed.push_back(descriptor);
    }
  }
  for (const int descriptor : closed) Remove(descriptor);
}

std::size_t ConnectionTable::CountOf(const std::string& peer) const {
  const auto found = by_peer_.find(peer);
  return found == by_peer_.end() ? 0 : found->second.size();
}

}  // namespace revisit::server
