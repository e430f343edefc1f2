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

// How often all connections are looked at: rarely enough that it takes next to
// no time however many there are. In between, only those that wait are.
constexpr std::chrono::milliseconds kLeastLookInterval{100};
constexpr std::chrono::microseconds kLookIntervalPerConnection{100};

// A stranger's connection whose calls have held all they may for so long, or
// that is so old when strangers' calls hold too much, is cut, however little it
// holds.
constexpr std::chrono::seconds kFullTime{5};
constexpr std::chrono::seconds kYoung{2};
// A younger one is then cut if its calls hold this much.
constexpr std::uint64_t kMuchMemory = std::uint64_t{1} << 20;
// gRPC has acted by then on all that a connection brought.
constexpr std::chrono::seconds kSettled{1};
// Calls of a connection that is closed are waited for so long.
constexpr std::chrono::seconds kLeavingTime{60};

// The least that is granted at a time, and the time whose share may be saved
// up.
constexpr std::chrono::microseconds kLeastGrant{500};
constexpr std::chrono::milliseconds kSavedTime{100};

// In place of a bound where the other side has gone.
constexpr char kLeft[] = "left";

bool Reaches(std::size_t count, std::int64_t most) {
  return most > 0 && count >= static_cast<std::size_t>(most);
}

}  // namespace

ConnectionTable::ConnectionTable(const Bounds& bounds, Sockets sockets,
                                 Attach attach, Count count,
                                 ConnectionMeters* meters)
    : bounds_(bounds),
      sockets_(std::move(sockets)),
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
  Remove(descriptor, now);
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
      SweepAll(now);
    }
    if (Reaches(connections_.size(), bounds_.max_connections)) {
      return "max-connections";
    }
    if (too_many_unadmitted()) return "max-unadmitted-connections";
  }
  if (Reaches(CountOf(host), bounds_.max_connections_per_address)) {
    SweepHost(host, now);
    if (Reaches(CountOf(host), bounds_.max_connections_per_address)) {
      return "max-connections-per-address";
    }
  }
  const std::optional<std::uint64_t> cookie = sockets_.cookie(descriptor);
  // The connection was closed in the meantime.
  if (!cookie) return nullptr;
  Connection connection;
  connection.host = host;
  connection.cookie = *cookie;
  connection.number = ++last_number_;
  connection.begun = connection.quiet_since = now;
  if (port != 0) {
    connection.remote = host + ":" + std::to_string(port);
    connection.meter = meters_->Open(connection.remote);
    attach_(descriptor, connection.meter);
  }
  connections_.emplace(descriptor, std::move(connection));
  by_host_[host].insert(descriptor);
  return nullptr;
}

ConnectionTable::Findings ConnectionTable::Look(
    std::chrono::steady_clock::time_point now) {
  Findings findings;
  const bool is_whole =
      now - last_whole_look_ >=
      std::max<std::chrono::microseconds>(
          kLeastLookInterval,
          kLookIntervalPerConnection * static_cast<std::int64_t>(size()));
  if (is_whole) last_whole_look_ = now;
  const bool is_crowded = meters_->unadmitted().memory >
                          meters_->bounds().max_unadmitted_memory / 2;
  std::vector<int> closed;
  std::vector<Stranger> strangers;
  for (auto& [descriptor, connection] : connections_) {
    if (connection.meter == nullptr) continue;
    if (is_whole && !IsOpen(descriptor, connection)) {
      closed.push_back(descriptor);
      continue;
    }
    ConnectionMeter::Standing standing = connection.meter->standing();
    if (is_whole || standing.is_waiting ||
        (is_crowded && !standing.is_admitted)) {
      CountCalls(&connection, standing, now);
      standing = connection.meter->standing();
    }
    if (connection.was_told) continue;
    if (const char* bound = BoundPassed(&connection, standing, now)) {
      Tell(descriptor, &connection, bound, &findings);
    } else if (!standing.is_admitted) {
      strangers.push_back({descriptor, &connection, standing});
    }
  }
  CountLeaving(now);
  FindTooMuchMemory(&strangers, now, &findings);
  FindTooManyConnections(&strangers, &findings);
  GrantWork(&strangers, now);
  ResumeWaiting(&findings);
  RemoveAll(closed, now);
  findings.harmful.insert(findings.harmful.end(), untold_.begin(),
                          untold_.end());
  untold_.clear();
  return findings;
}

void ConnectionTable::CountCalls(
    Connection* connection, const ConnectionMeter::Standing& standing,
    std::chrono::steady_clock::time_point now) const {
  if (standing.received != connection->counted_bytes) {
    connection->counted_bytes = standing.received;
    connection->quiet_since = now;
  }
  if (!standing.wants_counts && !standing.is_half_way) return;
  const std::optional<CallCounts> counts = count_(connection->remote);
  if (!counts) return;
  connection->meter->LearnCalls(*counts,
                                now - connection->quiet_since >= kSettled);
  // gRPC holds nothing for a connection without calls, and headers that have
  // not ended count as a call. But answers that belong to no call (to pings and
  // settings) may wait to be read: so a call must also have come to its end.
  if (standing.is_half_way && counts->held == 0 &&
      counts->over > connection->forgiven_calls) {
    connection->forgiven_calls = counts->over;
    connection->meter->Forgive();
  }
}

const char* ConnectionTable::BoundPassed(
    Connection* connection, const ConnectionMeter::Standing& standing,
    std::chrono::steady_clock::time_point now) const {
  if (standing.passed != nullptr) return standing.passed;
  if (!standing.is_full) {
    connection->full_since.reset();
    return nullptr;
  }
  if (!connection->full_since) connection->full_since = now;
  return now - *connection->full_since >= kFullTime ? "max-unadmitted-calls"
                                                    : nullptr;
}

void ConnectionTable::CountLeaving(std::chrono::steady_clock::time_point now) {
  const auto is_gone = [this, now](const Leaving& leaving) {
    if (now >= leaving.until) return true;
    const std::optional<CallCounts> counts = count_(leaving.remote);
    if (!counts) return true;
    leaving.meter->LearnCalls(*counts, /*is_settled=*/true);
    return counts->held == 0;
  };
  leaving_.erase(std::remove_if(leaving_.begin(), leaving_.end(), is_gone),
                 leaving_.end());
}

void ConnectionTable::Tell(int descriptor, Connection* connection,
                           const char* bound, Findings* findings) const {
  connection->was_told = true;
  connection->meter->Condemn(bound);
  findings->harmful.push_back(
      {IsOpen(descriptor, *connection) ? descriptor : -1, connection->host,
       bound});
}

void ConnectionTable::FindTooMuchMemory(
    std::vector<Stranger>* strangers, std::chrono::steady_clock::time_point now,
    Findings* findings) const {
  const std::uint64_t most = meters_->bounds().max_unadmitted_memory;
  if (most == 0 || meters_->unadmitted().memory <= most) return;
  std::sort(strangers->begin(), strangers->end(),
            [](const Stranger& a, const Stranger& b) {
              return a.standing.memory > b.standing.memory;
            });
  // The rest is that of connections which are cut already.
  std::uint64_t memory = 0;
  for (const Stranger& one : *strangers) memory += one.standing.memory;
  for (Stranger& one : *strangers) {
    if (memory <= most / 2 || one.standing.memory == 0) return;
    if (one.standing.memory < kMuchMemory &&
        now - one.connection->begun < kYoung) {
      continue;
    }
    memory -= one.standing.memory;
    Tell(one.descriptor, one.connection, "max-unadmitted-calls", findings);
  }
}

void ConnectionTable::FindTooManyConnections(std::vector<Stranger>* strangers,
                                             Findings* findings) const {
  strangers->erase(std::remove_if(strangers->begin(), strangers->end(),
                                  [](const Stranger& one) {
                                    return one.connection->was_told;
                                  }),
                   strangers->end());
  const auto most =
      static_cast<std::size_t>(bounds_.max_unadmitted_connections);
  if (most == 0 || strangers->size() <= most) return;
  std::sort(strangers->begin(), strangers->end(),
            [](const Stranger& a, const Stranger& b) {
              return a.connection->number < b.connection->number;
            });
  const auto young = strangers->end() - static_cast<std::ptrdiff_t>(most);
  for (auto one = strangers->begin(); one != young; ++one) {
    Tell(one->descriptor, one->connection, "max-unadmitted-connections",
         findings);
  }
  strangers->erase(strangers->begin(), young);
}

void ConnectionTable::GrantWork(std::vector<Stranger>* strangers,
                                std::chrono::steady_clock::time_point now) {
  const std::chrono::nanoseconds passed =
      std::min<std::chrono::nanoseconds>(now - last_work_, kSavedTime);
  last_work_ = now;
  const auto share_of = [this](std::chrono::nanoseconds time) {
    return std::chrono::duration_cast<ConnectionMeter::Work>(
        std::chrono::duration<double>(time) *
        std::chrono::duration<double>(bounds_.unadmitted_work).count());
  };
  work_ = std::min(work_ + share_of(passed), share_of(kSavedTime));
  strangers->erase(std::remove_if(strangers->begin(), strangers->end(),
                                  [](const Stranger& one) {
                                    return !one.standing.wants_work;
                                  }),
                   strangers->end());
  std::sort(strangers->begin(), strangers->end(),
            [](const Stranger& a, const Stranger& b) {
              return a.standing.work < b.standing.work;
            });
  auto left = static_cast<std::int64_t>(strangers->size());
  for (const Stranger& one : *strangers) {
    const bool is_free = bounds_.unadmitted_work.count() == 0;
    if (!is_free && work_.count() <= 0) return;
    const ConnectionMeter::Work grant =
        std::max<ConnectionMeter::Work>(work_ / left--, kLeastGrant);
    if (!is_free) work_ -= grant;
    one.connection->meter->Grant(grant);
  }
}

void ConnectionTable::ResumeWaiting(Findings* findings) {
  for (auto& [descriptor, connection] : connections_) {
    if (connection.meter == nullptr || connection.was_told) continue;
    if (connection.meter->Resume()) {
      findings->resumed.push_back(descriptor);
    } else if (connection.meter->standing().is_waiting) {
      if (IsOpen(descriptor, connection) && sockets_.is_left(descriptor)) {
        connection.was_told = true;
        connection.meter->Condemn(kLeft);
        findings->left.push_back(descriptor);
      } else {
        findings->is_urgent = true;
      }
    }
  }
}

void ConnectionTable::Remove(int descriptor,
                             std::chrono::steady_clock::time_point now) {
  const auto found = connections_.find(descriptor);
  if (found == connections_.end()) return;
  const Connection& connection = found->second;
  if (connection.meter != nullptr) {
    const ConnectionMeter::Standing standing = connection.meter->standing();
    // The connection was closed for this bound; its descriptor may belong to
    // another connection already.
    if (standing.passed != nullptr && !connection.was_told) {
      untold_.push_back({-1, connection.host, standing.passed});
    }
    if (!standing.is_admitted && standing.memory > 0) {
      leaving_.push_back(
          {connection.remote, connection.meter, now + kLeavingTime});
    }
  }
  const auto host = by_host_.find(connection.host);
  host->second.erase(descriptor);
  if (host->second.empty()) by_host_.erase(host);
  attach_(descriptor, nullptr);
  meters_->Close(connection.remote, connection.meter);
  connections_.erase(found);
}

void ConnectionTable::RemoveAll(const std::vector<int>& closed,
                                std::chrono::steady_clock::time_point now) {
  for (const int descriptor : closed) Remove(descriptor, now);
}

bool ConnectionTable::IsOpen(int descriptor,
                             const Connection& connection) const {
  return sockets_.cookie(descriptor) == connection.cookie;
}

void ConnectionTable::SweepAll(std::chrono::steady_clock::time_point now) {
  std::vector<int> closed;
  for (const auto& [descriptor, connection] : connections_) {
    if (!IsOpen(descriptor, connection)) closed.push_back(descriptor);
  }
  RemoveAll(closed, now);
}

void ConnectionTable::SweepHost(const std::string& host,
                                std::chrono::steady_clock::time_point now) {
  std::vector<int> closed;
  for (const int descriptor : by_host_.at(host)) {
    if (!IsOpen(descriptor, connections_.at(descriptor))) {
      closed.push_back(descriptor);
    }
  }
  RemoveAll(closed, now);
}

std::size_t ConnectionTable::CountOf(const std::string& host) const {
  const auto found = by_host_.find(host);
  return found == by_host_.end() ? 0 : found->second.size();
}

}  // namespace revisit::server
