#include "server/storage/sqlite/sqlite_storage.h"

#include <unistd.h>

#include <chrono>
#include <cstdint>
#include <filesystem>
#include <fstream>
#include <memory>
#include <numeric>
#include <optional>
#include <sstream>
#include <string>
#include <thread>
#include <utility>
#include <vector>

#include "gmock/gmock.h"
#include "gtest/gtest.h"
#include "server/storage/record_checksum.h"
#include "server/storage/sqlite/sqlite_database.h"
#include "server/storage/sqlite/store_files.h"
#include "sqlite3.h"
#include "tests/random.h"
#include "tests/server/error_matchers.h"
#include "tests/server/storage/sqlite/failing_device.h"
#include "tests/server/storage/storage_contract.h"
#include "tests/server/temporary_directory.h"
#include "tests/server/waiting.h"

namespace revisit::server {
namespace {

using absl::StatusCode;
using ::testing::_;
using ::testing::AllOf;
using ::testing::ElementsAre;
using ::testing::HasSubstr;

std::unique_ptr<Storage> MustOpen(const std::string& path,
                                  const SqliteOptions& options = {}) {
  absl::StatusOr<std::unique_ptr<Storage>> storage =
      OpenSqliteStorage(path, options);
  EXPECT_THAT(storage, IsOk());
  return storage.ok() ? *std::move(storage) : nullptr;
}

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

INSTANTIATE_TEST_SUITE_P(
    Sqlite, StorageContract,
    ::testing::Values(
        StoreFactory{
            "WithDefaults",
            [] { return std::make_unique<SqliteStore>(SqliteOptions()); }},
        StoreFactory{
            "OneWriteAtATime",
            [] { return std::make_unique<SqliteStore>(OneWriteAtATime()); }},
        StoreFactory{
            "SmallGroups",
            [] { return std::make_unique<SqliteStore>(SmallGroups()); }}),
    NameOf);

// Runs SQL on a store that nobody has open; answers all values, one row a line.
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

class SqliteStorageTest : public ::testing::Test {
 protected:
  std::string Path() const { return directory_.File("store.db"); }

  void RemoveStore() const {
    std::filesystem::remove(Path());
    for (const std::string& file : FilesBeside(Path())) {
      std::filesystem::remove(file);
    }
  }

  // A store with one vehicle `truck`: batches 1-2, 3-4, 5-6, of which the last
  // is revised, a loop closure, and a rejected candidate.
  VehicleKey MakeStore() {
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

  const TemporaryDirectory directory_;
};

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

TEST_F(SqliteStorageTest, RefusesNewerFormat) {
  MakeStore();
  RunSql(Path(), "PRAGMA user_version = 6");
  EXPECT_THAT(OpenSqliteStorage(Path()),
              IsError(StatusCode::kFailedPrecondition, "",
                      AllOf(HasSubstr("has format 6"),
                            HasSubstr("this server reads formats 4 to 5"),
                            HasSubstr("use a newer server"))));
}

TEST_F(SqliteStorageTest, RefusesFormatThatWasNeverReleased) {
  MakeStore();
  RunSql(Path(), "PRAGMA user_version = 3");
  EXPECT_THAT(OpenSqliteStorage(Path()),
              IsError(StatusCode::kFailedPrecondition, "",
                      AllOf(HasSubstr("has format 3"),
                            HasSubstr("this server reads formats 4 to 5"))));
}

TEST_F(SqliteStorageTest, RefusesFileOfAnotherProgramAndLeavesItAsItIs) {
  RunSql(Path(), "CREATE TABLE songs (title TEXT)");
  EXPECT_THAT(OpenSqliteStorage(Path()),
              IsError(StatusCode::kFailedPrecondition, "",
                      HasSubstr("of another program")));
  EXPECT_EQ(RunSql(Path(), "SELECT name FROM sqlite_schema"), "songs\n");
  EXPECT_EQ(RunSql(Path(), "PRAGMA journal_mode"), "delete\n");
}

TEST_F(SqliteStorageTest, RefusesFileThatIsNoDatabase) {
  std::ofstream(Path()) << "Dear diary, today I drove around the block twice. "
                        << std::string(4096, '.');
  EXPECT_THAT(OpenSqliteStorage(Path()),
              IsError(StatusCode::kFailedPrecondition, "",
                      HasSubstr("is not a store of revisit")));
}

TEST_F(SqliteStorageTest, WritesFormat5) {
  // Golden: a change here is a new format. The checksums were printed by this
  // program once; record_checksum.h says what they are made of.
  const VehicleKey key = MakeStore();
  EXPECT_EQ(key, 1);
  EXPECT_EQ(RunSql(Path(), "PRAGMA application_id; PRAGMA user_version"),
            "1381389140\n5\n");
  EXPECT_EQ(RunSql(Path(), "PRAGMA journal_mode"), "wal\n");
  EXPECT_EQ(RunSql(Path(), "PRAGMA page_size"), "8192\n");
  EXPECT_EQ(RunSql(Path(),
                   "SELECT name FROM sqlite_schema WHERE type = "
                   "'table' ORDER BY name"),
            "batches\ndeleted_snapshots\ndeleted_vehicles\nloop_closures\n"
            "rejected_candidates\nrevised_batches\nsnapshot_parts\nsnapshots\n"
            "sqlite_sequence\nstore\nvehicles\n");
  EXPECT_EQ(RunSql(Path(),
                   "SELECT key, id, format, revision, checksum, "
                   "payload FROM vehicles"),
            "1|truck|5|7|-849705879005082293|payload\n");
  EXPECT_EQ(RunSql(Path(), "PRAGMA auto_vacuum"), "2\n");
  // Where store_state.h says that it stands; of the rest only the number of the
  // commit, the creation's included, and that it was the last are known.
  EXPECT_EQ(RunSql(Path(),
                   "SELECT key, substr(state, 1, 8), hex(substr(state, 25, "
                   "8)), hex(substr(state, 49, 8)), length(state) FROM store"),
            "1|RVSTATE3|0900000000000000|0100000000000000|64\n");
  const std::string batch =
      "SELECT vehicle_key, first_sequence, count, format, revision, checksum, "
      "payload FROM ";
  EXPECT_EQ(RunSql(Path(), batch + "batches"),
            "1|1|2|5|2|5854594566563219142|alpha\n"
            "1|3|2|5|3|-2588423461738458171|beta\n"
            "1|5|2|5|4|-588482591432174812|gamma\n");
  EXPECT_EQ(RunSql(Path(), batch + "revised_batches"),
            "1|5|2|5|5|289742499483280071|GAMMA\n");
  const std::string pair =
      "SELECT vehicle_key, id, format, query_sequence, matched_sequence, "
      "create_time_ns, checksum, payload FROM ";
  EXPECT_EQ(RunSql(Path(), pair + "loop_closures"),
            "1|link|5|6|1|99|7278644712121708534|measured\n");
  EXPECT_EQ(RunSql(Path(), pair + "rejected_candidates"),
            "1|no|5|6|2|100|-6714604230668513376|\n");
}

// Makes the store of MakeStore() what a server of format 4 left: the same, but
// for snapshots. The checksums are those that such a server wrote.
constexpr char kToFormat4[] = R"sql(
DROP TABLE snapshots;
DROP TABLE snapshot_parts;
DROP TABLE deleted_snapshots;
UPDATE vehicles SET format = 4, checksum = 6652353905742275111;
UPDATE batches SET format = 4, checksum = -4829067349424724470
  WHERE first_sequence = 1;
UPDATE batches SET format = 4, checksum = 1285076461158854921
  WHERE first_sequence = 3;
UPDATE batches SET format = 4, checksum = -4653714669878249062
  WHERE first_sequence = 5;
UPDATE revised_batches SET format = 4, checksum = 5734659888365959222;
UPDATE loop_closures SET format = 4, checksum = -2405007697103716199;
UPDATE rejected_candidates SET format = 4, checksum = 1990917711815163374;
PRAGMA user_version = 4;
)sql";

TEST_F(SqliteStorageTest, StoreOfFormat4OpensAndGainsSnapshots) {
  MakeStore();
  RunSql(Path(), kToFormat4);
  {
    const std::unique_ptr<Storage> storage = MustOpen(Path());
    BlockingWrites write(storage.get());
    EXPECT_EQ(ToText(*storage->GetVehicle("truck")),
              "truck 1: 1 closures, 1 rejected, to 6, revision 7, 'payload'");
    EXPECT_THAT(
        ToTexts(*ReadAll(*storage, 1, 1, 6)),
        ElementsAre("1+2, revision 2, 'alpha'", "3+2, revision 3, 'beta'",
                    "5+2, revision 5, 'GAMMA'"));
    EXPECT_EQ(SnapshotOf(*storage, 1), "none");
    EXPECT_THAT(write.PutSnapshotPart(1, 0, "part"), IsOk());
    EXPECT_THAT(write.PutSnapshot(1, {6, 1, "rest"}), IsOk());
  }
  EXPECT_EQ(RunSql(Path(), "PRAGMA user_version"), "5\n");
  EXPECT_EQ(RunSql(Path(), "SELECT format, count(*) FROM batches GROUP BY 1"),
            "4|3\n");
  EXPECT_EQ(SnapshotOf(*MustOpen(Path()), 1), "to 6: part, 'rest'");
}

TEST_F(SqliteStorageTest,
       StoreOfFormat4StaysAsItIsIfItCannotBeBroughtUpToDate) {
  MakeStore();
  RunSql(Path(), kToFormat4);
  // The name is taken, which is as good a failure as any.
  RunSql(Path(), "CREATE TABLE snapshot_parts (mine INTEGER)");
  EXPECT_THAT(OpenSqliteStorage(Path()),
              IsError(StatusCode::kInternal, "INTERNAL",
                      HasSubstr("snapshot_parts already exists")));
  EXPECT_EQ(RunSql(Path(), "PRAGMA user_version"), "4\n");
  RunSql(Path(), "DROP TABLE snapshot_parts");
  EXPECT_EQ(MustOpen(Path())->GetVehicle("truck")->durable_sequence, 6u);
}

TEST_F(SqliteStorageTest, DamageOfASnapshotIsFoundWhereverItIs) {
  for (const std::string& damage : std::vector<std::string>{
           "UPDATE snapshots SET payload = 'resT'",
           "UPDATE snapshots SET last_sequence = 5",
           "UPDATE snapshots SET part_count = 1",
           "UPDATE snapshots SET part_count = 3",
           "UPDATE snapshots SET format = 4",
           "UPDATE snapshots SET checksum = checksum + 1",
           "UPDATE snapshot_parts SET payload = 'onE' WHERE number = 0",
           "UPDATE snapshot_parts SET payload = '' WHERE number = 1",
           "UPDATE snapshot_parts SET format = 4 WHERE number = 1",
           "UPDATE snapshot_parts SET number = 2 WHERE number = 1",
           "UPDATE snapshot_parts SET number = 7 - number",
           "UPDATE snapshot_parts SET snapshot_key = 2",
           "DELETE FROM snapshot_parts WHERE number = 0"}) {
    SCOPED_TRACE(damage);
    RemoveStore();
    const VehicleKey key = MakeStore();
    {
      const std::unique_ptr<Storage> storage = MustOpen(Path());
      BlockingWrites write(storage.get());
      ASSERT_THAT(write.PutSnapshotPart(key, 0, "one"), IsOk());
      ASSERT_THAT(write.PutSnapshotPart(key, 1, "two"), IsOk());
      ASSERT_THAT(write.PutSnapshot(key, {6, 2, "rest"}), IsOk());
      ASSERT_EQ(SnapshotOf(*storage, key), "to 6: one two, 'rest'");
    }
    RunSql(Path(), damage);
    const std::unique_ptr<Storage> storage = MustOpen(Path());
    EXPECT_THAT(SnapshotOf(*storage, key), HasSubstr("damaged"));
    // The poses are as they were.
    EXPECT_EQ(ReadAll(*storage, key, 1, 6)->size(), 3u);
  }
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

TEST_F(SqliteStorageTest, NamesBatchWhosePayloadIsDamaged) {
  const VehicleKey key = MakeStore();
  RunSql(Path(),
         "UPDATE batches SET payload = 'betA' WHERE first_sequence = 3");
  const std::unique_ptr<Storage> storage = MustOpen(Path());
  const absl::Status status = ReadAll(*storage, key, 1, 6).status();
  EXPECT_THAT(status, IsError(StatusCode::kDataLoss, "STORE_CORRUPT",
                              AllOf(HasSubstr("vehicle 'truck'"),
                                    HasSubstr("sequences 3 to 4"),
                                    HasSubstr("fails its checksum"))));
  EXPECT_EQ(MetadataOf(status, "vehicle"), "truck");
  EXPECT_EQ(MetadataOf(status, "first_sequence"), "3");
  // The others are as they were.
  EXPECT_THAT(ToTexts(*ReadAll(*storage, key, 1, 2)),
              ElementsAre("1+2, revision 2, 'alpha'"));
  EXPECT_THAT(ToTexts(*ReadAll(*storage, key, 5, 6)),
              ElementsAre("5+2, revision 5, 'GAMMA'"));
}

TEST_F(SqliteStorageTest, FindsDamageOfEveryColumn) {
  const std::vector<std::string> damages = {
      "UPDATE batches SET payload = substr(payload, 2) WHERE first_sequence=3",
      "UPDATE batches SET revision = 9 WHERE first_sequence = 3",
      "UPDATE batches SET count = 1 WHERE first_sequence = 3",
      "UPDATE batches SET count = 4294967298 WHERE first_sequence = 3",
      "UPDATE batches SET format = 4 WHERE first_sequence = 3",
      "UPDATE batches SET checksum = checksum + 1 WHERE first_sequence = 3",
      "UPDATE batches SET first_sequence = 2 WHERE first_sequence = 3",
      "UPDATE batches SET payload = (SELECT payload FROM batches WHERE "
      "first_sequence = 1), checksum = (SELECT checksum FROM batches WHERE "
      "first_sequence = 1) WHERE first_sequence = 3",
      "DELETE FROM batches WHERE first_sequence = 3",
      "DELETE FROM batches WHERE first_sequence = 1",
      "UPDATE revised_batches SET payload = 'GAMMa'",
      "UPDATE revised_batches SET count = 1",
      "UPDATE revised_batches SET revision = 9",
  };
  for (const std::string& damage : damages) {
    SCOPED_TRACE(damage);
    RemoveStore();
    const VehicleKey key = MakeStore();
    RunSql(Path(), damage);
    const std::unique_ptr<Storage> storage = MustOpen(Path());
    EXPECT_THAT(
        ReadAll(*storage, key, 1, 6),
        IsError(StatusCode::kDataLoss, "STORE_CORRUPT", HasSubstr("'truck'")));
  }
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

TEST_F(SqliteStorageTest, FindsDamageOfVehicle) {
  for (const char* damage :
       {"UPDATE vehicles SET payload = 'Payload'",
        "UPDATE vehicles SET revision = 5", "UPDATE vehicles SET format = 9",
        "UPDATE vehicles SET key = 2",
        // The last batch says how far the vehicle goes.
        "UPDATE batches SET count = 3 WHERE first_sequence = 5",
        "UPDATE batches SET revision = 3 WHERE first_sequence = 5"}) {
    SCOPED_TRACE(damage);
    RemoveStore();
    MakeStore();
    RunSql(Path(), damage);
    const std::unique_ptr<Storage> storage = MustOpen(Path());
    const auto corrupt = IsError(StatusCode::kDataLoss, "STORE_CORRUPT",
                                 HasSubstr("vehicle 'truck'"));
    // It is told of this one alone, and it can be deleted and made again.
    const VehicleKey sound = *BlockingWrites(storage.get()).Create("sound");
    const absl::StatusOr<VehicleRecord> record = storage->GetVehicle("truck");
    ASSERT_THAT(record, IsOk());
    EXPECT_THAT(record->damage, corrupt);
    const auto listed = storage->ListVehicles("", "", 10);
    ASSERT_THAT(listed, IsOk());
    ASSERT_EQ(listed->size(), 2u);
    EXPECT_EQ((*listed)[0].key, sound);
    EXPECT_THAT((*listed)[0].damage, IsOk());
    EXPECT_THAT((*listed)[1].damage, corrupt);
    BlockingWrites write(storage.get());
    EXPECT_THAT(write.Delete(record->key), IsOk());
    const absl::StatusOr<VehicleKey> again = write.Create("truck");
    ASSERT_THAT(again, IsOk());
    EXPECT_THAT(storage->GetVehicle("truck")->damage, IsOk());
    EXPECT_THAT(write.Append(*again, {1, 1, 2, "a"}), IsOk());
  }
}

TEST_F(SqliteStorageTest, GivesUpWhatIsDamaged) {
  for (const char* damage :
       {"UPDATE batches SET payload = 'x' WHERE first_sequence = 5",
        "UPDATE batches SET revision = 99 WHERE first_sequence = 3",
        // The revision is sound, what it revises is not.
        "UPDATE revised_batches SET payload = 'x'",
        "DELETE FROM batches WHERE first_sequence = 3"}) {
    SCOPED_TRACE(damage);
    RemoveStore();
    const VehicleKey key = MakeStore();
    RunSql(Path(), damage);
    const std::unique_ptr<Storage> storage = MustOpen(Path());
    BlockingWrites write(storage.get());
    std::uint64_t sound = 0;
    EXPECT_THAT(storage->ReadBatches(key, 1, 6, BatchVersion::kCurrent,
                                     [&](const BatchRecord& batch) {
                                       sound = batch.first_sequence +
                                               batch.count - 1;
                                       return true;
                                     }),
                IsError(StatusCode::kDataLoss, "STORE_CORRUPT", _));
    ASSERT_LT(sound, 6u);
    EXPECT_THAT(write.DropDamaged(key, sound, "new", 30), IsOk());
    const VehicleRecord record = *storage->GetVehicle("truck");
    EXPECT_THAT(record.damage, IsOk());
    EXPECT_EQ(record.durable_sequence, sound);
    EXPECT_EQ(record.revision, 30u);
    EXPECT_THAT(ReadAll(*storage, key, 1, sound), IsOk());
    EXPECT_THAT(write.Append(key, {sound + 1, 1, 31, "a"}), IsOk());
  }
  // A damaged pair goes alone.
  RemoveStore();
  const VehicleKey key = MakeStore();
  RunSql(Path(), "UPDATE loop_closures SET create_time_ns = 98");
  const std::unique_ptr<Storage> storage = MustOpen(Path());
  EXPECT_THAT(BlockingWrites(storage.get()).DropDamaged(key, 6, "new", 30),
              IsOk());
  EXPECT_EQ(storage->GetVehicle("truck")->loop_closure_count, 0);
  EXPECT_EQ(storage->GetVehicle("truck")->rejected_candidate_count, 1);
}

TEST_F(SqliteStorageTest, FindsDamageOfPairs) {
  for (const auto& [kind, table] :
       {std::pair(PairKind::kLoopClosure, "loop_closures"),
        std::pair(PairKind::kRejectedCandidate, "rejected_candidates")}) {
    for (const char* damage :
         {"query_sequence = 5", "matched_sequence = 3", "create_time_ns = 98",
          "id = 'lint'", "format = 1", "payload = 'x'"}) {
      const std::string sql = "UPDATE " + std::string(table) + " SET " + damage;
      SCOPED_TRACE(sql);
      RemoveStore();
      const VehicleKey key = MakeStore();
      RunSql(Path(), sql);
      const std::unique_ptr<Storage> storage = MustOpen(Path());
      const auto pairs = storage->ListPosePairs(key, kind, "", 10);
      ASSERT_THAT(pairs, IsOk());
      ASSERT_EQ(pairs->size(), 1u);
      EXPECT_THAT(
          pairs->front().damage,
          IsError(StatusCode::kDataLoss, "STORE_CORRUPT",
                  AllOf(HasSubstr(WordsOf(kind).noun), HasSubstr("'truck'"))));
    }
  }
}

TEST_F(SqliteStorageTest, FindsPairThatEndedUpInTheTableOfAnotherKind) {
  const VehicleKey key = MakeStore();
  RunSql(Path(), "INSERT INTO rejected_candidates SELECT * FROM loop_closures");
  const std::unique_ptr<Storage> storage = MustOpen(Path());
  const absl::Status status =
      storage->ListPosePairs(key, PairKind::kRejectedCandidate, "", 10)
          ->front()
          .damage;
  EXPECT_THAT(status,
              IsError(StatusCode::kDataLoss, "STORE_CORRUPT",
                      "stored rejected candidate 'link' of vehicle 'truck' "
                      "fails its checksum"));
  EXPECT_EQ(MetadataOf(status, "rejected_candidate"), "link");
}

TEST_F(SqliteStorageTest, DamageOfOneVehicleDoesNotStopTheOthers) {
  const VehicleKey damaged = MakeStore();
  RunSql(Path(), "UPDATE batches SET payload = 'x' WHERE first_sequence = 5");
  const std::unique_ptr<Storage> storage = MustOpen(Path());
  const VehicleKey sound = *BlockingWrites(storage.get()).Create("car");
  const Answer<absl::Status> refused;
  const Answer<absl::Status> written;
  AppendBatch(*storage, damaged, {7, 1, 7, "x"}, std::nullopt,
              refused.Setter());
  AppendBatch(*storage, sound, {1, 1, 2, "x"}, std::nullopt, written.Setter());
  EXPECT_THAT(refused.Get(),
              IsError(StatusCode::kDataLoss, "STORE_CORRUPT", _));
  EXPECT_THAT(written.Get(), IsOk());
}

TEST_F(SqliteStorageTest, FindsDamageInTheFileItself) {
  {
    const std::unique_ptr<Storage> storage = MustOpen(Path());
    BlockingWrites write(storage.get());
    const VehicleKey key = *write.Create("truck");
    for (std::uint64_t i = 1; i <= 20; ++i) {
      ASSERT_THAT(write.Append(key, {i, 1, i + 1, std::string(9000, 'x')}),
                  IsOk());
    }
  }
  // Some byte of a payload, wherever it lies.
  std::string bytes;
  {
    std::ifstream in(Path(), std::ios::binary);
    std::stringstream all;
    all << in.rdbuf();
    bytes = all.str();
  }
  const std::size_t place = bytes.find(std::string(3000, 'x'));
  ASSERT_NE(place, std::string::npos);
  bytes[place + 1500] ^= 1;
  std::ofstream(Path(), std::ios::binary) << bytes;
  const std::unique_ptr<Storage> storage = MustOpen(Path());
  EXPECT_THAT(ReadAll(*storage, 1, 1, 20),
              IsError(StatusCode::kDataLoss, "STORE_CORRUPT",
                      HasSubstr("fails its checksum")));
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

class FailingDeviceTest : public SqliteStorageTest {
 protected:
  FailingDeviceTest() {
    options_.vfs = FailingDevice::vfs();
    storage_ = MustOpen(Path(), options_);
    key_ = *write().Create("truck");
    EXPECT_THAT(write().Append(key_, {1, 1, 2, "one"}), IsOk());
  }

  BlockingWrites write() { return BlockingWrites(storage_.get()); }
  // With the options as they are now. SQLite flushes the head of a new log by
  // itself: what is written here keeps that from being the flush that is held.
  void OpenAnew() {
    storage_.reset();
    storage_ = MustOpen(Path(), options_);
    EXPECT_THAT(write().Create("spare"), IsOk());
    opened_ = storage_->Counts();
  }
  // Since then.
  std::uint64_t commits() {
    return storage_->Counts().commits - opened_.commits;
  }
  std::uint64_t writes() { return storage_->Counts().writes - opened_.writes; }
  std::vector<std::string> Stored() {
    const absl::StatusOr<VehicleRecord> record = storage_->GetVehicle("truck");
    EXPECT_THAT(record, IsOk());
    std::vector<std::string> payloads;
    const absl::StatusOr<std::vector<BatchRecord>> batches =
        ReadAll(*storage_, key_, 1, record->durable_sequence);
    EXPECT_THAT(batches, IsOk());
    for (const BatchRecord& batch : *batches) {
      payloads.push_back(batch.payload);
    }
    return payloads;
  }

  FailingDevice device_;
  SqliteOptions options_;
  std::unique_ptr<Storage> storage_;
  CommitCounts opened_;
  VehicleKey key_ = 0;
};

const auto kFlushFailed = IsError(StatusCode::kUnavailable, "STORE_SYNC_FAILED",
                                  HasSubstr("takes no more writes"));
const auto kFull = IsError(StatusCode::kResourceExhausted, "STORAGE_FULL",
                           HasSubstr("nothing was written"));

TEST_F(FailingDeviceTest, AcknowledgesNothingBeforeTheFlushReturned) {
  device_.HoldLogFlush();
  const Answer<absl::Status> answer;
  AppendBatch(*storage_, key_, {2, 1, 3, "two"}, std::nullopt, answer.Setter());
  device_.AwaitHeldLogFlush();
  EXPECT_FALSE(answer.IsSet());
  EXPECT_THAT(Stored(), ElementsAre("one"));
  device_.LetLogFlushGo();
  EXPECT_THAT(answer.Get(), IsOk());
  EXPECT_THAT(Stored(), ElementsAre("one", "two"));
}

TEST_F(FailingDeviceTest, FlushesOnceForAllThatWaited) {
  device_.HoldLogFlush();
  std::vector<Answer<absl::Status>> answers(101);
  for (std::uint64_t i = 0; i < answers.size(); ++i) {
    AppendBatch(*storage_, key_, {i + 2, 1, i + 3, "x"}, std::nullopt,
                answers[i].Setter());
    if (i == 0) device_.AwaitHeldLogFlush();
  }
  const int before = device_.log_flushes();
  device_.LetLogFlushGo();
  for (const Answer<absl::Status>& answer : answers) {
    EXPECT_THAT(answer.Get(), IsOk());
  }
  // The one that was held, and one for the hundred behind it.
  EXPECT_EQ(device_.log_flushes() - before, 2);
}

TEST_F(FailingDeviceTest, BatchesThatWaitedTogetherShareARow) {
  storage_.reset();
  options_.max_joined_poses = 5;
  options_.max_joined_bytes = 100;
  storage_ = MustOpen(Path(), options_);
  const VehicleKey other = *write().Create("car");
  device_.HoldLogFlush();
  std::vector<int> order;
  std::vector<Answer<absl::Status>> answers(8);
  const auto append = [&](int number, VehicleKey key, BatchRecord batch) {
    AppendBatch(
        *storage_, key, std::move(batch), std::nullopt,
        [&order, number, answer = answers[static_cast<std::size_t>(number)]](
            absl::Status status) {
          order.push_back(number);
          answer.Set(std::move(status));
        });
  };
  append(0, key_, {2, 1, 3, "held;"});
  device_.AwaitHeldLogFlush();
  append(1, key_, {3, 2, 4, "b;"});
  append(2, other, {1, 1, 2, "car;"});
  append(3, key_, {5, 3, 5, "c;"});
  // A sixth pose has no room.
  append(4, key_, {8, 1, 6, "d;"});
  // Nor have as many bytes.
  append(5, key_, {9, 1, 7, std::string(99, 'e')});
  // One that does not follow is refused alone.
  append(6, key_, {11, 1, 8, "gap"});
  append(7, key_, {10, 1, 8, "f;"});
  device_.LetLogFlushGo();
  for (std::size_t i = 0; i < answers.size(); ++i) {
    if (i == 6) {
      EXPECT_THAT(answers[i].Get(),
                  IsError(StatusCode::kFailedPrecondition, "SEQUENCE_GAP", _));
    } else {
      EXPECT_THAT(answers[i].Get(), IsOk()) << i;
    }
  }
  // Each vehicle's answers come in order.
  order.erase(std::find(order.begin(), order.end(), 2));
  EXPECT_TRUE(std::is_sorted(order.begin(), order.end()));
  EXPECT_THAT(ToTexts(*ReadAll(*storage_, key_, 1, 10)),
              ElementsAre("1+1, revision 2, 'one'", "2+1, revision 3, 'held;'",
                          "3+5, revision 5, 'b;c;'", "8+1, revision 6, 'd;'",
                          "9+1, revision 7, '" + std::string(99, 'e') + "'",
                          "10+1, revision 8, 'f;'"));
  EXPECT_EQ(storage_->GetVehicle("truck")->revision, 8u);
}

TEST_F(FailingDeviceTest, BatchesDoNotJoinARowPastAnotherWrite) {
  storage_.reset();
  options_.max_joined_poses = 100;
  storage_ = MustOpen(Path(), options_);
  device_.HoldLogFlush();
  std::vector<Answer<absl::Status>> answers(4);
  AppendBatch(*storage_, key_, {2, 1, 3, "a"}, std::nullopt,
              answers[0].Setter());
  device_.AwaitHeldLogFlush();
  AppendBatch(*storage_, key_, {3, 1, 4, "b"}, std::nullopt,
              answers[1].Setter());
  // The pose of sequence 4 is not there yet: nothing to revise.
  storage_->ReviseBatches(key_, BatchesOf({{4, 1, 0, "C"}}), 5,
                          answers[2].Setter());
  AppendBatch(*storage_, key_, {4, 1, 6, "c"}, std::nullopt,
              answers[3].Setter());
  device_.LetLogFlushGo();
  EXPECT_THAT(answers[0].Get(), IsOk());
  EXPECT_THAT(answers[1].Get(), IsOk());
  EXPECT_EQ(answers[2].Get().code(), StatusCode::kFailedPrecondition);
  EXPECT_THAT(answers[3].Get(), IsOk());
  EXPECT_THAT(Stored(), ElementsAre("one", "a", "b", "c"));
}

TEST_F(FailingDeviceTest, GathersAsManyAsBeforeWithinTheLatencyTarget) {
  storage_.reset();
  options_.latency_target = std::chrono::hours(1);
  storage_ = MustOpen(Path(), options_);
  const auto append = [&](std::uint64_t sequence) {
    const Answer<absl::Status> answer;
    AppendBatch(*storage_, key_, {sequence, 1, sequence + 1, "x"}, std::nullopt,
                answer.Setter());
    return answer;
  };
  // An idle store waits for nothing.
  EXPECT_THAT(append(2).Get(), IsOk());
  EXPECT_THAT(append(3).Get(), IsOk());
  device_.HoldLogFlush();
  std::vector<Answer<absl::Status>> answers = {append(4)};
  device_.AwaitHeldLogFlush();
  for (std::uint64_t i = 5; i <= 7; ++i) answers.push_back(append(i));
  device_.LetLogFlushGo();
  for (const Answer<absl::Status>& answer : answers) {
    EXPECT_THAT(answer.Get(), IsOk());
  }
  // The last commit held three: so does the next.
  const int before = device_.log_flushes();
  answers = {append(8), append(9)};
  EXPECT_EQ(device_.log_flushes(), before);
  EXPECT_FALSE(answers[0].IsSet());
  answers.push_back(append(10));
  for (const Answer<absl::Status>& answer : answers) {
    EXPECT_THAT(answer.Get(), IsOk());
  }
  EXPECT_EQ(device_.log_flushes(), before + 1);
  // What waits when the store is closed is written all the same.
  const Answer<absl::Status> last = append(11);
  EXPECT_FALSE(last.IsSet());
  storage_.reset();
  EXPECT_THAT(last.Get(), IsOk());
  storage_ = MustOpen(Path(), options_);
  EXPECT_EQ(storage_->GetVehicle("truck")->durable_sequence, 11u);
}

TEST_F(FailingDeviceTest, WaitsNoLongerThanTheLatencyTarget) {
  storage_.reset();
  options_.latency_target = std::chrono::milliseconds(20);
  storage_ = MustOpen(Path(), options_);
  device_.HoldLogFlush();
  std::vector<Answer<absl::Status>> answers(4);
  for (std::uint64_t i = 0; i < answers.size(); ++i) {
    AppendBatch(*storage_, key_, {i + 2, 1, i + 3, "x"}, std::nullopt,
                answers[i].Setter());
    if (i == 0) device_.AwaitHeldLogFlush();
  }
  device_.LetLogFlushGo();
  for (const Answer<absl::Status>& answer : answers) {
    EXPECT_THAT(answer.Get(), IsOk());
  }
  // No second and third come.
  EXPECT_THAT(write().Append(key_, {6, 1, 7, "x"}), IsOk());
}

TEST_F(FailingDeviceTest, FailedFlushFailsAllThatShareARow) {
  options_.max_joined_poses = 100;
  OpenAnew();
  device_.HoldLogFlush();
  std::vector<Answer<absl::Status>> answers(10);
  for (std::uint64_t i = 0; i < answers.size(); ++i) {
    AppendBatch(*storage_, key_, {i + 2, 1, i + 3, "x"}, std::nullopt,
                answers[i].Setter());
    if (i == 0) device_.AwaitHeldLogFlush();
  }
  device_.FailFlushes(true);
  device_.LetLogFlushGo();
  for (const Answer<absl::Status>& answer : answers) {
    EXPECT_THAT(answer.Get(), kFlushFailed);
  }
  EXPECT_EQ(writes(), 0u);
  device_.FailFlushes(false);
  EXPECT_THAT(Stored(), ElementsAre("one"));
  // The one that was held got as far as the log, the row behind it did not.
  storage_.reset();
  storage_ = MustOpen(Path(), options_);
  EXPECT_THAT(Stored(), ElementsAre("one", "x"));
  EXPECT_THAT(write().Append(key_, {3, 1, 4, "two"}), IsOk());
  EXPECT_THAT(Stored(), ElementsAre("one", "x", "two"));
}

TEST_F(FailingDeviceTest, FullDiskRefusesAllThatShareARow) {
  options_.max_joined_poses = 100;
  OpenAnew();
  device_.HoldLogFlush();
  std::vector<Answer<absl::Status>> answers(5);
  for (std::uint64_t i = 0; i < answers.size(); ++i) {
    AppendBatch(*storage_, key_, {i + 2, 1, i + 3, "x"}, std::nullopt,
                answers[i].Setter());
    if (i == 0) device_.AwaitHeldLogFlush();
  }
  device_.FailWrites(true);
  device_.LetLogFlushGo();
  EXPECT_THAT(answers[0].Get(), IsOk());
  for (std::size_t i = 1; i < answers.size(); ++i) {
    EXPECT_THAT(answers[i].Get(), kFull) << i;
  }
  device_.FailWrites(false);
  EXPECT_THAT(Stored(), ElementsAre("one", "x"));
  // What was refused comes again, and nothing takes its place.
  EXPECT_THAT(write().Append(key_, {7, 1, 8, "late"}),
              IsError(StatusCode::kFailedPrecondition, "SEQUENCE_GAP", _));
  EXPECT_THAT(write().Append(key_, {3, 1, 4, "two"}), IsOk());
  EXPECT_THAT(Stored(), ElementsAre("one", "x", "two"));
  EXPECT_EQ(commits(), 2u);
  EXPECT_EQ(writes(), 2u);
}

TEST_F(FailingDeviceTest, RowThatOverflowsAFullDiskIsRefusedWhole) {
  options_.max_joined_poses = 1000;
  options_.max_joined_bytes = std::size_t{64} << 20;
  OpenAnew();
  device_.HoldLogFlush();
  std::vector<Answer<absl::Status>> answers(6);
  // More than SQLite's cache holds: the disk is found full while the row is
  // inserted, and SQLite gives up the transaction by itself.
  for (std::uint64_t i = 0; i < answers.size(); ++i) {
    AppendBatch(*storage_, key_,
                {i + 2, 1, i + 3, i == 0 ? "x" : std::string(1 << 20, 'x')},
                std::nullopt, answers[i].Setter());
    if (i == 0) device_.AwaitHeldLogFlush();
  }
  device_.FailWrites(true);
  device_.LetLogFlushGo();
  EXPECT_THAT(answers[0].Get(), IsOk());
  for (std::size_t i = 1; i < answers.size(); ++i) {
    EXPECT_THAT(answers[i].Get(), kFull) << i;
  }
  device_.FailWrites(false);
  EXPECT_THAT(write().Append(key_, {3, 1, 4, "two"}), IsOk());
  storage_.reset();
  storage_ = MustOpen(Path(), options_);
  EXPECT_THAT(Stored(), ElementsAre("one", "x", "two"));
}

TEST_F(FailingDeviceTest, WithLittleRoomRowsAreRefusedAndDeletionsGoOn) {
  const VehicleKey car = *write().Create("car");
  const VehicleKey bus = *write().Create("bus");
  const VehicleKey van = *write().Create("van");
  const SqliteOptions roomy = options_;
  storage_.reset();
  options_.max_joined_poses = 100;
  options_.min_free_bytes = std::int64_t{1} << 50;
  storage_ = MustOpen(Path(), options_);
  // The head of the log is flushed by itself, and is not what is held.
  EXPECT_THAT(write().Delete(van), IsOk());
  device_.HoldLogFlush();
  const Answer<absl::Status> held;
  storage_->DeleteVehicle(car, held.Setter());
  device_.AwaitHeldLogFlush();
  // One group: a row of two, another write, a row of one.
  std::vector<Answer<absl::Status>> answers(4);
  AppendBatch(*storage_, key_, {2, 1, 3, "a"}, std::nullopt,
              answers[0].Setter());
  AppendBatch(*storage_, key_, {3, 1, 4, "b"}, std::nullopt,
              answers[1].Setter());
  AppendBatch(*storage_, key_, {4, 1, 5, "c"}, "changed", answers[2].Setter());
  const Answer<absl::Status> deleted;
  storage_->DeleteVehicle(bus, deleted.Setter());
  AppendBatch(*storage_, key_, {5, 1, 6, "d"}, std::nullopt,
              answers[3].Setter());
  device_.LetLogFlushGo();
  EXPECT_THAT(held.Get(), IsOk());
  EXPECT_THAT(deleted.Get(), IsOk());
  for (const Answer<absl::Status>& answer : answers) {
    EXPECT_THAT(answer.Get(), kFull);
  }
  EXPECT_THAT(Stored(), ElementsAre("one"));
  EXPECT_EQ(storage_->Counts().commits, 3u);
  EXPECT_EQ(storage_->Counts().writes, 3u);
  storage_.reset();
  storage_ = MustOpen(Path(), roomy);
  EXPECT_THAT(storage_->GetVehicle("bus"),
              IsError(StatusCode::kNotFound, "VEHICLE_NOT_FOUND", _));
  EXPECT_EQ(storage_->GetVehicle("truck")->payload, "payload");
  EXPECT_THAT(write().Append(key_, {2, 1, 3, "two"}), IsOk());
  EXPECT_THAT(Stored(), ElementsAre("one", "two"));
}

TEST_F(FailingDeviceTest, TimesTransactionsAndTheFlushesInThem) {
  const auto sum_of = [](const HistogramCounts& counts) {
    return std::accumulate(counts.counts.begin(), counts.counts.end(),
                           std::uint64_t{0});
  };
  const CommitCounts before = storage_->Counts();
  device_.HoldLogFlush();
  Answer<absl::Status> held;
  AppendBatch(*storage_, key_, {2, 1, 3, "two"}, std::nullopt, held.Setter());
  device_.AwaitHeldLogFlush();
  std::this_thread::sleep_for(std::chrono::milliseconds(20));
  device_.LetLogFlushGo();
  EXPECT_THAT(held.Get(), IsOk());
  // A write that was refused is no transaction that was committed.
  EXPECT_THAT(write().Append(key_, {9, 1, 4, "nine"}),
              IsError(StatusCode::kFailedPrecondition, "SEQUENCE_GAP", _));
  const CommitCounts after = storage_->Counts();
  EXPECT_EQ(after.commits - before.commits, 1u);
  EXPECT_EQ(sum_of(after.flush_seconds) - sum_of(before.flush_seconds), 1u);
  EXPECT_GE(after.flush_seconds.sum - before.flush_seconds.sum, 0.02);
  EXPECT_GE(after.commit_seconds.sum - before.commit_seconds.sum,
            after.flush_seconds.sum - before.flush_seconds.sum);
}

TEST_F(FailingDeviceTest, TellsTheRoomThatItTakesAndHas) {
  const std::optional<StorageRoom> before = storage_->GetRoom();
  ASSERT_TRUE(before);
  EXPECT_GT(before->bytes, 0);
  EXPECT_GT(before->free_bytes, 0);
  EXPECT_THAT(write().Append(key_, {2, 1, 3, std::string(100'000, 'x')}),
              IsOk());
  EXPECT_GE(storage_->GetRoom()->bytes, before->bytes + 100'000);
}

TEST_F(FailingDeviceTest, FailedFlushFailsAllOfTheGroupAndKeepsNothing) {
  device_.HoldLogFlush();
  std::vector<Answer<absl::Status>> answers(4);
  AppendBatch(*storage_, key_, {2, 1, 3, "two"}, std::nullopt,
              answers[0].Setter());
  device_.AwaitHeldLogFlush();
  // These form the next group.
  const Answer<absl::StatusOr<VehicleKey>> created;
  storage_->CreateVehicle({0, "car", "", 1, 0, 0, 0}, created.Setter());
  AppendBatch(*storage_, key_, {3, 1, 4, "three"}, std::nullopt,
              answers[1].Setter());
  device_.FailFlushes(true);
  device_.LetLogFlushGo();
  EXPECT_THAT(answers[0].Get(), kFlushFailed);
  EXPECT_THAT(created.Get(), kFlushFailed);
  EXPECT_THAT(answers[1].Get(), kFlushFailed);
  EXPECT_THAT(Stored(), ElementsAre("one"));
  EXPECT_FALSE(storage_->GetVehicle("car").ok());

  // Opened anew, it goes on from some prefix that holds what was acknowledged:
  // here the first of those that were not, too, for it got as far as the log.
  device_.FailFlushes(false);
  storage_.reset();
  storage_ = MustOpen(Path(), options_);
  EXPECT_THAT(Stored(), ElementsAre("one", "two"));
  EXPECT_THAT(write().Append(key_, {4, 1, 4, "four"}),
              IsError(StatusCode::kFailedPrecondition, "SEQUENCE_GAP", _));
  EXPECT_THAT(write().Append(key_, {3, 1, 4, "three"}), IsOk());
}

TEST_F(FailingDeviceTest, TakesNothingOnAfterAFailedFlushUntilOpenedAnew) {
  int told = 0;
  options_.on_failure = [&](const absl::Status& status) {
    EXPECT_THAT(status, kFlushFailed);
    ++told;
  };
  storage_.reset();
  storage_ = MustOpen(Path(), options_);
  device_.FailFlushes(true);
  EXPECT_THAT(write().Append(key_, {2, 1, 3, "two"}), kFlushFailed);
  // Even if the device works again: what the system's memory shows of the log
  // may not be on it.
  device_.FailFlushes(false);
  for (int i = 0; i < 3; ++i) {
    EXPECT_THAT(write().Append(key_, {2, 1, 3, "two"}), kFlushFailed);
    EXPECT_THAT(Stored(), ElementsAre("one"));
  }
  storage_.reset();
  EXPECT_EQ(told, 1);
  storage_ = MustOpen(Path(), options_);
  EXPECT_THAT(Stored(), ElementsAre("one"));
  EXPECT_THAT(write().Append(key_, {2, 1, 3, "two"}), IsOk());
}

TEST_F(FailingDeviceTest, OpensNoStoreWhoseLogCannotBeFlushed) {
  // A killed server leaves a log of which nobody knows whether it was flushed.
  const std::string crashed = directory_.File("crashed.db");
  std::filesystem::copy_file(Path(), crashed);
  std::filesystem::copy_file(Path() + "-wal", crashed + "-wal");
  device_.FailFlushes(true);
  EXPECT_THAT(OpenSqliteStorage(crashed, options_),
              IsError(StatusCode::kUnavailable, "STORE_SYNC_FAILED",
                      HasSubstr("copying the log")));
  device_.FailFlushes(false);
  EXPECT_THAT((*OpenSqliteStorage(crashed, options_))
                  ->GetVehicle("truck")
                  ->durable_sequence,
              1u);
}

TEST_F(FailingDeviceTest, FullDiskFailsWritesAndNotReads) {
  device_.FailWrites(true);
  EXPECT_THAT(write().Append(key_, {2, 1, 3, std::string(50000, 'x')}), kFull);
  EXPECT_THAT(write().Update(key_, "new", 3), kFull);
  EXPECT_THAT(Stored(), ElementsAre("one"));
  device_.FailWrites(false);
  EXPECT_THAT(write().Append(key_, {2, 1, 3, "two"}), IsOk());
  EXPECT_THAT(Stored(), ElementsAre("one", "two"));
}

TEST_F(FailingDeviceTest, KeepsPrefixWhereverTheDeviceFails) {
  // Fails and works again at random moments, while appends stream in.
  std::mt19937_64 random = SeededRandom();
  std::uint64_t acknowledged = 1;
  std::uint64_t revision = 2;
  for (int round = 0; round < 60; ++round) {
    // Works, from where it was.
    ASSERT_THAT(write().Append(key_, {acknowledged + 1, 1, ++revision, "x"}),
                IsOk());
    ++acknowledged;
    const bool flushes = UniformInt(random, 0, 1) == 0;
    std::vector<Answer<absl::Status>> answers(20);
    const auto fails = static_cast<std::size_t>(UniformInt(random, 0, 19));
    for (std::size_t i = 0; i < answers.size(); ++i) {
      if (i == fails) {
        if (flushes) {
          device_.FailFlushes(true);
        } else {
          device_.FailWrites(true);
        }
      }
      AppendBatch(*storage_, key_, {acknowledged + 1 + i, 1, ++revision, "x"},
                  std::nullopt, answers[i].Setter());
    }
    bool failed = false;
    std::uint64_t landed = 0;
    for (const Answer<absl::Status>& answer : answers) {
      const absl::Status status = answer.Get();
      if (status.ok()) {
        EXPECT_FALSE(failed) << "written behind one that was not";
        ++landed;
      } else {
        failed = true;
        EXPECT_THAT(status.code(),
                    ::testing::AnyOf(StatusCode::kUnavailable,
                                     StatusCode::kResourceExhausted,
                                     StatusCode::kFailedPrecondition));
      }
    }
    device_.FailFlushes(false);
    device_.FailWrites(false);
    acknowledged += landed;
    ASSERT_EQ(storage_->GetVehicle("truck")->durable_sequence, acknowledged);
    if (!flushes) continue;
    storage_.reset();
    storage_ = MustOpen(Path(), options_);
    // The group whose flush failed may have got as far as the log.
    const std::uint64_t stored =
        storage_->GetVehicle("truck")->durable_sequence;
    ASSERT_GE(stored, acknowledged);
    ASSERT_LE(stored, acknowledged - landed + answers.size());
    acknowledged = stored;
  }
  storage_.reset();
  storage_ = MustOpen(Path(), options_);
  EXPECT_EQ(storage_->GetVehicle("truck")->durable_sequence, acknowledged);
  EXPECT_THAT(ReadAll(*storage_, key_, 1, acknowledged), IsOk());
}

}  // namespace
}  // namespace revisit::server
