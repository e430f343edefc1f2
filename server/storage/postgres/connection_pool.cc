#include "server/storage/postgres/connection_pool.h"

namespace revisit::server {

absl::Status ConnectionPool::Use(
    const std::function<absl::Status(PostgresConnection&)>& work) {
  absl::StatusOr<std::unique_ptr<PostgresConnection>> connection = Take();
  if (!connection.ok()) return connection.status();
  absl::Status status = work(**connection);
  GiveBack(*std::move(connection));
  return status;
}

absl::StatusOr<std::unique_ptr<PostgresConnection>> ConnectionPool::Take() {
  while (true) {
    std::unique_ptr<PostgresConnection> connection;
    {
      const MutexLock lock(&mutex_);
      if (idle_.empty()) break;
      connection = std::move(idle_.back());
      idle_.pop_back();
    }
    if (connection->IsAlive()) return connection;
  }
  PostgresConnection::Options options;
  options.conninfo = conninfo_;
  return PostgresConnection::Open(options);
}

void ConnectionPool::GiveBack(std::unique_ptr<PostgresConnection> connection) {
  if (!connection->IsAlive()) return;
  const MutexLock lock(&mutex_);
  if (idle_.size() < max_idle_) idle_.push_back(std::move(connection));
}

}  // namespace revisit::server
