// Fills an empty database with the records of another store.
#ifndef REVISIT_SERVER_STORAGE_POSTGRES_POSTGRES_INTAKE_H_
#define REVISIT_SERVER_STORAGE_POSTGRES_POSTGRES_INTAKE_H_

#include <memory>
#include <string>

#include "absl/status/statusor.h"
#include "server/storage/store_copy.h"

namespace revisit::server {

// One transaction, during which nobody else can create vehicles.
// FAILED_PRECONDITION if the database has vehicles already, or not the tables
// of this version. Other errors are those of connection.h.
absl::StatusOr<std::unique_ptr<StoreIntake>> FillDatabase(
    const std::string& conninfo);

}  // namespace revisit::server

#endif  // REVISIT_SERVER_STORAGE_POSTGRES_POSTGRES_INTAKE_H_
