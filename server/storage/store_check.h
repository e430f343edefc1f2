// Reads a whole store and says what is wrong with it.
#ifndef REVISIT_SERVER_STORAGE_STORE_CHECK_H_
#define REVISIT_SERVER_STORAGE_STORE_CHECK_H_

#include <cstdint>
#include <set>
#include <string>
#include <vector>

#include "absl/status/statusor.h"
#include "server/storage/sqlite_database.h"

namespace revisit::server {

struct StoreReport {
  std::int64_t vehicles = 0;
  std::int64_t batches = 0;
  std::int64_t poses = 0;
  std::int64_t revised_batches = 0;
  std::int64_t loop_closures = 0;
  std::int64_t rejected_candidates = 0;
  // Each for people, in one line.
  std::vector<std::string> problems;
  // Ids of those that cannot be read whole.
  std::set<std::string> damaged_vehicles;
};

// Whether every page, table and index is what the others say: empty, or up to
// ten problems. Rows' own checksums are not looked at. DATA_LOSS where the
// damage does not even let it go on.
absl::StatusOr<std::vector<std::string>> FindStructuralDamage(
    SqliteDatabase& database);

// Reads every row of every vehicle: checksums, sequences without a gap, nothing
// that belongs to nobody. As of one moment a vehicle; a server may be at work.
// Fails only where the store cannot be opened at all: as
// OpenSqliteStorageToRead() does.
absl::StatusOr<StoreReport> CheckStore(const std::string& path);

// Whether the write-ahead log of a store that no server has open holds what was
// flushed: empty, or what is wrong with it.
absl::StatusOr<std::string> FindLogDamage(const std::string& path);

// "a, b and 3 more".
std::string Listed(const std::set<std::string>& names);

}  // namespace revisit::server

#endif  // REVISIT_SERVER_STORAGE_STORE_CHECK_H_
