// Connections for reads and claims, which are short and run on any thread.
#ifndef REVISIT_SERVER_STORAGE_POSTGRES_CONNECTION_POOL_H_
#define REVISIT_SERVER_STORAGE_POSTGRES_CONNECTION_POOL_H_

#include <cstddef>
#include <functional>
#include <memory>
#include <string>
#include <utility>
#include <vector>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "core/base/mutex.h"
#include "server/storage/postgres/connection.h"

namespace revisit::server {

// Opens as many connections as are used at a time, and keeps some of them while
// nobody uses them. Thread-safe.
class ConnectionPool {
 public:
  ConnectionPool(std::string conninfo, std::size_t max_idle)
      : conninfo_(std::move(conninfo)), max_idle_(max_idle) {}

  // Runs `work` on a connection of its own, and returns what it does.
  absl::Status Use(
      const std::function<absl::Status(PostgresConnection&)>& work);

 private:
  absl::StatusOr<std::unique_ptr<PostgresConnection>> Take();
  void GiveBack(std::unique_ptr<PostgresConnection> connection);

  const std::string conninfo_;
  const std::size_t max_idle_;

  Mutex mutex_;
  std::vector<std::unique_ptr<PostgresConnection>> idle_
      ABSL_GUARDED_BY(mutex_);
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_STORAGE_POSTGRES_CONNECTION_POOL_H_
