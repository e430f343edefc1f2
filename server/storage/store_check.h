// Reads a whole store and says what is wrong with it.
#ifndef REVISIT_SERVER_STORAGE_STORE_CHECK_H_
#define REVISIT_SERVER_STORAGE_STORE_CHECK_H_

#include <cstdint>
#include <set>
#include <string>
#include <vector>

#include "absl/status/statusor.h"
#include "server/storage/sqlite_database.h"
#include "server/storage/store_opening.h"

namespace revisit::server {

// Whether a server may be writing to a store while it is read.
enum class StoreUse { kIdle, kServed };

struct StoreReport {
  std::int64_t vehicles = 0;
  std::int64_t batches = 0;
  std::int64_t poses = 0;
  std::int64_t revised_batches = 0;
  std::int64_t loop_closures = 0;
  std::int64_t rejected_candidates = 0;
  // Each for people, in one line.
  std::vector<std::string> problems;
  // Ids of those that cannot be read whole, or that a damaged log has changes
  // of, as far as can be told.
  std::set<std::string> damaged_vehicles;
};

// How a store is to be read whole, by a process that is no server.
struct StoreToRead {
  std::string path;
  StoreUse use;
  SqliteDatabase::Mode mode;
  // Of an idle store.
  StoreExamination files;
  std::string looks;
};

// DATA_LOSS (STORE_CORRUPT) if the database is missing or empty. Writes
// nothing.
absl::StatusOr<StoreToRead> LookAtStore(const std::string& path, StoreUse use);
// Whether a server has taken an idle store since. What was read then may be
// wrong: read it again, as served.
bool HasChanged(const StoreToRead& store);

// Whether every page, table and index is what the others say: empty, or up to
// ten problems. Rows' own checksums are not looked at. DATA_LOSS where the
// damage does not even let it go on.
absl::StatusOr<std::vector<std::string>> FindStructuralDamage(
    SqliteDatabase& database, StoreUse use, const std::string& path);

// Reads every row of every vehicle: checksums, sequences without a gap, nothing
// that belongs to nobody; as of one moment a vehicle. Of an idle store also
// whether its files belong together and hold all that was flushed. Changes none
// of them. Fails only where the store cannot be opened at all: as
// OpenSqliteStorageToRead() does, or where its files do not belong together.
absl::StatusOr<StoreReport> CheckStore(const std::string& path, StoreUse use);

// "a, b and 3 more".
std::string Listed(const std::set<std::string>& names);

}  // namespace revisit::server

#endif  // REVISIT_SERVER_STORAGE_STORE_CHECK_H_
