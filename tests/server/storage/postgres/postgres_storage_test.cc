#include "server/storage/postgres/postgres_storage.h"

#include <chrono>
#include <memory>
#include <string>

#include "gmock/gmock.h"
#include "gtest/gtest.h"
#include "tests/server/error_matchers.h"
#include "tests/server/storage/postgres/postgres_server.h"
#include "tests/server/storage/storage_contract.h"

namespace revisit::server {
namespace {

using absl::StatusCode;
using ::testing::_;
using ::testing::HasSubstr;

std::unique_ptr<Storage> MustOpen(const std::string& conninfo,
                                  const PostgresOptions& options = {}) {
  absl::StatusOr<std::unique_ptr<Storage>> storage =
      OpenPostgresStorage(conninfo, options);
  EXPECT_THAT(storage, IsOk());
  return storage.ok() ? *std::move(storage) : nullptr;
}

class PostgresStore : public StoreUnderTest {
 public:
  explicit PostgresStore(const PostgresOptions& options)
      : conninfo_(PostgresServer::Shared()->MakeStore()),
        options_(options),
        storage_(MustOpen(conninfo_, options_)) {}

  Storage& storage() override { return *storage_; }

  // Each time another server opens it, which takes all vehicles.
  void Reopen() override {
    storage_.reset();
    storage_ = MustOpen(conninfo_, options_);
    const auto vehicles = storage_->ListVehicles("", "", 1000);
    EXPECT_THAT(vehicles, IsOk());
    for (const VehicleRecord& vehicle : *vehicles) {
      EXPECT_THAT(storage_->TakeVehicle(vehicle.id), IsOk());
    }
  }

 private:
  const std::string conninfo_;
  const PostgresOptions options_;
  std::unique_ptr<Storage> storage_;
};

std::unique_ptr<StoreUnderTest> MakeStore(const PostgresOptions& options) {
  if (PostgresServer::Shared() == nullptr) return nullptr;
  return std::make_unique<PostgresStore>(options);
}

PostgresOptions OneWriteAtATime() {
  PostgresOptions options;
  options.max_group_writes = 1;
  options.writer_connections = 1;
  return options;
}

PostgresOptions ManyConnections() {
  PostgresOptions options;
  options.writer_connections = 4;
  return options;
}

INSTANTIATE_TEST_SUITE_P(
    Postgres, StorageContract,
    ::testing::Values(
        StoreFactory{"WithDefaults", [] { return MakeStore({}); }},
        StoreFactory{"OneWriteAtATime",
                     [] { return MakeStore(OneWriteAtATime()); }},
        StoreFactory{"ManyConnections",
                     [] { return MakeStore(ManyConnections()); }}),
    NameOf);

class PostgresStorageTest : public ::testing::Test {
 protected:
  void SetUp() override {
    if (PostgresServer::Shared() == nullptr) {
      GTEST_SKIP() << "PostgreSQL's server programs are not installed";
    }
    conninfo_ = PostgresServer::Shared()->MakeStore();
  }

  std::string Sql(const std::string& sql) const {
    return PostgresServer::Shared()->Run(conninfo_, sql);
  }

  std::string conninfo_;
};

TEST_F(PostgresStorageTest, RefusesDatabaseWithoutTablesAndSaysWhatToRun) {
  EXPECT_THAT(
      OpenPostgresStorage(PostgresServer::Shared()->MakeEmptyDatabase(), {}),
      IsError(StatusCode::kFailedPrecondition, _,
              HasSubstr("revisitd migrate")));
}

}  // namespace
}  // namespace revisit::server
