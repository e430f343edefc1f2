// Storage in a PostgreSQL database that several servers share.
//
// Each server owns some of the vehicles (ownership.h), and writes each over one
// of a few connections (postgres_writer.h), in single statements that write
// nothing once it is no longer the owner (postgres_appends.h,
// postgres_changes.h). Reads and claims use connections of their own
// (postgres_reader.h). `revisitd migrate` makes the tables (migrations.h).
//
// OK means that the database has acknowledged the commit: what that is worth
// is up to its settings, which GetDurability() reports. Where a commit waits
// for a standby that is gone, the write waits too, and so do the beats of all
// servers: nothing is acknowledged, and nothing answered from memory once the
// leases have run out. Nothing cancels that wait; if an operator does, the
// write counts as not written, for it may be gone after a failover.
#ifndef REVISIT_SERVER_STORAGE_POSTGRES_POSTGRES_STORAGE_H_
#define REVISIT_SERVER_STORAGE_POSTGRES_POSTGRES_STORAGE_H_

#include <chrono>
#include <cstddef>
#include <functional>
#include <memory>
#include <string>

#include "absl/status/statusor.h"
#include "server/storage/postgres/ownership.h"
#include "server/storage/storage.h"
#include "server/storage/write_queue.h"

namespace revisit::server {

// Most bytes of a payload whose row still fits a page of PostgreSQL with its
// other columns. Larger batches are stored too, out of line.
inline constexpr std::size_t kMostInlineBytes = 7900;

struct PostgresOptions : WriteGroupOptions {
  PostgresOptions() { max_joined_bytes = kMostInlineBytes; }

  OwnershipOptions ownership;
  // Connections that write. Range [1, 16].
  int writer_connections = 2;
  // Whether to refuse writes, and to open, where the database does not
  // replicate a commit before it acknowledges it.
  bool require_replicated = false;
  // How long closing waits for writes that the database has not answered.
  std::chrono::milliseconds settle_time{10'000};
};

// Opens the storage in the database of a URL or conninfo of libpq, and joins
// its servers. INVALID_ARGUMENT for a malformed conninfo, UNAVAILABLE if the
// database cannot be reached, FAILED_PRECONDITION if it has no tables or those
// of another version (migrations.h), or if `require_replicated` is not met.
absl::StatusOr<std::unique_ptr<Storage>> OpenPostgresStorage(
    const std::string& conninfo, const PostgresOptions& options);

}  // namespace revisit::server

#endif  // REVISIT_SERVER_STORAGE_POSTGRES_POSTGRES_STORAGE_H_
