#include "server/connections/connection_table.h"

#include <algorithm>
#include <cstddef>
#include <utility>

namespace revisit::server {
namespace {

// Least time between two sweeps. A sweep asks the system about every
// connection, so a flood must not cause one for each connection that is turned
// away.
constexpr std::chrono::milliseconds kSweepInterval{50};

// A call that is reset takes two frames on the wire: a head of 9 bytes and a
// byte of headers, then a head and 4 bytes (RFC 9113, 4.1 and 6.4), 23 bytes
// together. This is half of it, so that a connection is counted again by the
// time half of the calls that it may still begin can have come.
constexpr std::uint64_t kLeastCallBytes = 12;
// A connection that has not had a call let in is counted again once it has
// brought the bytes of this many calls.
constexpr std::uint64_t kFewCalls = 20;

bool Reaches(std::size_t count, std::int64_t most) {
  return most > 0 && count >= static_cast<std::size_t>(most);
}

}  // namespace

ConnectionTable::ConnectionTable(const Bounds& bounds, Cookie cookie,
                                 Attach attach, Count count,
                                 ConnectionMeters* meters)
    : bounds_(bounds),
      cookie_(std::move(cookie)),
      attach_(std::move(attach)),
      count_(std::move(count)),
      meters_(meters) {}

ConnectionTable::~ConnectionTable() {
  for (const auto& [descriptor, connection] : connections_) {
    attach_(descriptor, nullptr);
    meters_->Close(connection.remote, connection.meter);
  }
}

const char* ConnectionTable::Add(int descriptor, const std::string& host,
                                 int port,
                                 std::chrono::steady_clock::time_point now) {
  Remove(descriptor);
  // The next look cuts all beyond the bound; beyond twice the bound no more are
  // taken until then.
  const auto too_many_unadmitted = [this] {
    return Reaches(meters_->unadmitted().connections,
                   2 * std::int64_t{bounds_.max_unadmitted_connections});
  };
  if (Reaches(connections_.size(), bounds_.max_connections) ||
      too_many_unadmitted()) {
    if (now - last_sweep_ >= kSweepInterval) {
      last_sweep_ = now;
      SweepAll();
    }
    if (Reaches(connections_.size(), bounds_.max_connections)) {
      return "max-connections";
    }
    if (too_many_unadmitted()) return "max-unadmitted-connections";
  }
  if (Reaches(CountOf(host), bounds_.max_connections_per_address)) {
    SweepHost(host);
    if (Reaches(CountOf(host), bounds_.max_connections_per_address)) {
      return "max-connections-per-address";
    }
  }
  const std::optional<std::uint64_t> cookie = cookie_(descriptor);
  // The connection was closed in the meantime.
  if (!cookie) return nullptr;
  Connection connection{host, *cookie, nullptr, ""};
  connection.number = ++last_number_;
  if (port != 0) {
    connection.remote = host + ":" + std::to_string(port);
    connection.meter = meters_->Open(connection.remote);
    attach_(descriptor, connection.meter);
  }
  connections_.emplace(descriptor, std::move(connection));
  by_host_[host].insert(descriptor);
  return nullptr;
}

std::vector<ConnectionTable::Harmful> ConnectionTable::TakeHarmful() {
  std::vector<Harmful> harmful = std::exchange(untold_, {});
  std::vector<int> closed;
  std::vector<std::pair<int, Connection*>> unadmitted;
  for (auto& [descriptor, connection] : connections_) {
    if (connection.meter == nullptr) continue;
    const bool is_open = IsOpen(descriptor, connection);
    if (!is_open) closed.push_back(descriptor);
    if (connection.was_told) continue;
    if (is_open) Look(&connection);
    if (const char* bound = BoundPassed(connection)) {
      connection.was_told = true;
      harmful.push_back({is_open ? descriptor : -1, connection.host, bound});
    } else if (is_open && !connection.meter->admitted()) {
      unadmitted.emplace_back(descriptor, &connection);
    }
  }
  FindTooMany(std::move(unadmitted), &harmful);
  for (const int descriptor : closed) Remove(descriptor);
  return harmful;
}

void ConnectionTable::Look(Connection* connection) const {
  ConnectionMeter& meter = *connection->meter;
  const std::uint64_t bytes = meter.received();
  const auto calls = meter.admitted()
                         ? static_cast<std::uint64_t>(bounds_.max_held_calls)
                         : kFewCalls;
  const bool may_hold_more =
      bytes - connection->counted_bytes >= calls * kLeastCallBytes;
  // Once a call of the connection was let in, it matters only whether it holds
  // too many.
  const bool may_hold_less = !meter.admitted() && connection->held > 0;
  const bool may_be_forgiven = meter.IsHalfWay();
  if (!may_hold_more && !may_hold_less && !may_be_forgiven) return;
  connection->counted_bytes = bytes;
  const std::optional<CallCounts> counts = count_(connection->remote);
  connection->held = counts ? counts->held : 0;
  // gRPC holds nothing for a connection without calls, and headers that have
  // not ended count as a call. But answers that belong to no call (to pings and
  // settings) may wait to be read: so a call must also have come to its end.
  if (may_be_forgiven && counts && counts->held == 0 &&
      counts->over > connection->forgiven_calls) {
    connection->forgiven_calls = counts->over;
    meter.Forgive();
  }
}

const char* ConnectionTable::BoundPassed(const Connection& connection) const {
  if (const char* bound = connection.meter->BoundPassed()) return bound;
  return bounds_.max_held_calls > 0 &&
                 connection.held >
                     static_cast<std::uint64_t>(bounds_.max_held_calls)
             ? "max-concurrent-streams"
             : nullptr;
}

void ConnectionTable::FindTooMany(
    std::vector<std::pair<int, Connection*>> unadmitted,
    std::vector<Harmful>* harmful) const {
  const auto tell = [harmful](const std::pair<int, Connection*>& one,
                              const char* bound) {
    one.second->was_told = true;
    harmful->push_back({one.first, one.second->host, bound});
  };
  std::uint64_t calls = 0;
  for (const auto& one : unadmitted) calls += one.second->held;
  std::sort(unadmitted.begin(), unadmitted.end(),
            [](const auto& a, const auto& b) {
              return a.second->held > b.second->held;
            });
  const auto most_calls =
      static_cast<std::uint64_t>(bounds_.max_unadmitted_calls);
  std::size_t kept = 0;
  for (; most_calls > 0 && calls > most_calls; ++kept) {
    calls -= unadmitted[kept].second->held;
    tell(unadmitted[kept], "max-unadmitted-calls");
  }
  unadmitted.erase(unadmitted.begin(),
                   unadmitted.begin() + static_cast<std::ptrdiff_t>(kept));
  const auto most =
      static_cast<std::size_t>(bounds_.max_unadmitted_connections);
  if (most == 0 || unadmitted.size() <= most) return;
  std::sort(unadmitted.begin(), unadmitted.end(),
            [](const auto& a, const auto& b) {
              return a.second->number < b.second->number;
            });
  for (std::size_t i = 0; i + most < unadmitted.size(); ++i) {
    tell(unadmitted[i], "max-unadmitted-connections");
  }
}

void ConnectionTable::Remove(int descriptor) {
  const auto found = connections_.find(descriptor);
  if (found == connections_.end()) return;
  const Connection& connection = found->second;
  if (connection.meter != nullptr && !connection.was_told) {
    // The connection was closed for this bound; its descriptor may belong to
    // another connection already.
    if (const char* bound = BoundPassed(connection)) {
      untold_.push_back({-1, connection.host, bound});
    }
  }
  const auto host = by_host_.find(connection.host);
  host->second.erase(descriptor);
  if (host->second.empty()) by_host_.erase(host);
  attach_(descriptor, nullptr);
  meters_->Close(connection.remote, connection.meter);
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
