#include "server/connection_table.h"

#include <utility>

namespace revisit::server {
namespace {

// A sweep asks the system about every connection: not for each one that is
// turned away in a flood.
constexpr std::chrono::milliseconds kSweepInterval{50};

}  // namespace

ConnectionTable::ConnectionTable(int max_connections,
                                 int max_connections_per_address,
                                 std::int64_t max_idle_bytes, Cookie cookie,
                                 Received received,
                                 ConnectionProgress* progress)
    : max_connections_(static_cast<std::size_t>(max_connections)),
      max_connections_per_address_(
          static_cast<std::size_t>(max_connections_per_address)),
      max_idle_bytes_(static_cast<std::uint64_t>(max_idle_bytes)),
      cookie_(std::move(cookie)),
      received_(std::move(received)),
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
  Connection connection{host, *cookie, "", nullptr, 0, 0};
  if (max_idle_bytes_ > 0 && port != 0) {
    connection.remote = host + ":" + std::to_string(port);
    connection.counter = progress_->Open(connection.remote);
  }
  connections_.emplace(descriptor, std::move(connection));
  by_host_[host].insert(descriptor);
  return nullptr;
}

std::vector<std::pair<int, std::string>> ConnectionTable::TakeUseless() {
  std::vector<std::pair<int, std::string>> useless;
  for (auto& [descriptor, connection] : connections_) {
    if (connection.counter == nullptr || !IsOpen(descriptor, connection)) {
      continue;
    }
    const std::optional<std::uint64_t> bytes = received_(descriptor);
    if (!bytes) continue;
    const std::uint64_t progress =
        connection.counter->load(std::memory_order_relaxed);
    if (progress != connection.progress) {
      connection.progress = progress;
      connection.bytes = *bytes;
    } else if (*bytes > connection.bytes + max_idle_bytes_) {
      useless.emplace_back(descriptor, connection.host);
    }
  }
  for (const auto& [descriptor, host] : useless) Remove(descriptor);
  return useless;
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
