#include "tests/server/storage/sqlite/sqlite_testing.h"

#include <filesystem>
#include <utility>

#include "gmock/gmock.h"
#include "server/storage/sqlite/store_files.h"
#include "sqlite3.h"
#include "tests/server/error_matchers.h"
#include "tests/server/storage_testing.h"

namespace revisit::server {

std::unique_ptr<Storage> MustOpen(const std::string& path,
                                  const SqliteOptions& options) {
  absl::StatusOr<std::unique_ptr<Storage>> storage =
      OpenSqliteStorage(path, options);
  EXPECT_THAT(storage, IsOk());
  return storage.ok() ? *std::move(storage) : nullptr;
}

std::string RunSql(const std::string& path, const std::string& sql) {
  sqlite3* database = nullptr;
  EXPECT_EQ(sqlite3_open(path.c_str(), &database), SQLITE_OK);
  std::string result;
  const auto append = [](void* out, int columns, char** values, char**) {
    for (int i = 0; i < columns; ++i) {
      static_cast<std::string*>(out)->append(
          (i == 0 ? "" : "|") + std::string(values[i] ? values[i] : "NULL"));
    }
    static_cast<std::string*>(out)->append("\n");
    return 0;
  };
  char* error = nullptr;
  EXPECT_EQ(sqlite3_exec(database, sql.c_str(), append, &result, &error),
            SQLITE_OK)
      << (error ? error : "");
  sqlite3_free(error);
  sqlite3_close(database);
  return result;
}

void SqliteStorageTest::RemoveStore() const {
  std::filesystem::remove(Path());
  for (const std::string& file : FilesBeside(Path())) {
    std::filesystem::remove(file);
  }
}

VehicleKey SqliteStorageTest::MakeStore() {
  const std::unique_ptr<Storage> storage = MustOpen(Path());
  BlockingWrites write(storage.get());
  const VehicleKey key = *write.Create("truck");
  EXPECT_THAT(write.Append(key, {1, 2, 2, "alpha"}), IsOk());
  EXPECT_THAT(write.Append(key, {3, 2, 3, "beta"}), IsOk());
  EXPECT_THAT(write.Append(key, {5, 2, 4, "gamma"}), IsOk());
  EXPECT_THAT(write.Revise(key, {{5, 2, 0, "GAMMA"}}, 5), IsOk());
  EXPECT_THAT(write.AddPair(key, PairKind::kLoopClosure,
                            {"link", 6, 1, 99, "measured"}, 6),
              IsOk());
  EXPECT_THAT(
      write.AddPair(key, PairKind::kRejectedCandidate, {"no", 6, 2, 100}, 7),
      IsOk());
  return key;
}

}  // namespace revisit::server
