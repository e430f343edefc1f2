#include "server/storage/store_copy.h"

#include <filesystem>
#include <memory>
#include <optional>
#include <random>
#include <string>
#include <vector>

#include "gmock/gmock.h"
#include "gtest/gtest.h"
#include "server/storage/postgres/postgres_check.h"
#include "server/storage/postgres/postgres_intake.h"
#include "server/storage/postgres/postgres_reader.h"
#include "server/storage/postgres/postgres_storage.h"
#include "server/storage/sqlite/sqlite_storage.h"
#include "server/storage/sqlite/store_check.h"
#include "server/storage/sqlite/store_intake.h"
#include "tests/random.h"
#include "tests/server/error_matchers.h"
#include "tests/server/storage/postgres/postgres_server.h"
#include "tests/server/storage_testing.h"
#include "tests/server/temporary_directory.h"

namespace revisit::server {
namespace {

using absl::StatusCode;
using ::testing::_;
using ::testing::HasSubstr;
using ::testing::IsEmpty;

// All records of a store, keys too.
std::vector<std::string> Everything(Storage& storage) {
  std::vector<std::string> texts;
  const auto vehicles = storage.ListVehicles("", "", 1000);
  EXPECT_THAT(vehicles, IsOk());
  for (const VehicleRecord& vehicle : *vehicles) {
    EXPECT_THAT(vehicle.damage, IsOk());
    texts.push_back(ToText(vehicle));
    if (vehicle.durable_sequence > 0) {
      for (const BatchVersion version :
           {BatchVersion::kAsSent, BatchVersion::kCurrent}) {
        const auto batches =
            ReadAll(storage, vehicle.key, 1, vehicle.durable_sequence, version);
        EXPECT_THAT(batches, IsOk());
        for (const std::string& text : ToTexts(*batches)) texts.push_back(text);
      }
    }
    for (const PairKind kind : kPairKinds) {
      const auto pairs = storage.ListPosePairs(vehicle.key, kind, "", 100'000);
      for (const std::string& text : ToTexts(*pairs)) texts.push_back(text);
    }
    const auto deleted = storage.ListDeletedPairs(vehicle.key);
    for (const std::string& text : ToTexts(*deleted)) texts.push_back(text);
    const auto checks =
        storage.ListChecks(vehicle.key, 0, kLastSequence, false, 100'000);
    for (const std::string& text : ToTexts(*checks)) texts.push_back(text);
    const auto links = storage.Groups().ListLinksOf(vehicle.key, {}, 100'000);
    for (const std::string& text : ToTexts(*links)) texts.push_back(text);
  }
  const auto groups = storage.Groups().ListGroups("", "", 1000);
  for (const GroupRecord& group : *groups) {
    texts.push_back(ToText(group));
    const auto members = storage.Groups().ListMembers(group.id, "", 1000);
    for (const std::string& text : ToTexts(*members)) texts.push_back(text);
  }
  return texts;
}

class StoreCopyTest : public ::testing::Test {
 protected:
  void SetUp() override {
    if (PostgresServer::Shared() == nullptr) {
      GTEST_SKIP() << "PostgreSQL's server programs are not installed";
    }
  }

  std::string Path(const std::string& name) const {
    return directory_.File(name);
  }

  // A file with vehicles of some hundred batches, gaps among their keys,
  // revisions and pairs.
  std::unique_ptr<Storage> MakeSource() {
    std::mt19937_64 random = SeededRandom();
    auto storage = *OpenSqliteStorage(Path("source.db"));
    BlockingWrites write(storage.get());
    for (const char* id : {"c", "deleted", "a", "b", "empty"}) {
      const VehicleKey key = *write.Create(id, id, 3);
      if (std::string(id) == "deleted") {
        EXPECT_THAT(write.Delete(key), IsOk());
      }
      if (std::string(id).size() > 1) continue;
      std::uint64_t next = 1;
      std::vector<BatchRecord> batches;
      for (std::uint64_t i = 0; i < 400; ++i) {
        batches.push_back(
            {next, static_cast<std::uint32_t>(UniformInt(random, 1, 5)), i + 4,
             std::string(static_cast<std::size_t>(UniformInt(random, 0, 300)),
                         static_cast<char>(UniformInt(random, 0, 255)))});
        next += batches.back().count;
        AppendBatch(
            *storage, key, batches.back(), std::nullopt,
            [](const absl::Status& status) { EXPECT_THAT(status, IsOk()); });
      }
      for (std::uint64_t i = 0; i < 20; ++i) {
        BatchRecord revised = batches[i * 19];
        revised.payload += "revised";
        EXPECT_THAT(write.Revise(key, {revised}, 500 + i), IsOk());
      }
      for (const PairKind kind : kPairKinds) {
        for (std::uint64_t i = 0; i < 30; ++i) {
          EXPECT_THAT(write.AddPair(key, kind,
                                    {"p" + std::to_string(i), i + 2, 1, 7,
                                     i % 2 == 0 ? "" : "payload"},
                                    600 + i),
                      IsOk());
        }
        for (std::uint64_t i = 27; i < 30; ++i) {
          DeletedPairRecord deleted;
          deleted.kind = kind;
          deleted.pair = {"p" + std::to_string(i), i + 2, 1, 7, "payload"};
          deleted.delete_time_ns = 8;
          EXPECT_THAT(write.DeletePair(key, deleted, 700 + i), IsOk());
        }
      }
      ChecksWrite checks;
      checks.after = {*id != 'b', 350, 2};
      for (std::uint64_t i = 1; i <= 300; ++i) {
        checks.checks.push_back({i, 500, static_cast<std::uint32_t>(i % 3), 9,
                                 std::string(i % 7, 'c')});
      }
      checks.events.resize(2);
      for (EventRecord& event : checks.events) event.payload = "event";
      EXPECT_THAT(write.PutChecks(key, checks), IsOk());
    }
    FillGroups(storage.get());
    return storage;
  }

  // Two groups with two members each, and some hundred links.
  static void FillGroups(Storage* storage) {
    BlockingGroupWrites write(storage);
    const VehicleKey a = storage->GetVehicle("a")->key;
    const VehicleKey b = storage->GetVehicle("b")->key;
    for (const char* id : {"one", "two"}) {
      EXPECT_THAT(write.Create(id, id, std::string("of ") + id), IsOk());
      std::vector<GroupChange> changes = {AddGroupMember{{a, "datum"}},
                                          AddGroupMember{{b, ""}}};
      for (std::uint64_t i = 0; i < 600; ++i) {
        changes.emplace_back(AddGroupLink{{"l" + std::to_string(i),
                                           static_cast<LinkState>(1 + i % 4),
                                           {a, i + 1},
                                           {b, i + 2},
                                           i % 2 == 0 ? "" : "payload"}});
      }
      EXPECT_THAT(write.Change(id, changes), IsOk());
    }
  }

  const TemporaryDirectory directory_;
};

TEST_F(StoreCopyTest, CopiesAFileIntoADatabaseAndBackWithAllKeys) {
  const auto source = MakeSource();
  const std::vector<std::string> all = Everything(*source);
  const std::string conninfo = PostgresServer::Shared()->MakeStore();
  {
    const auto intake = FillDatabase(conninfo);
    ASSERT_THAT(intake, IsOk());
    const auto copied = CopyStore(*source, intake->get());
    ASSERT_THAT(copied, IsOk());
    EXPECT_EQ(copied->vehicles, 4);
    EXPECT_EQ(copied->batches, 1200);
    EXPECT_EQ(copied->revised_batches, 60);
    EXPECT_EQ(copied->loop_closures, 81);
    EXPECT_EQ(copied->deleted_pairs, 18);
    EXPECT_EQ(copied->checks, 900);
    EXPECT_EQ(copied->groups, 2);
    EXPECT_EQ(copied->members, 4);
    EXPECT_EQ(copied->links, 1200);
    const auto found = CheckDatabase(conninfo);
    ASSERT_THAT(found, IsOk());
    EXPECT_THAT(found->problems, IsEmpty());
    EXPECT_TRUE(HoldTheSame(*copied, *found));
  }
  const auto database = OpenPostgresStorageToRead(conninfo);
  ASSERT_THAT(database, IsOk());
  EXPECT_EQ(Everything(**database), all);
  {
    const auto intake = FillFile(Path("back.db"));
    ASSERT_THAT(intake, IsOk());
    ASSERT_THAT(CopyStore(**database, intake->get()), IsOk());
  }
  const auto report = CheckStore(Path("back.db"), StoreUse::kIdle);
  ASSERT_THAT(report, IsOk());
  EXPECT_THAT(report->problems, IsEmpty());
  const auto back = OpenSqliteStorage(Path("back.db"));
  ASSERT_THAT(back, IsOk());
  EXPECT_EQ(Everything(**back), all);
}

TEST_F(StoreCopyTest, GoesOnWhereTheCopiedStoreEnded) {
  const auto source = MakeSource();
  const std::string conninfo = PostgresServer::Shared()->MakeStore();
  {
    const auto intake = FillDatabase(conninfo);
    ASSERT_THAT(CopyStore(*source, intake->get()), IsOk());
  }
  const auto opened = OpenPostgresStorage(conninfo, {});
  ASSERT_THAT(opened, IsOk());
  BlockingWrites write(opened->get());
  const auto vehicle = (*opened)->TakeVehicle("a");
  ASSERT_THAT(vehicle, IsOk());
  const std::uint64_t next = vehicle->durable_sequence + 1;
  EXPECT_THAT(write.Append(vehicle->key, {next, 1, 900, "x"}), IsOk());
  ChecksWrite checks;
  checks.before = vehicle->checks;
  checks.after = {true, 400, 3};
  checks.events.resize(1);
  checks.events[0].payload = "third";
  EXPECT_THAT(write.PutChecks(vehicle->key, checks), IsOk());
  const auto created = write.Create("new");
  ASSERT_THAT(created, IsOk());
  EXPECT_GT(*created, (*opened)->GetVehicle("empty")->key);
}

TEST_F(StoreCopyTest, TakesNothingIntoAStoreThatIsNotEmpty) {
  const std::string conninfo = PostgresServer::Shared()->MakeStore();
  {
    const auto opened = OpenPostgresStorage(conninfo, {});
    ASSERT_THAT(BlockingWrites(opened->get()).Create("truck"), IsOk());
  }
  EXPECT_THAT(FillDatabase(conninfo), IsError(StatusCode::kFailedPrecondition,
                                              _, HasSubstr("is not empty")));
  MakeSource();
  EXPECT_THAT(FillFile(Path("source.db")),
              IsError(StatusCode::kFailedPrecondition, _,
                      HasSubstr("there is a store at")));
}

TEST_F(StoreCopyTest, TakesNothingIntoTablesThatHaveNoRoomForGroups) {
  const std::string conninfo = PostgresServer::Shared()->MakeStore();
  PostgresServer::Shared()->Run(
      conninfo,
      "DROP TABLE vehicle_groups; UPDATE schema_version SET version = 6");
  EXPECT_THAT(FillDatabase(conninfo),
              IsError(StatusCode::kFailedPrecondition, _,
                      HasSubstr("revisitd migrate")));
}

TEST_F(StoreCopyTest, LeavesNothingWhereItWasNotFinished) {
  const std::string conninfo = PostgresServer::Shared()->MakeStore();
  VehicleRecord vehicle;
  vehicle.key = 7;
  vehicle.id = "truck";
  {
    const auto database = FillDatabase(conninfo);
    ASSERT_THAT(database, IsOk());
    EXPECT_THAT((*database)->AddVehicle(vehicle), IsOk());
    const auto file = FillFile(Path("unfinished.db"));
    ASSERT_THAT(file, IsOk());
    EXPECT_THAT((*file)->AddVehicle(vehicle), IsOk());
  }
  EXPECT_EQ(
      PostgresServer::Shared()->Run(conninfo, "SELECT count(*) FROM vehicles"),
      "0\n");
  EXPECT_TRUE(std::filesystem::is_empty(Path("")));
}

TEST_F(StoreCopyTest, RefusesToCopyDamage) {
  const std::string conninfo = PostgresServer::Shared()->MakeStore();
  {
    const auto opened = OpenPostgresStorage(conninfo, {});
    BlockingWrites write(opened->get());
    const VehicleKey key = *write.Create("truck");
    ASSERT_THAT(write.Append(key, {1, 1, 2, "a"}), IsOk());
    ASSERT_THAT(write.Append(key, {2, 1, 3, "b"}), IsOk());
  }
  PostgresServer::Shared()->Run(
      conninfo, "UPDATE batches SET payload = 'x' WHERE first_sequence = 1");
  const auto source = OpenPostgresStorageToRead(conninfo);
  const auto intake = FillFile(Path("copy.db"));
  ASSERT_THAT(intake, IsOk());
  EXPECT_THAT(CopyStore(**source, intake->get()),
              IsError(StatusCode::kDataLoss, "STORE_CORRUPT", _));
}

TEST_F(StoreCopyTest, RefusesToCopyADamagedRowOfAGroup) {
  for (const char* table : {"vehicle_groups", "group_members", "group_links"}) {
    SCOPED_TRACE(table);
    const std::string conninfo = PostgresServer::Shared()->MakeStore();
    {
      const auto opened = OpenPostgresStorage(conninfo, {});
      ASSERT_THAT(BlockingWrites(opened->get()).Create("a"), IsOk());
      ASSERT_THAT(BlockingWrites(opened->get()).Create("b"), IsOk());
      FillGroups(opened->get());
    }
    PostgresServer::Shared()->Run(
        conninfo, std::string("UPDATE ") + table + " SET checksum = 7");
    const auto source = OpenPostgresStorageToRead(conninfo);
    const auto intake = FillFile(Path(std::string(table) + ".db"));
    ASSERT_THAT(intake, IsOk());
    EXPECT_THAT(CopyStore(**source, intake->get()),
                IsError(StatusCode::kDataLoss, "STORE_CORRUPT", _));
  }
}

}  // namespace
}  // namespace revisit::server
