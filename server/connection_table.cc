#include "server/connection_table.h"

#include <utility>

namespace revisit::server {
namespace {

// A sweep asks the system about every connection: not for each one that is
// turned away in a flood.
constexpr std::chrono::milliseconds kSweepInterval{50};

// A call that is reset takes two frames: a head of 9 bytes and a byte of
// headers, and a head and 4 bytes (RFC 9113, 4.1 and 6.4). Half of it, so that
// those in a bound are counted twice before it can be passed again.
constexpr std::uint64_t kLeastCallBytes = 12;

}  // namespace

ConnectionTable::ConnectionTable(const Bounds& bounds, Cookie cookie,
                                 Received received, Held held,
                                 ConnectionProgress* progress)
    : max_connections_(static_cast<std::size_t>(bounds.max_connections)),
      max_connections_per_address_(
          static_cast<std::size_t>(bounds.max_connections_per_address)),
      max_idle_bytes_(static_cast<std::uint64_t>(bounds.max_idle_bytes)),
      max_held_calls_(static_cast<std::uint64_t>(bounds.max_held_calls)),
      cookie_(std::move(cookie)),
      received_(std::move(received)),
      held_(std::move(held)),
      progress_(progress) {}

ConnectionTable::~ConnectionTable() {
  for (const auto& [descriptor, connection] : connections_) {
    progress_->Close(connection.remote, connection.counter);
  }
}

const char* ConnectionTable::Add(int descriptor, const std::string& host,
                                 int port,
                                 std::chrono::steady_clock::time_point now) {
  Remove(descriptor);
  if (max_connections_ > 0 && connections_.size() >= max_connections_) {
    if (now - last_sweep_ >= kSweepInterval) {
      last_sweep_ = now;
      SweepAll();
    }
    if (connections_.size() >= max_connections_) return "max-connections";
  }
  if (max_connections_per_address_ > 0 &&
      CountOf(host) >= max_connections_per_address_) {
    SweepHost(host);
    if (CountOf(host) >= max_connections_per_address_) {
      return "max-connections-per-address";
    }
  }
  const std::optional<std::uint64_t> cookie = cookie_(descriptor);
  // Gone already.
  if (!cookie) return nullptr;
  Connection connection{host, *cookie, "", nullptr, 0, 0, 0};
  if (port != 0) {
    connection.remote = host + ":" + std::to_string(port);
    connection.counter = progress_->Open(connection.remote);
  }
  connections_.emplace(descriptor, std::move(connection));
  by_host_[host].insert(descriptor);
  return nullptr;
}

std::vector<ConnectionTable::Harmful> ConnectionTable::TakeHarmful() {
  std::vector<Harmful> harmful;
  for (auto& [descriptor, connection] : connections_) {
    if (connection.counter == nullptr || !IsOpen(descriptor, connection)) {
      continue;
    }
    if (const char* bound = BoundPassed(descriptor, &connection)) {
      harmful.push_back({descriptor, connection.host, bound});
    }
  }
  for (const Harmful& one : harmful) Remove(one.descriptor);
  return harmful;
}

const char* ConnectionTable::BoundPassed(int descriptor,
                                         Connection* connection) const {
  const std::optional<std::uint64_t> bytes = received_(descriptor);
  if (!bytes) return nullptr;
  if (max_held_calls_ > 0 &&
      *bytes - connection->counted_bytes >= max_held_calls_ * kLeastCallBytes) {
    connection->counted_bytes = *bytes;
    if (held_(connection->remote).value_or(0) > max_held_calls_) {
      return "max-concurrent-streams";
    }
  }
  const std::uint64_t progress =
      connection->counter->load(std::memory_order_relaxed);
  if (progress != connection->progress) {
    connection->progress = progress;
    connection->bytes = *bytes;
  } else if (max_idle_bytes_ > 0 &&
             *bytes > connection->bytes + max_idle_bytes_) {
    return "max-idle-bytes";
  }
  return nullptr;
}

void ConnectionTable::Remove(int descriptor) {
  const auto found = connections_.find(descriptor);
  if (found == connections_.end()) return;
  const auto host = by_host_.find(found->second.host);
  host->second.erase(descriptor);
  if (host->second.empty()) by_host_.erase(host);
  progress_->Close(found->second.remote, found->second.counter);
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

void ConnectionTable::SweepHost(const std::string& host) {
  std::vector<int> closed;
  for (const int descriptor : by_host_.at(host)) {
    if (!IsOpen(descriptor, connections_.at(descriptor))) {
      closed.push_back(descriptor);
    }
  }
  for (const int descriptor : closed) Remove(descriptor);
}

std::size_t ConnectionTable::CountOf(const std::string& host) const {
  const auto found = by_host_.find(host);
  return found == by_host_.end() ? 0 : found->second.size();
}

}  // namespace revisit::server
