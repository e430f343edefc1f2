// A store in a SQLite file for tests, and what SQL finds in it.
#ifndef REVISIT_TESTS_SERVER_STORAGE_SQLITE_SQLITE_TESTING_H_
#define REVISIT_TESTS_SERVER_STORAGE_SQLITE_SQLITE_TESTING_H_

#include <memory>
#include <string>

#include "gtest/gtest.h"
#include "server/storage/sqlite/sqlite_storage.h"
#include "tests/server/temporary_directory.h"

namespace revisit::server {

// Null, and a failure, if it cannot be opened.
std::unique_ptr<Storage> MustOpen(const std::string& path,
                                  const SqliteOptions& options = {});

// Runs SQL on a store that nobody has open; answers all values, one row a line.
std::string RunSql(const std::string& path, const std::string& sql);

class SqliteStorageTest : public ::testing::Test {
 protected:
  std::string Path() const { return directory_.File("store.db"); }
  void RemoveStore() const;
  // A store with one vehicle `truck`: batches 1-2, 3-4, 5-6, of which the last
  // is revised, a loop closure, and a rejected candidate.
  VehicleKey MakeStore();

  const TemporaryDirectory directory_;
};

}  // namespace revisit::server

#endif  // REVISIT_TESTS_SERVER_STORAGE_SQLITE_SQLITE_TESTING_H_
