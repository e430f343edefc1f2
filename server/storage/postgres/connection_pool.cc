#include "server/storage/postgres/connection_pool.h"

#include "server/base/status.h"

namespace revisit::server {

absl::Status ConnectionPool::Use(
    const std::function<absl::Status(PostgresConnection&)>& work) {
  absl::StatusOr<ConnectionPtr> connection = Take();
  if (!connection.ok()) return connection.status();
  absl::Status status = work(**connection);
  GiveBack(*std::move(connection));
  return status;
}

absl::StatusOr<ConnectionPool::ConnectionPtr> ConnectionPool::Take() {
  absl::StatusOr<ConnectionPtr> connection = AwaitTurn();
  if (!connection.ok()) return connection;
  if (*connection != nullptr && (*connection)->IsAlive()) return connection;
  PostgresConnection::Options options;
  options.conninfo = conninfo_;
  connection = PostgresConnection::Open(options);
  if (!connection.ok()) GiveBack(nullptr);
  return connection;
}

absl::StatusOr<ConnectionPool::ConnectionPtr> ConnectionPool::AwaitTurn() {
  const auto latest = std::chrono::steady_clock::now() + options_.wait;
  const MutexLock lock(&mutex_);
  while (used_ >= options_.most) {
    if (is_free_.WaitUntil(&mutex_, latest) && used_ >= options_.most) {
      return Error(absl::StatusCode::kUnavailable, "STORE_UNAVAILABLE",
                   "all " + std::to_string(options_.most) +
                       " connections of this server that read from the "
                       "database have been in use for " +
                       std::to_string(options_.wait.count()) + " ms");
    }
  }
  ++used_;
  if (idle_.empty()) return ConnectionPtr();
  ConnectionPtr connection = std::move(idle_.back());
  idle_.pop_back();
  return connection;
}

void ConnectionPool::GiveBack(ConnectionPtr connection) {
  const bool is_alive = connection != nullptr && connection->IsAlive();
  const MutexLock lock(&mutex_);
  --used_;
  if (is_alive && idle_.size() < options_.most_idle) {
    idle_.push_back(std::move(connection));
  }
  is_free_.NotifyOne();
}

}  // namespace revisit::server
