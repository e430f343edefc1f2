// Reads a whole database and says what is wrong with it.
#ifndef REVISIT_SERVER_STORAGE_POSTGRES_POSTGRES_CHECK_H_
#define REVISIT_SERVER_STORAGE_POSTGRES_POSTGRES_CHECK_H_

#include <string>

#include "absl/status/statusor.h"
#include "server/storage/store_report.h"

namespace revisit::server {

// Reads every row of every vehicle, while servers may write, and checks
// checksums, that sequences have no gap and end where the vehicle's head says,
// and that no row is without its vehicle. Changes nothing. It fails only if the
// store cannot be opened at all: as OpenPostgresStorageToRead() does.
absl::StatusOr<StoreReport> CheckDatabase(const std::string& conninfo);

}  // namespace revisit::server

#endif  // REVISIT_SERVER_STORAGE_POSTGRES_POSTGRES_CHECK_H_
