#include "server/storage/sqlite/sqlite_storage.h"

#include <unistd.h>

#include <chrono>
#include <cstdint>
#include <filesystem>
#include <memory>
#include <optional>
#include <string>
#include <thread>

#include "gmock/gmock.h"
#include "gtest/gtest.h"
#include "server/storage/sqlite/sqlite_database.h"
#include "tests/server/error_matchers.h"
#include "tests/server/storage/sqlite/sqlite_testing.h"
#include "tests/server/storage/storage_contract.h"
#include "tests/server/storage_testing.h"
#include "tests/server/temporary_directory.h"

namespace revisit::server {
namespace {

using absl::StatusCode;
using ::testing::_;
using ::testing::AllOf;
using ::testing::ElementsAre;
using ::testing::HasSubstr;

class SqliteStore : public StoreUnderTest {
 public:
  explicit SqliteStore(const SqliteOptions& options)
      : options_(options), storage_(MustOpen(Path(), options_)) {}

  Storage& storage() override { return *storage_; }
  void Reopen() override {
    storage_.reset();
    storage_ = MustOpen(Path(), options_);
  }

 private:
  std::string Path() const { return directory_.File("store.db"); }

  const TemporaryDirectory directory_;
  const SqliteOptions options_;
  std::unique_ptr<Storage> storage_;
};

SqliteOptions OneWriteAtATime() {
  SqliteOptions options;
  options.max_group_writes = 1;
  return options;
}

SqliteOptions SmallGroups() {
  SqliteOptions options;
  options.max_group_bytes = 4000;
  return options;
}

std::vector<StoreFactory> Factories() {
  return {{"WithDefaults",
           [] { return std::make_unique<SqliteStore>(SqliteOptions()); }},
          {"OneWriteAtATime",
           [] { return std::make_unique<SqliteStore>(OneWriteAtATime()); }},
          {"SmallGroups",
           [] { return std::make_unique<SqliteStore>(SmallGroups()); }}};
}

INSTANTIATE_TEST_SUITE_P(Sqlite, StorageContract,
                         ::testing::ValuesIn(Factories()), NameOf);
INSTANTIATE_TEST_SUITE_P(Sqlite, GroupContract,
                         ::testing::ValuesIn(Factories()), NameOf);

TEST_F(SqliteStorageTest, SecondServerIsToldWhoHasTheStore) {
  const std::unique_ptr<Storage> first = MustOpen(Path());
  EXPECT_THAT(
      OpenSqliteStorage(Path()),
      IsError(StatusCode::kFailedPrecondition, "",
              AllOf(HasSubstr("store.db"),
                    HasSubstr("in use by process " + std::to_string(getpid())),
                    HasSubstr("one server at a time"))));
  // And the first goes on.
  EXPECT_THAT(BlockingWrites(first.get()).Create("truck"), IsOk());
}

TEST_F(SqliteStorageTest, SecondServerFindsTheStoreUnderAnotherName) {
  const std::unique_ptr<Storage> first = MustOpen(Path());
  std::filesystem::create_symlink(Path(), directory_.File("other.db"));
  EXPECT_THAT(
      OpenSqliteStorage(directory_.File("other.db")),
      IsError(StatusCode::kFailedPrecondition, "", HasSubstr("in use")));
}

TEST_F(SqliteStorageTest, OpensAgainAfterClosing) {
  MustOpen(Path()).reset();
  EXPECT_THAT(OpenSqliteStorage(Path()), IsOk());
}

TEST_F(SqliteStorageTest, SaysWhichDirectoryIsMissing) {
  EXPECT_THAT(OpenSqliteStorage(directory_.File("no/store.db")),
              IsError(StatusCode::kNotFound, "", HasSubstr("no/store.db")));
}

TEST_F(SqliteStorageTest, PartsOfRemovedSnapshotsAreRemovedInTheBackground) {
  const VehicleKey key = MakeStore();
  const std::unique_ptr<Storage> storage = MustOpen(Path());
  BlockingWrites write(storage.get());
  for (int i = 0; i < 3; ++i) {
    for (std::uint32_t number = 0; number < 20; ++number) {
      ASSERT_THAT(write.PutSnapshotPart(key, number, std::string(20000, 'x')),
                  IsOk());
    }
  }
  ASSERT_THAT(write.PutSnapshot(key, {6, 20, "rest"}), IsOk());
  const auto count = [&](const std::string& table) {
    return RunSql(Path(), "SELECT count(*) FROM " + table);
  };
  const auto wait_for = [&](const std::string& parts) {
    const auto deadline =
        std::chrono::steady_clock::now() + std::chrono::seconds(60);
    while (count("snapshot_parts") != parts ||
           count("deleted_snapshots") != "0\n") {
      ASSERT_LT(std::chrono::steady_clock::now(), deadline);
      std::this_thread::sleep_for(std::chrono::milliseconds(10));
    }
  };
  wait_for("20\n");
  EXPECT_EQ(SnapshotOf(*storage, key).substr(0, 6), "to 6: ");
  ASSERT_THAT(write.Delete(key), IsOk());
  wait_for("0\n");
  EXPECT_EQ(count("snapshots"), "0\n");
}

TEST_F(SqliteStorageTest, KnowsWhatFollowsWithoutReadingItAgain) {
  // Deleted and made anew, a vehicle begins at 1 again; a refused batch changes
  // nothing of what follows.
  const std::unique_ptr<Storage> storage = MustOpen(Path());
  BlockingWrites write(storage.get());
  const auto gap = IsError(StatusCode::kFailedPrecondition, "SEQUENCE_GAP",
                           HasSubstr("vehicle 'truck'"));
  for (int life = 0; life < 3; ++life) {
    const VehicleKey key = *write.Create("truck");
    EXPECT_THAT(write.Append(key, {1, 2, 2, "a"}), IsOk());
    EXPECT_THAT(write.Append(key, {4, 1, 3, "c"}), gap);
    EXPECT_THAT(write.Append(key, {1, 2, 3, "a"}), gap);
    EXPECT_THAT(write.AppendWithVehicle(key, {3, 1, 3, "b"}, "new"), IsOk());
    EXPECT_THAT(write.Append(key, {4, 1, 4, "c"}), IsOk());
    EXPECT_THAT(write.Delete(key), IsOk());
    EXPECT_THAT(write.Append(key, {5, 1, 5, "d"}),
                IsError(StatusCode::kNotFound, "VEHICLE_NOT_FOUND", _));
  }
}

TEST_F(SqliteStorageTest, RemovesBatchesOfDeletedVehiclesAfterRestart) {
  {
    const std::unique_ptr<Storage> storage = MustOpen(Path());
    BlockingWrites write(storage.get());
    const VehicleKey key = *write.Create("truck");
    for (std::uint64_t i = 1; i <= 500; ++i) {
      AppendBatch(*storage, key, {i, 1, i + 1, "x"}, std::nullopt,
                  [](const absl::Status&) {});
    }
    ASSERT_THAT(write.Delete(key), IsOk());
  }
  // A stop may have left some; they go while the server runs. Every other write
  // takes a few away too, so this needs no waiting.
  const std::unique_ptr<Storage> storage = MustOpen(Path());
  BlockingWrites write(storage.get());
  for (int i = 0; i < 20; ++i) {
    ASSERT_THAT(write.Create("vehicle-" + std::to_string(i)), IsOk());
  }
  EXPECT_EQ(RunSql(Path(), "SELECT count(*) FROM batches"), "0\n");
  EXPECT_EQ(RunSql(Path(), "SELECT count(*) FROM deleted_vehicles"), "0\n");
}

TEST_F(SqliteStorageTest, RecoversFromLogAfterCrash) {
  // A crash leaves the files as they are: copied while the store is open, they
  // hold the log that was not yet copied into the database.
  const std::unique_ptr<Storage> storage = MustOpen(Path());
  BlockingWrites write(storage.get());
  const VehicleKey key = *write.Create("truck");
  ASSERT_THAT(write.Append(key, {1, 2, 2, "alpha"}), IsOk());
  const std::string crashed = directory_.File("crashed.db");
  std::filesystem::copy_file(Path(), crashed);
  std::filesystem::copy_file(Path() + "-wal", crashed + "-wal");
  const std::unique_ptr<Storage> recovered = MustOpen(crashed);
  EXPECT_THAT(ToTexts(*ReadAll(*recovered, key, 1, 2)),
              ElementsAre("1+2, revision 2, 'alpha'"));
}

TEST_F(SqliteStorageTest, TakesWritesAtOnceWhereSomebodyStillReads) {
  // A backup goes on when the server is killed. The log could not be emptied
  // then, and no server could start until the backup had ended.
  const std::string crashed = directory_.File("crashed.db");
  VehicleKey key = 0;
  {
    const std::unique_ptr<Storage> storage = MustOpen(Path());
    BlockingWrites write(storage.get());
    key = *write.Create("truck");
    ASSERT_THAT(write.Append(key, {1, 2, 2, "alpha"}), IsOk());
    std::filesystem::copy_file(Path(), crashed);
    std::filesystem::copy_file(Path() + "-wal", crashed + "-wal");
  }
  const auto backup =
      *SqliteDatabase::Open(crashed, SqliteDatabase::Mode::kReadOnly, "");
  ASSERT_THAT(backup->Execute("BEGIN; SELECT count(*) FROM batches"), IsOk());
  for (std::uint64_t i = 0; i < 3; ++i) {
    const std::unique_ptr<Storage> storage = MustOpen(crashed);
    EXPECT_EQ(storage->GetVehicle("truck")->durable_sequence, 2 + i);
    EXPECT_THAT(
        BlockingWrites(storage.get()).Append(key, {3 + i, 1, 3 + i, "x"}),
        IsOk());
  }
  // It reads what it began with, to its end.
  EXPECT_EQ(*backup->QueryInteger("SELECT count(*) FROM batches"), 1);
  ASSERT_THAT(backup->Execute("COMMIT"), IsOk());
  const std::unique_ptr<Storage> storage = MustOpen(crashed);
  EXPECT_THAT(ToTexts(*ReadAll(*storage, key, 1, 5)),
              ElementsAre("1+2, revision 2, 'alpha'", "3+1, revision 3, 'x'",
                          "4+1, revision 4, 'x'", "5+1, revision 5, 'x'"));
}

TEST_F(SqliteStorageTest, AcknowledgesNothingOnceItsFilesAreGone) {
  // Acknowledgements went on when the directory had been removed.
  enum class Harm { kRemoved, kMoved, kReplaced, kLogRemoved };
  for (const Harm harm :
       {Harm::kRemoved, Harm::kMoved, Harm::kReplaced, Harm::kLogRemoved}) {
    SCOPED_TRACE(static_cast<int>(harm));
    const std::filesystem::path home = directory_.File("home");
    std::filesystem::create_directory(home);
    const std::string path = (home / "store.db").string();
    int told = 0;
    SqliteOptions options;
    options.on_failure = [&](const absl::Status&) { ++told; };
    std::unique_ptr<Storage> storage = MustOpen(path, options);
    const VehicleKey key = *BlockingWrites(storage.get()).Create("truck");
    ASSERT_THAT(BlockingWrites(storage.get()).Append(key, {1, 1, 2, "one"}),
                IsOk());
    const std::string away = directory_.File("away");
    if (harm == Harm::kRemoved) {
      std::filesystem::remove_all(home);
    } else if (harm == Harm::kLogRemoved) {
      std::filesystem::remove(path + "-wal");
    } else {
      std::filesystem::rename(home, away);
    }
    if (harm == Harm::kReplaced) {
      std::filesystem::copy(away, home);
    }
    const auto gone = IsError(
        StatusCode::kUnavailable, "STORE_UNAVAILABLE",
        AllOf(HasSubstr("takes no more writes"), HasSubstr("store.db"),
              HasSubstr(harm == Harm::kReplaced ? "replaced" : "removed")));
    EXPECT_THAT(BlockingWrites(storage.get()).Append(key, {2, 1, 3, "two"}),
                gone);
    EXPECT_THAT(BlockingWrites(storage.get()).Append(key, {2, 1, 3, "two"}),
                gone);
    storage.reset();
    EXPECT_EQ(told, 1);
    // Nothing was made in the place of what is gone.
    if (harm == Harm::kRemoved || harm == Harm::kMoved) {
      EXPECT_FALSE(std::filesystem::exists(home));
    }
    std::filesystem::remove_all(home);
    std::filesystem::remove_all(away);
  }
}

TEST_F(SqliteStorageTest, DeletingGivesTheRoomBack) {
  std::unique_ptr<Storage> storage = MustOpen(Path());
  BlockingWrites write(storage.get());
  const VehicleKey truck = *write.Create("truck");
  const VehicleKey car = *write.Create("car");
  constexpr std::uint64_t kBatches = 40;
  for (std::uint64_t i = 1; i <= kBatches; ++i) {
    ASSERT_THAT(write.Append(truck, {i, 1, i, std::string(1 << 20, 't')}),
                IsOk());
    ASSERT_THAT(write.Append(car, {i, 1, i, std::string(10000, 'c')}), IsOk());
  }
  const auto full = std::filesystem::file_size(Path());
  EXPECT_GT(full, kBatches << 20);
  ASSERT_THAT(write.Delete(truck), IsOk());
  // While nobody does anything.
  const auto deadline =
      std::chrono::steady_clock::now() + std::chrono::seconds(60);
  while (std::filesystem::file_size(Path()) > (std::uintmax_t{10} << 20)) {
    ASSERT_LT(std::chrono::steady_clock::now(), deadline);
    std::this_thread::sleep_for(std::chrono::milliseconds(10));
  }
  EXPECT_THAT(ReadAll(*storage, car, 1, kBatches), IsOk());
  storage.reset();
  storage = MustOpen(Path());
  EXPECT_THAT(ReadAll(*storage, car, 1, kBatches), IsOk());
}

TEST_F(SqliteStorageTest, CutLogLeavesPrefix) {
  // A crash in the middle of a write: every length of the log is a store with
  // some number of whole batches, in order.
  const std::unique_ptr<Storage> storage = MustOpen(Path());
  BlockingWrites write(storage.get());
  const VehicleKey key = *write.Create("truck");
  for (std::uint64_t i = 1; i <= 10; ++i) {
    ASSERT_THAT(write.Append(key, {i, 1, i + 1, std::string(3000, 'x')}),
                IsOk());
  }
  const auto size = std::filesystem::file_size(Path() + "-wal");
  std::uint64_t longest = 0;
  for (std::uintmax_t length = 0; length <= size; length += 1777) {
    const std::string crashed = directory_.File("crashed.db");
    for (const char* suffix : {"", "-wal", "-shm", ".mark", ".lock"}) {
      std::filesystem::remove(crashed + suffix);
    }
    std::filesystem::copy_file(Path(), crashed);
    std::filesystem::copy_file(Path() + "-wal", crashed + "-wal");
    std::filesystem::resize_file(crashed + "-wal", length);
    const std::unique_ptr<Storage> recovered = MustOpen(crashed);
    ASSERT_NE(recovered, nullptr);
    const absl::StatusOr<VehicleRecord> record = recovered->GetVehicle("truck");
    if (!record.ok()) {
      EXPECT_EQ(longest, 0u);
      continue;
    }
    EXPECT_GE(record->durable_sequence, longest);
    longest = record->durable_sequence;
    if (longest > 0) {
      EXPECT_THAT(ReadAll(*recovered, key, 1, longest), IsOk());
    }
  }
  EXPECT_GE(longest, 9u);
}

}  // namespace
}  // namespace revisit::server
