#include "server/storage/sqlite/store_check.h"

#include <cstdint>
#include <filesystem>
#include <fstream>
#include <memory>
#include <set>
#include <sstream>
#include <string>

#include "gmock/gmock.h"
#include "gtest/gtest.h"
#include "server/storage/sqlite/sqlite_reader.h"
#include "server/storage/sqlite/sqlite_storage.h"
#include "server/storage/sqlite/store_backup.h"
#include "server/storage/sqlite/store_compaction.h"
#include "server/storage/sqlite/store_files.h"
#include "tests/server/error_matchers.h"
#include "tests/server/storage_testing.h"
#include "tests/server/temporary_directory.h"

namespace revisit::server {
namespace {

using absl::StatusCode;
using ::testing::AllOf;
using ::testing::Contains;
using ::testing::ElementsAre;
using ::testing::HasSubstr;
using ::testing::IsEmpty;
using ::testing::Not;

std::unique_ptr<Storage> MustOpen(const std::string& path,
                                  const SqliteOptions& options = {}) {
  absl::StatusOr<std::unique_ptr<Storage>> storage =
      OpenSqliteStorage(path, options);
  EXPECT_THAT(storage, IsOk());
  return storage.ok() ? *std::move(storage) : nullptr;
}

class StoreCheckTest : public ::testing::Test {
 protected:
  std::string Path() const { return directory_.File("store.db"); }

  // Vehicles `car` and `truck`, each with 30 batches of two poses that do not
  // fit into one page, a revised batch, a loop closure, a rejected candidate.
  void MakeStore() const {
    const std::unique_ptr<Storage> storage = MustOpen(Path());
    Fill(storage.get());
  }

  static void Fill(Storage* storage) {
    BlockingWrites write(storage);
    for (const char* id : {"car", "truck"}) {
      const VehicleKey key = *write.Create(id);
      for (std::uint64_t i = 0; i < 30; ++i) {
        const char letter = static_cast<char>(id[0] + i % 3);
        ASSERT_THAT(
            write.Append(key, {2 * i + 1, 2, i + 2, std::string(9000, letter)}),
            IsOk());
      }
      ASSERT_THAT(write.Revise(key, {{5, 2, 0, "revised"}}, 40), IsOk());
      ASSERT_THAT(
          write.AddPair(key, PairKind::kLoopClosure, {"link", 6, 1, 99}, 41),
          IsOk());
      ASSERT_THAT(write.AddPair(key, PairKind::kRejectedCandidate,
                                {"no", 6, 2, 100}, 42),
                  IsOk());
    }
  }

  static std::string ReadFile(const std::string& path) {
    std::ifstream in(path, std::ios::binary);
    std::stringstream all;
    all << in.rdbuf();
    return all.str();
  }

  // Changes a byte behind the first place where the file has this text.
  void Damage(const std::string& text, std::size_t behind) const {
    std::string bytes = ReadFile(Path());
    const std::size_t at = bytes.find(text);
    ASSERT_NE(at, std::string::npos);
    bytes[at + behind] = static_cast<char>(bytes[at + behind] ^ 1);
    std::ofstream(Path(), std::ios::binary) << bytes;
  }

  const TemporaryDirectory directory_;
};

TEST_F(StoreCheckTest, CountsWhatIsThere) {
  MakeStore();
  const StoreReport report = *CheckStore(Path(), StoreUse::kIdle);
  EXPECT_THAT(report.problems, IsEmpty());
  EXPECT_EQ(report.vehicles, 2);
  EXPECT_EQ(report.batches, 60);
  EXPECT_EQ(report.poses, 120);
  EXPECT_EQ(report.revised_batches, 2);
  EXPECT_EQ(report.loop_closures, 2);
  EXPECT_EQ(report.rejected_candidates, 2);
}

TEST_F(StoreCheckTest, NamesTheVehicleWithADamagedRowAndGoesOn) {
  MakeStore();
  Damage(std::string(3000, 't'), 1500);
  const StoreReport report = *CheckStore(Path(), StoreUse::kIdle);
  EXPECT_THAT(report.damaged_vehicles, ElementsAre("truck"));
  EXPECT_THAT(report.problems, ElementsAre(HasSubstr("fails its checksum")));
  EXPECT_EQ(report.vehicles, 2);
  // One vehicle's rows are no reason to keep the others from being served.
  const std::unique_ptr<Storage> storage = MustOpen(Path());
  EXPECT_THAT(storage->GetVehicle("car"), IsOk());
}

TEST_F(StoreCheckTest, DamageOfASnapshotIsNamedAndKeepsNoBackupFromBeingMade) {
  MakeStore();
  {
    const std::unique_ptr<Storage> storage = MustOpen(Path());
    BlockingWrites write(storage.get());
    for (const char* id : {"car", "truck"}) {
      const VehicleKey key = storage->GetVehicle(id)->key;
      ASSERT_THAT(write.PutSnapshotPart(
                      key, 0, std::string(500, id[0] == 'c' ? 'C' : 'T')),
                  IsOk());
      ASSERT_THAT(write.PutSnapshot(key, {60, 1, "rest"}), IsOk());
    }
    // One in the making is none.
    const VehicleKey key = *write.Create("bus");
    ASSERT_THAT(write.PutSnapshotPart(key, 0, "part"), IsOk());
  }
  StoreReport report = *CheckStore(Path(), StoreUse::kIdle);
  EXPECT_EQ(report.snapshots, 2);
  EXPECT_THAT(report.problems, IsEmpty());
  EXPECT_THAT(report.damaged_snapshots, IsEmpty());
  Damage(std::string(500, 'T'), 100);
  report = *CheckStore(Path(), StoreUse::kIdle);
  EXPECT_THAT(report.problems, IsEmpty());
  EXPECT_THAT(report.damaged_vehicles, IsEmpty());
  EXPECT_THAT(report.damaged_snapshots,
              ElementsAre(AllOf(HasSubstr("truck"), HasSubstr("checksum"))));
  const absl::StatusOr<StoreReport> backup =
      BackUpStore(Path(), StoreUse::kIdle, directory_.File("backup.db"));
  ASSERT_THAT(backup, IsOk());
  EXPECT_EQ(backup->snapshots, 2);
}

TEST_F(StoreCheckTest, DamageOfMarksIsNamedAsThatOfASnapshotIs) {
  MakeStore();
  {
    const std::unique_ptr<Storage> storage = MustOpen(Path());
    BlockingWrites write(storage.get());
    ASSERT_THAT(
        write.PutMarks(storage->GetVehicle("car")->key, std::string(500, 'M')),
        IsOk());
  }
  EXPECT_THAT(CheckStore(Path(), StoreUse::kIdle)->damaged_snapshots,
              IsEmpty());
  Damage(std::string(500, 'M'), 100);
  const StoreReport report = *CheckStore(Path(), StoreUse::kIdle);
  EXPECT_EQ(report.snapshots, 0);
  EXPECT_THAT(report.problems, IsEmpty());
  EXPECT_THAT(report.damaged_vehicles, IsEmpty());
  EXPECT_THAT(report.damaged_snapshots,
              ElementsAre(AllOf(HasSubstr("car"), HasSubstr("marks"),
                                HasSubstr("checksum"))));
}

TEST_F(StoreCheckTest, StoreWhoseTablesHideRowsIsNotOpened) {
  MakeStore();
  // The first page of a table's leaves, here as everywhere, begins with its
  // kind, and two bytes behind it has the number of its rows: one less, and
  // the last row is not there.
  std::string bytes = ReadFile(Path());
  bool found = false;
  for (std::size_t page = 8192; page < bytes.size() && !found; page += 8192) {
    // The index of batches: 60 entries on one leaf.
    found = bytes[page] == 0x0a && bytes[page + 4] == 60;
    if (found) bytes[page + 4] = 59;
  }
  ASSERT_TRUE(found);
  std::ofstream(Path(), std::ios::binary) << bytes;
  EXPECT_THAT(
      OpenSqliteStorage(Path()),
      IsError(StatusCode::kDataLoss, "STORE_CORRUPT", HasSubstr("is damaged")));
  EXPECT_THAT(CheckStore(Path(), StoreUse::kIdle)->problems, Not(IsEmpty()));
  // A store that is too large to be checked at once is not.
  SqliteOptions unchecked;
  unchecked.max_checked_bytes = 1000;
  EXPECT_THAT(OpenSqliteStorage(Path(), unchecked), IsOk());
}

TEST_F(StoreCheckTest, StoreWithADamagedNameInItsTablesIsNotOpened) {
  MakeStore();
  std::string bytes = ReadFile(Path());
  const std::size_t at = bytes.find("query_sequence INTEGER");
  ASSERT_NE(at, std::string::npos);
  bytes[at] = 'Q' ^ 1;
  std::ofstream(Path(), std::ios::binary) << bytes;
  const auto refused = IsError(StatusCode::kDataLoss, "STORE_CORRUPT",
                               HasSubstr("is not as it was made"));
  EXPECT_THAT(OpenSqliteStorage(Path()), refused);
  EXPECT_THAT(CheckStore(Path(), StoreUse::kIdle), refused);
}

TEST_F(StoreCheckTest, DamagedNamesComeOutAsTextThatHarmsNoTerminal) {
  MakeStore();
  std::string bytes = ReadFile(Path());
  const std::size_t at = bytes.find("sqlite_autoindex_vehicles_1");
  ASSERT_NE(at, std::string::npos);
  bytes.replace(at, 8, "\xf5\x1b[31m\n!");
  std::ofstream(Path(), std::ios::binary) << bytes;
  const absl::Status refused = OpenSqliteStorage(Path()).status();
  EXPECT_THAT(refused,
              IsError(StatusCode::kDataLoss, "STORE_CORRUPT", HasSubstr("??")));
  for (const char c : std::string(refused.message())) {
    EXPECT_TRUE(c >= ' ' && c <= '~') << static_cast<int>(c);
  }
}

TEST_F(StoreCheckTest, FileThatWasCutIsNotOpened) {
  MakeStore();
  const std::string bytes = ReadFile(Path());
  for (const std::size_t less : {1, 5000, 8192, 30000}) {
    std::ofstream(Path(), std::ios::binary)
        << bytes.substr(0, bytes.size() - less);
    EXPECT_THAT(OpenSqliteStorage(Path()),
                IsError(StatusCode::kDataLoss, "STORE_CORRUPT",
                        HasSubstr("is damaged")))
        << less;
  }
}

// A full disk stopped the copying of the log in the middle of a page.
TEST_F(StoreCheckTest, PageThatIsCutDoesNoHarmWhereTheLogHoldsIt) {
  const std::string copy = directory_.File("copy.db");
  {
    const std::unique_ptr<Storage> storage = MustOpen(Path());
    Fill(storage.get());
    for (const char* suffix : {"", "-wal", ".mark"}) {
      ASSERT_TRUE(std::filesystem::copy_file(Path() + suffix, copy + suffix));
    }
  }
  ASSERT_GT(std::filesystem::file_size(copy + "-wal"), 100'000u);
  std::ofstream(copy, std::ios::binary | std::ios::app)
      << std::string(4096 - 512, '\0');
  const absl::StatusOr<StoreReport> report = CheckStore(copy, StoreUse::kIdle);
  ASSERT_THAT(report, IsOk());
  EXPECT_THAT(report->problems, IsEmpty());
  EXPECT_EQ(report->poses, 120);
}

TEST_F(StoreCheckTest, FindsRowsThatBelongToNobody) {
  MakeStore();
  {
    const auto database =
        *SqliteDatabase::Open(Path(), SqliteDatabase::Mode::kReadWrite, "");
    ASSERT_THAT(database->Execute("DELETE FROM vehicles WHERE id = 'car'"),
                IsOk());
  }
  EXPECT_THAT(CheckStore(Path(), StoreUse::kIdle)->problems,
              AllOf(Contains("30 batches belong to no vehicle"),
                    Contains(HasSubstr("2 loop closures or rejected"))));
}

TEST_F(StoreCheckTest, RefusesWhatIsNoStoreOfThisFormat) {
  EXPECT_THAT(CheckStore(directory_.File("none"), StoreUse::kIdle),
              IsError(StatusCode::kNotFound, "", HasSubstr("no store at")));
  {
    ASSERT_THAT(MakePrivateFile(Path()), IsOk());
    const auto database =
        *SqliteDatabase::Open(Path(), SqliteDatabase::Mode::kReadWrite, "");
    ASSERT_THAT(database->Execute("CREATE TABLE songs (title TEXT)"), IsOk());
  }
  EXPECT_THAT(CheckStore(Path(), StoreUse::kIdle),
              IsError(StatusCode::kFailedPrecondition, "",
                      HasSubstr("of another program")));
}

TEST_F(StoreCheckTest, StoreOpenedForReadingTakesNoWrites) {
  MakeStore();
  const auto storage =
      OpenSqliteStorageToRead(Path(), SqliteDatabase::Mode::kReadOnly);
  ASSERT_THAT(storage, IsOk());
  EXPECT_EQ((*storage)->GetVehicle("car")->durable_sequence, 60u);
  EXPECT_THAT(BlockingWrites(storage->get()).Create("bus"),
              IsError(StatusCode::kFailedPrecondition, "INTERNAL",
                      HasSubstr("opened for reading")));
}

TEST_F(StoreCheckTest, BackupOfAStoreInUseHoldsAllThatWasAcknowledged) {
  const std::unique_ptr<Storage> storage = MustOpen(Path());
  Fill(storage.get());
  const std::string copy = directory_.File("copy.db");
  const absl::StatusOr<StoreReport> report =
      BackUpStore(Path(), StoreUse::kServed, copy);
  ASSERT_THAT(report, IsOk());
  EXPECT_EQ(report->poses, 120);
  // One file, complete by itself.
  for (const char* suffix : {"-wal", "-shm", "-journal", ".partial"}) {
    EXPECT_FALSE(std::filesystem::exists(copy + suffix)) << suffix;
  }
  const std::unique_ptr<Storage> restored = MustOpen(copy);
  EXPECT_EQ(restored->GetVehicle("truck")->durable_sequence, 60u);
  EXPECT_THAT(BlockingWrites(restored.get()).Create("bus"), IsOk());
}

TEST_F(StoreCheckTest, BackupGivesWayToAServerWhoseLogGrowsTooFar) {
  // While it copied, the log grew without a bound.
  const std::unique_ptr<Storage> storage = MustOpen(Path());
  Fill(storage.get());
  const std::string copy = directory_.File("copy.db");
  BackupBounds bounds;
  bounds.max_log_growth = -1;
  EXPECT_THAT(BackUpStore(Path(), StoreUse::kServed, copy, bounds),
              IsError(StatusCode::kUnavailable, "STORE_UNAVAILABLE",
                      AllOf(HasSubstr("gave way"), HasSubstr("-wal grew"))));
  bounds.max_log_growth = 0;
  bounds.min_free_bytes = std::int64_t{1} << 60;
  EXPECT_THAT(BackUpStore(Path(), StoreUse::kServed, copy, bounds),
              IsError(StatusCode::kUnavailable, "STORE_UNAVAILABLE",
                      AllOf(HasSubstr("gave way"), HasSubstr("bytes left"))));
  EXPECT_FALSE(std::filesystem::exists(copy));
  EXPECT_FALSE(std::filesystem::exists(copy + ".partial"));
  bounds.min_free_bytes = 0;
  EXPECT_THAT(BackUpStore(Path(), StoreUse::kServed, copy, bounds), IsOk());
}

TEST_F(StoreCheckTest, CompactingKeepsEveryRowAndNoRoom) {
  MakeStore();
  {
    // As other programs may leave it: it cannot shrink by itself.
    const auto database =
        *SqliteDatabase::Open(Path(), SqliteDatabase::Mode::kReadWrite, "");
    ASSERT_THAT(database->Execute("PRAGMA journal_mode = DELETE;"
                                  "PRAGMA auto_vacuum = NONE; VACUUM"),
                IsOk());
    ASSERT_EQ(*database->QueryInteger("PRAGMA auto_vacuum"), 0);
  }
  {
    const std::unique_ptr<Storage> storage = MustOpen(Path());
    BlockingWrites write(storage.get());
    ASSERT_THAT(write.Delete(storage->GetVehicle("car")->key), IsOk());
    // Every other write removes some of its rows.
    for (int i = 0; i < 5; ++i) {
      ASSERT_THAT(write.Update(storage->GetVehicle("truck")->key, "new", 50),
                  IsOk());
    }
  }
  std::filesystem::permissions(Path(), std::filesystem::perms(0640));
  const absl::StatusOr<CompactionReport> report = CompactStore(Path());
  ASSERT_THAT(report, IsOk());
  EXPECT_LT(report->bytes_after, report->bytes_before * 2 / 3);
  EXPECT_EQ(static_cast<std::uintmax_t>(report->bytes_after),
            std::filesystem::file_size(Path()));
  EXPECT_FALSE(std::filesystem::exists(Path() + ".compact"));
  EXPECT_EQ(std::filesystem::status(Path()).permissions(),
            std::filesystem::perms(0640));
  const StoreReport sound = *CheckStore(Path(), StoreUse::kIdle);
  EXPECT_THAT(sound.problems, IsEmpty());
  EXPECT_EQ(sound.vehicles, 1);
  EXPECT_EQ(sound.batches, 30);
  {
    const auto database =
        *SqliteDatabase::Open(Path(), SqliteDatabase::Mode::kReadOnly, "");
    EXPECT_EQ(*database->QueryInteger("PRAGMA auto_vacuum"), 2);
    EXPECT_EQ(*database->QueryInteger("PRAGMA page_size"), 8192);
  }
  const std::unique_ptr<Storage> storage = MustOpen(Path());
  EXPECT_THAT(BlockingWrites(storage.get()).Create("bus"), IsOk());
  EXPECT_THAT(CompactStore(Path()), IsError(StatusCode::kFailedPrecondition, "",
                                            HasSubstr("in use")));
}

TEST_F(StoreCheckTest, LogOfBeforeIsNotAppliedToACompactedStore) {
  std::string log;
  {
    const std::unique_ptr<Storage> storage = MustOpen(Path());
    Fill(storage.get());
    log = ReadFile(Path() + "-wal");
  }
  ASSERT_THAT(CompactStore(Path()), IsOk());
  std::ofstream(Path() + "-wal", std::ios::binary) << log;
  EXPECT_THAT(OpenSqliteStorage(Path()),
              IsError(StatusCode::kDataLoss, "STORE_CORRUPT",
                      HasSubstr("is older than the database")));
}

TEST_F(StoreCheckTest, DamagedStoreIsNotCompacted) {
  MakeStore();
  Damage(std::string(3000, 't'), 1500);
  const std::string before = ReadFile(Path());
  EXPECT_THAT(
      CompactStore(Path()),
      IsError(StatusCode::kDataLoss, "STORE_CORRUPT", HasSubstr("truck")));
  EXPECT_EQ(ReadFile(Path()), before);
  EXPECT_FALSE(std::filesystem::exists(Path() + ".compact"));
}

TEST_F(StoreCheckTest, BackupReplacesNothing) {
  MakeStore();
  const std::string copy = directory_.File("copy.db");
  std::ofstream(copy) << "precious";
  EXPECT_THAT(BackUpStore(Path(), StoreUse::kIdle, copy),
              IsError(StatusCode::kFailedPrecondition, "",
                      HasSubstr("replaces nothing")));
  EXPECT_EQ(ReadFile(copy), "precious");
}

TEST_F(StoreCheckTest, DamagedStoreGivesNoBackup) {
  MakeStore();
  Damage(std::string(3000, 't'), 1500);
  const std::string copy = directory_.File("copy.db");
  EXPECT_THAT(
      BackUpStore(Path(), StoreUse::kIdle, copy),
      IsError(StatusCode::kDataLoss, "STORE_CORRUPT", HasSubstr("truck")));
  EXPECT_FALSE(std::filesystem::exists(copy));
  EXPECT_FALSE(std::filesystem::exists(copy + ".partial"));
}

TEST_F(StoreCheckTest, WritesBelowTheWatermarkAreRefusedAndDeletionsAreNot) {
  MakeStore();
  SqliteOptions options;
  // More than any disk has.
  options.min_free_bytes = std::int64_t{1} << 50;
  const std::unique_ptr<Storage> storage = MustOpen(Path(), options);
  BlockingWrites write(storage.get());
  EXPECT_THAT(write.Create("bus"),
              IsError(StatusCode::kResourceExhausted, "STORAGE_FULL",
                      HasSubstr("bytes left")));
  EXPECT_THAT(storage->GetVehicle("car"), IsOk());
  EXPECT_THAT(write.Delete(storage->GetVehicle("car")->key), IsOk());
  EXPECT_THAT(
      storage->GetVehicle("car"),
      IsError(StatusCode::kNotFound, "VEHICLE_NOT_FOUND", HasSubstr("car")));
}

TEST_F(StoreCheckTest, ReserveIsThereUntilItIsGivenUp) {
  EXPECT_FALSE(GiveUpReserve(Path()));
  MakeStore();
  EXPECT_GT(std::filesystem::file_size(Path() + ".reserve"), 100'000u);
  EXPECT_TRUE(GiveUpReserve(Path()));
  EXPECT_FALSE(GiveUpReserve(Path()));
}

TEST_F(StoreCheckTest, ListsSoManyNamesAndCountsTheRest) {
  EXPECT_EQ(Listed({}), "");
  EXPECT_EQ(Listed({"b", "a"}), "a, b");
  std::set<std::string> many;
  for (int i = 10; i < 40; ++i) many.insert(std::to_string(i));
  EXPECT_THAT(Listed(many), HasSubstr("28, 29 and 10 more"));
}

}  // namespace
}  // namespace revisit::server
