// Connections for reads and claims, which are short and run on any thread.
#ifndef REVISIT_SERVER_STORAGE_POSTGRES_CONNECTION_POOL_H_
#define REVISIT_SERVER_STORAGE_POSTGRES_CONNECTION_POOL_H_

#include <chrono>
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

// Opens connections as they are needed, up to a number, and keeps some of them
// while nobody uses them. Thread-safe.
class ConnectionPool {
 public:
  struct Options {
    // Connections in all. A database has them for all servers together.
    std::size_t most = 16;
    std::size_t most_idle = 4;
    // How long a caller waits where all are used.
    std::chrono::milliseconds wait{10'000};
  };

  ConnectionPool(std::string conninfo, const Options& options)
      : conninfo_(std::move(conninfo)), options_(options) {}

  // Runs `work` on a connection of its own, and returns what it does.
  // UNAVAILABLE (STORE_UNAVAILABLE) where there is none for so long.
  absl::Status Use(
      const std::function<absl::Status(PostgresConnection&)>& work);
  // Runs `work` as Use() does, and returns its answer.
  template <typename T>
  absl::StatusOr<T> Answer(
      const std::function<absl::StatusOr<T>(PostgresConnection&)>& work) {
    absl::StatusOr<T> result = T();
    const absl::Status status = Use([&](PostgresConnection& connection) {
      result = work(connection);
      return result.status();
    });
    if (!status.ok()) return status;
    return result;
  }

 private:
  using ConnectionPtr = std::unique_ptr<PostgresConnection>;

  absl::StatusOr<ConnectionPtr> Take();
  // Waits for the right to use one; null where it is to be opened.
  absl::StatusOr<ConnectionPtr> AwaitTurn();
  // `connection` may be null.
  void GiveBack(ConnectionPtr connection);

  const std::string conninfo_;
  const Options options_;

  Mutex mutex_;
  CondVar is_free_;
  std::size_t used_ ABSL_GUARDED_BY(mutex_) = 0;
  std::vector<ConnectionPtr> idle_ ABSL_GUARDED_BY(mutex_);
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_STORAGE_POSTGRES_CONNECTION_POOL_H_
