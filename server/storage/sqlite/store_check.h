// Reads a whole store and says what is wrong with it.
#ifndef REVISIT_SERVER_STORAGE_SQLITE_STORE_CHECK_H_
#define REVISIT_SERVER_STORAGE_SQLITE_STORE_CHECK_H_

#include <cstdint>
#include <string>
#include <vector>

#include "absl/status/statusor.h"
#include "server/storage/sqlite/sqlite_database.h"
#include "server/storage/sqlite/store_examination.h"
#include "server/storage/store_report.h"

namespace revisit::server {

// Whether a server may be writing to a store while it is read.
enum class StoreUse { kIdle, kServed };

// How a process other than the server reads a store whole.
struct StoreToRead {
  std::string path;
  StoreUse use;
  SqliteDatabase::Mode mode;
  // Examination of an idle store; not filled in for one that is served.
  StoreExamination files;
  std::string looks;
};

// DATA_LOSS (STORE_CORRUPT) if the database is missing or empty. Writes
// nothing.
absl::StatusOr<StoreToRead> LookAtStore(const std::string& path, StoreUse use);
// Whether a server has taken an idle store since LookAtStore(). What was read
// meanwhile may be wrong: read it again, as a served store.
bool HasChanged(const StoreToRead& store);

// Checks that pages, tables and indexes agree with each other. Returns up to
// ten problems. It does not check the checksums of rows. DATA_LOSS if damage
// keeps it from going on.
absl::StatusOr<std::vector<std::string>> FindStructuralDamage(
    SqliteDatabase& database, StoreUse use, const std::string& path);

// Reads every row of every vehicle, as of one moment per vehicle, and checks
// checksums, that sequences have no gap, and that no row is without its
// vehicle. For an idle store it also checks that the files belong together and
// hold all that was flushed. It changes none of them. It fails only if the
// store cannot be opened at all: as OpenSqliteStorageToRead() does, or if its
// files do not belong together.
absl::StatusOr<StoreReport> CheckStore(const std::string& path, StoreUse use);

}  // namespace revisit::server

#endif  // REVISIT_SERVER_STORAGE_SQLITE_STORE_CHECK_H_
