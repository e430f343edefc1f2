// Makes a store in a file out of the records of another store.
#ifndef REVISIT_SERVER_STORAGE_SQLITE_STORE_INTAKE_H_
#define REVISIT_SERVER_STORAGE_SQLITE_STORE_INTAKE_H_

#include <memory>
#include <string>

#include "absl/status/statusor.h"
#include "server/storage/store_copy.h"

namespace revisit::server {

// The file is made under another name, checked when all is in it, and only then
// gets its own. FAILED_PRECONDITION if there is a store, or a part of one, at
// the path already.
absl::StatusOr<std::unique_ptr<StoreIntake>> FillFile(const std::string& path);

}  // namespace revisit::server

#endif  // REVISIT_SERVER_STORAGE_SQLITE_STORE_INTAKE_H_
