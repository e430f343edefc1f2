#include "server/storage/postgres/postgres_storage.h"

#include <atomic>
#include <chrono>
#include <memory>
#include <optional>
#include <random>
#include <string>
#include <thread>
#include <vector>

#include "gmock/gmock.h"
#include "gtest/gtest.h"
#include "server/storage/postgres/connection_pool.h"
#include "server/storage/postgres/migrations.h"
#include "server/storage/postgres/postgres_appends.h"
#include "server/storage/postgres/postgres_check.h"
#include "server/storage/postgres/postgres_reader.h"
#include "tests/server/error_matchers.h"
#include "tests/server/storage/postgres/postgres_server.h"
#include "tests/server/storage/storage_contract.h"
#include "tests/server/storage_testing.h"
#include "tests/server/waiting.h"

namespace revisit::server {
namespace {

using absl::StatusCode;
using ::testing::_;
using ::testing::AllOf;
using ::testing::ElementsAre;
using ::testing::HasSubstr;
using ::testing::IsEmpty;
using ::testing::Not;

std::unique_ptr<Storage> MustOpen(const std::string& conninfo,
                                  const PostgresOptions& options = {}) {
  absl::StatusOr<std::unique_ptr<Storage>> storage =
      OpenPostgresStorage(conninfo, options);
  EXPECT_THAT(storage, IsOk());
  return storage.ok() ? *std::move(storage) : nullptr;
}

class PostgresStore : public StoreUnderTest {
 public:
  PostgresStore(std::string conninfo, const PostgresOptions& options)
      : conninfo_(std::move(conninfo)),
        options_(options),
        storage_(MustOpen(conninfo_, options_)) {
    PostgresConnection::Options connection;
    connection.conninfo = conninfo_;
    connection_ = *PostgresConnection::Open(connection);
  }

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

  void AwaitEvents() override {
    constexpr Statement kAllAreTold = {
        "all_are_told",
        "SELECT NOT EXISTS (SELECT 1 FROM events WHERE xid >= "
        "pg_snapshot_xmin(pg_current_snapshot()))"};
    EXPECT_TRUE(Eventually(
        [&] { return connection_->Run(kAllAreTold)->Integer(0, 0) != 0; }));
  }

 private:
  const std::string conninfo_;
  const PostgresOptions options_;
  std::unique_ptr<Storage> storage_;
  std::unique_ptr<PostgresConnection> connection_;
};

std::unique_ptr<StoreUnderTest> MakeStore(const PostgresOptions& options) {
  if (PostgresServer::Shared() == nullptr) return nullptr;
  return std::make_unique<PostgresStore>(PostgresServer::Shared()->MakeStore(),
                                         options);
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

// Takes the tables back to the version before the last.
constexpr char kToVersion6[] =
    "DROP TABLE vehicle_groups, group_members, group_links; "
    "DROP FUNCTION leave_groups, cut_links CASCADE; "
    "UPDATE schema_version SET version = 6";

std::unique_ptr<StoreUnderTest> MakeStoreOfVersion6() {
  static_assert(kOldestSchemaVersion == 6);
  if (PostgresServer::Shared() == nullptr) return nullptr;
  const std::string conninfo = PostgresServer::Shared()->MakeStore();
  PostgresServer::Shared()->Run(conninfo, kToVersion6);
  return std::make_unique<PostgresStore>(conninfo, PostgresOptions());
}

std::vector<StoreFactory> Factories() {
  return {{"WithDefaults", [] { return MakeStore({}); }},
          {"OneWriteAtATime", [] { return MakeStore(OneWriteAtATime()); }},
          {"ManyConnections", [] { return MakeStore(ManyConnections()); }},
          {"WithTheTablesOfBefore", [] { return MakeStoreOfVersion6(); },
           /*keeps_groups=*/false}};
}

INSTANTIATE_TEST_SUITE_P(Postgres, StorageContract,
                         ::testing::ValuesIn(Factories()), NameOf);
INSTANTIATE_TEST_SUITE_P(Postgres, GroupContract,
                         ::testing::ValuesIn(Factories()), NameOf);

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

TEST_F(PostgresStorageTest, RefusesTablesOfANewerVersion) {
  Sql("UPDATE schema_version SET version = version + 1");
  const auto newer = IsError(StatusCode::kFailedPrecondition, _,
                             HasSubstr("newer than this program"));
  EXPECT_THAT(OpenPostgresStorage(conninfo_, {}), newer);
  EXPECT_THAT(OpenPostgresStorageToRead(conninfo_), newer);
  EXPECT_THAT(MigrateDatabase(conninfo_), newer);
  EXPECT_EQ(Sql("SELECT version FROM schema_version"),
            std::to_string(kSchemaVersion + 1) + "\n");
}

TEST_F(PostgresStorageTest, RefusesTablesThatNoReleaseHasMade) {
  Sql("UPDATE schema_version SET version = " +
      std::to_string(kFirstSchemaVersion - 1));
  const auto unknown =
      IsError(StatusCode::kFailedPrecondition, _,
              AllOf(HasSubstr("no release"), HasSubstr("revisitd import")));
  EXPECT_THAT(OpenPostgresStorage(conninfo_, {}), unknown);
  EXPECT_THAT(OpenPostgresStorageToRead(conninfo_), unknown);
  EXPECT_THAT(MigrateDatabase(conninfo_), unknown);
  EXPECT_EQ(Sql("SELECT version FROM schema_version"),
            std::to_string(kFirstSchemaVersion - 1) + "\n");
}

TEST_F(PostgresStorageTest, OfMigrationsAtATimeOneMakesTheTables) {
  const std::string empty = PostgresServer::Shared()->MakeEmptyDatabase();
  std::vector<std::thread> threads;
  std::atomic<int> made{0};
  for (int i = 0; i < 4; ++i) {
    threads.emplace_back([&] {
      const auto report = MigrateDatabase(empty);
      ASSERT_THAT(report, IsOk());
      EXPECT_EQ(report->version_after, kSchemaVersion);
      if (report->version_before == 0) ++made;
    });
  }
  for (std::thread& thread : threads) thread.join();
  EXPECT_EQ(made, 1);
  EXPECT_NE(MustOpen(empty), nullptr);
}

TEST_F(PostgresStorageTest, RefusesTablesOfAVersionLongBefore) {
  Sql(kToVersion6);
  Sql("DROP TABLE checks, events, dropped_events; "
      "DROP FUNCTION set_checks_back, remove_checks CASCADE; "
      "ALTER TABLE heads DROP checks_stored, DROP checked_sequence, "
      "DROP last_event; "
      "DROP TABLE deleted_pose_pairs; UPDATE schema_version SET version = 4");
  const auto older = IsError(
      StatusCode::kFailedPrecondition, _,
      AllOf(HasSubstr("of version 4, older"), HasSubstr("revisitd migrate")));
  EXPECT_THAT(OpenPostgresStorage(conninfo_, {}), older);
  EXPECT_THAT(OpenPostgresStorageToRead(conninfo_), older);
  const auto report = MigrateDatabase(conninfo_);
  ASSERT_THAT(report, IsOk());
  EXPECT_EQ(report->version_before, 4);
  EXPECT_EQ(report->version_after, kSchemaVersion);
  EXPECT_NE(MustOpen(conninfo_), nullptr);
}

// A check at each of some sequences, and an event of each, in one step.
ChecksWrite ChecksAt(const ChecksHead& before, std::uint64_t checked_sequence,
                     const std::vector<std::uint64_t>& sequences) {
  ChecksWrite write;
  write.before = before;
  write.after = {true, checked_sequence, before.last_event + sequences.size()};
  for (const std::uint64_t sequence : sequences) {
    write.checks.push_back({sequence, 1, 1, 5, "check"});
    EventRecord event;
    event.time_ns = 10 * static_cast<std::int64_t>(sequence);
    event.payload = "of " + std::to_string(sequence);
    write.events.push_back(event);
  }
  return write;
}

TEST_F(PostgresStorageTest, KeepsGroupsFromTheMigrationOn) {
  Sql(kToVersion6);
  const auto storage = MustOpen(conninfo_);
  GroupStorage& groups = storage->Groups();
  BlockingGroupWrites write(storage.get());
  const VehicleKey key = *BlockingWrites(storage.get()).Create("truck");
  const auto no_room = IsError(StatusCode::kFailedPrecondition, _,
                               HasSubstr("revisitd migrate"));
  const std::vector<GroupChange> add = {AddGroupMember{{key, "datum"}}};
  EXPECT_THAT(write.Create("fleet"), no_room);
  EXPECT_THAT(write.Change("fleet", add), no_room);
  EXPECT_THAT(write.Delete("fleet"), no_room);
  const auto no_group = IsError(StatusCode::kNotFound, "GROUP_NOT_FOUND", _);
  EXPECT_THAT(groups.GetGroup("fleet"), no_group);
  EXPECT_THAT(groups.ListMembers("fleet", "", 9), no_group);
  EXPECT_THAT(groups.ListLinks("fleet", "", 9), no_group);
  EXPECT_THAT(*groups.ListGroups("", "", 9), IsEmpty());
  EXPECT_THAT(*groups.ListGroupVersions(std::nullopt), IsEmpty());
  EXPECT_THAT(*groups.ListGroupsOf(key), IsEmpty());
  EXPECT_THAT(*groups.ListLinksOf(key, {}, 9), IsEmpty());
  EXPECT_THAT(groups.ListGroupsOf(99),
              IsError(StatusCode::kNotFound, "VEHICLE_NOT_FOUND", _));
  EXPECT_THAT(CheckDatabase(conninfo_)->problems, IsEmpty());
  const auto report = MigrateDatabase(conninfo_);
  ASSERT_THAT(report, IsOk());
  EXPECT_EQ(report->version_before, 6);
  EXPECT_EQ(report->version_after, kSchemaVersion);
  // The server goes on, and knows at once.
  ASSERT_THAT(write.Create("fleet"), IsOk());
  ASSERT_THAT(write.Change("fleet", add), IsOk());
  EXPECT_THAT(*groups.ListGroupsOf(key), ElementsAre("fleet"));
}

TEST_F(PostgresStorageTest, ChecksAreNotWrittenByAServerThatLostTheVehicle) {
  const auto storage = MustOpen(conninfo_);
  BlockingWrites write(storage.get());
  const VehicleKey key = *write.Create("truck");
  const PosePairRecord pair = {"a", 2, 1, 0};
  DeletedPairRecord deleted;
  deleted.pair = pair;
  ASSERT_THAT(write.AddPair(key, deleted.kind, pair, 2), IsOk());
  const ChecksWrite checks = ChecksAt({}, 4, {4});
  const auto fenced = IsError(StatusCode::kAborted, "EPOCH_FENCED", _);
  const auto lose = [&] {
    ASSERT_THAT(storage->TakeVehicle("truck"), IsOk());
    Sql("UPDATE heads SET epoch = epoch + 1");
  };
  lose();
  EXPECT_THAT(write.PutChecks(key, checks), fenced);
  lose();
  EXPECT_THAT(write.AddPair(key, deleted.kind, {"b", 2, 1, 0}, 3, checks),
              fenced);
  lose();
  EXPECT_THAT(write.DeletePair(key, deleted, 3, checks), fenced);
  lose();
  EXPECT_THAT(write.Delete(key), fenced);
  EXPECT_EQ(Sql("SELECT (SELECT count(*) FROM checks), (SELECT count(*) FROM "
                "events), (SELECT count(*) FROM loop_closures), (SELECT "
                "count(*) FROM deleted_pose_pairs)"),
            "0|0|1|0\n");
  // Checks leave the revision, which other writes are compared with.
  ASSERT_THAT(storage->TakeVehicle("truck"), IsOk());
  ASSERT_THAT(write.PutChecks(key, checks), IsOk());
  EXPECT_EQ(storage->GetVehicle("truck")->revision, 2u);
  EXPECT_THAT(write.Append(key, {1, 9, 3, "a"}), IsOk());
}

TEST_F(PostgresStorageTest, ServersOfTheVersionBeforeLeaveChecksRight) {
  VehicleKey key = 0;
  {
    const auto storage = MustOpen(conninfo_);
    BlockingWrites write(storage.get());
    for (const char* id : {"other", "truck"}) {
      key = *write.Create(id);
      ASSERT_THAT(write.Append(key, {1, 4, 2, "a"}), IsOk());
      ASSERT_THAT(write.Append(key, {5, 4, 3, "b"}), IsOk());
      ASSERT_THAT(write.PutChecks(key, ChecksAt({}, 7, {3, 6})), IsOk());
    }
  }
  const std::string of_truck = " = " + std::to_string(key);
  const auto checked = [&] {
    return Sql(
        "SELECT checked_sequence, last_event, (SELECT count(*) FROM "
        "checks WHERE vehicle_key = key) FROM heads ORDER BY key");
  };
  // What these write: a loss that is accepted, poses, and a deletion.
  Sql("UPDATE heads SET durable_sequence = 4 WHERE key" + of_truck);
  EXPECT_EQ(checked(), "7|2|2\n4|2|1\n");
  Sql("UPDATE heads SET durable_sequence = 9 WHERE key" + of_truck);
  EXPECT_EQ(checked(), "7|2|2\n4|2|1\n");
  Sql("DELETE FROM heads WHERE key" + of_truck +
      "; DELETE FROM vehicles WHERE key" + of_truck);
  EXPECT_EQ(Sql("SELECT vehicle_key" + of_truck +
                ", count(*) FROM checks "
                "GROUP BY 1"),
            "f|2\n");
  EXPECT_EQ(Sql("SELECT number, payload = '' FROM events ORDER BY vehicle_key, "
                "number"),
            "1|f\n2|f\n1|t\n2|t\n");
}

TEST_F(PostgresStorageTest, FindsAndGivesUpDamageOfChecks) {
  const auto storage = MustOpen(conninfo_);
  BlockingWrites write(storage.get());
  const VehicleKey key = *write.Create("truck");
  ASSERT_THAT(write.Append(key, {1, 9, 2, "a"}), IsOk());
  ASSERT_THAT(write.PutChecks(key, ChecksAt({}, 8, {3, 5, 7})), IsOk());
  Sql("UPDATE checks SET open_count = 2 WHERE sequence = 5");
  EXPECT_THAT((*storage->ListChecks(key, 1, 9, false, 9))[1].damage,
              IsError(StatusCode::kDataLoss, "STORE_CORRUPT",
                      HasSubstr("check 5 of vehicle 'truck'")));
  EXPECT_THAT(CheckDatabase(conninfo_)->damaged_vehicles, ElementsAre("truck"));
  ASSERT_THAT(write.DropDamaged(key, 9, "payload", 3), IsOk());
  EXPECT_EQ(Sql("SELECT sequence FROM checks ORDER BY 1"), "3\n7\n");
  EXPECT_EQ(storage->GetVehicle("truck")->checks, (ChecksHead{true, 8, 3}));
  EXPECT_THAT(CheckDatabase(conninfo_)->problems, IsEmpty());
  Sql("INSERT INTO checks SELECT 99, sequence, format, revision, open_count, "
      "create_time_ns, checksum, payload FROM checks; "
      "UPDATE heads SET last_event = 2");
  EXPECT_THAT(CheckDatabase(conninfo_)->problems,
              ElementsAre(HasSubstr("2 checks belong to no vehicle"),
                          HasSubstr("1 events are beyond")));
}

TEST_F(PostgresStorageTest, NumbersOfEventsGoOnWhereAHeadIsLost) {
  const auto write_and_lose = [&](const char* id) {
    const auto storage = MustOpen(conninfo_);
    BlockingWrites write(storage.get());
    const VehicleKey key = *write.Create(id);
    EXPECT_THAT(write.Append(key, {1, 9, 2, "a"}), IsOk());
    EXPECT_THAT(write.PutChecks(key, ChecksAt({}, 8, {3, 7})), IsOk());
    Sql("DELETE FROM heads");
    return key;
  };
  const VehicleKey truck = write_and_lose("truck");
  {
    const auto storage = MustOpen(conninfo_);
    BlockingWrites write(storage.get());
    ASSERT_THAT(storage->TakeVehicle("truck"), IsOk());
    ASSERT_THAT(write.DropDamaged(truck, 9, "payload", 3), IsOk());
    EXPECT_EQ(storage->GetVehicle("truck")->checks, (ChecksHead{true, 7, 2}));
    EXPECT_THAT(write.PutChecks(truck, ChecksAt({true, 7, 2}, 9, {9})), IsOk());
  }
  const VehicleKey van = write_and_lose("van");
  const auto storage = MustOpen(conninfo_);
  ASSERT_THAT(storage->TakeVehicle("van"), IsOk());
  EventRecord farewell;
  farewell.payload = "farewell";
  ASSERT_THAT(BlockingWrites(storage.get()).Delete(van, farewell), IsOk());
  EXPECT_EQ(Sql("SELECT number, convert_from(payload, 'UTF8') FROM events "
                "WHERE vehicle_key = " +
                std::to_string(van) + " ORDER BY 1"),
            "1|\n2|\n3|farewell\n");
}

// Such a dump holds events of transactions whose numbers are still to come.
TEST_F(PostgresStorageTest, GivesUpEventsOfADumpThatWasRestoredElsewhere) {
  const auto storage = MustOpen(conninfo_);
  BlockingWrites write(storage.get());
  const VehicleKey key = *write.Create("truck");
  ASSERT_THAT(write.PutChecks(key, ChecksAt({}, 4, {1, 2})), IsOk());
  ASSERT_TRUE(
      Eventually([&] { return storage->ReadEvents({}, 9)->size() == 2; }));
  const std::string shift =
      "SET xid = (pg_current_xact_id()::text::bigint + 1000000)::text::xid8";
  const std::string mark = Sql("SELECT * FROM dropped_events");
  for (const char* table : {"events", "dropped_events"}) {
    const auto before = storage->ReadEvents({}, 9);
    const EventPosition last = *storage->LastEvent();
    Sql(std::string("UPDATE ") + table + " " + shift);
    const ChecksHead head = storage->GetVehicle("truck")->checks;
    ASSERT_THAT(write.PutChecks(key, ChecksAt(head, 4, {3})), IsOk());
    ASSERT_THAT(write.DropEvents(0, 9), IsOk());
    // All are told once more to begin anew, and get what comes from then on.
    EXPECT_THAT(storage->ReadEvents({}, 9),
                IsError(StatusCode::kOutOfRange, "CURSOR_TOO_OLD", _));
    EXPECT_THAT(storage->ReadEvents(last, 9),
                IsError(StatusCode::kOutOfRange, _, _));
    const EventPosition start = *storage->LastEvent();
    ASSERT_THAT(
        write.PutChecks(key,
                        ChecksAt(storage->GetVehicle("truck")->checks, 4, {4})),
        IsOk());
    EXPECT_TRUE(Eventually([&] {
      const auto events = storage->ReadEvents(start, 9);
      return events.ok() && !events->empty() &&
             events->back().number ==
                 storage->GetVehicle("truck")->checks.last_event;
    }));
    // Nothing of a healthy database is given up.
    const std::string kept = Sql("SELECT * FROM dropped_events");
    EXPECT_NE(kept, mark);
    ASSERT_THAT(write.DropEvents(0, 9), IsOk());
    EXPECT_EQ(Sql("SELECT * FROM dropped_events"), kept);
  }
}

TEST_F(PostgresStorageTest, ServersThatDropEventsAtATimeDropNoneTooMany) {
  std::vector<std::unique_ptr<Storage>> servers;
  for (int i = 0; i < 3; ++i) servers.push_back(MustOpen(conninfo_));
  BlockingWrites write(servers[0].get());
  const VehicleKey key = *write.Create("truck");
  ChecksHead head;
  for (std::uint64_t i = 1; i <= 60; ++i) {
    const ChecksWrite step = ChecksAt(head, i, {i});
    ASSERT_THAT(write.PutChecks(key, step), IsOk());
    head = step.after;
  }
  ASSERT_TRUE(
      Eventually([&] { return servers[0]->LastEvent()->number == 60; }));
  const auto all = servers[0]->ReadEvents({}, 99);
  std::vector<std::thread> threads;
  for (const auto& server : servers) {
    threads.emplace_back([&all, storage = server.get()] {
      EventPosition cursor = (*all)[0].position;
      for (int i = 0; i < 30; ++i) {
        EXPECT_THAT(BlockingWrites(storage).DropEvents(505, 3), IsOk());
        const auto events = storage->ReadEvents(cursor, 3);
        if (!events.ok()) {
          EXPECT_THAT(events,
                      IsError(StatusCode::kOutOfRange, "CURSOR_TOO_OLD", _));
          cursor = *storage->LastEvent();
          continue;
        }
        for (const EventRecord& event : *events) {
          EXPECT_EQ(event.number, cursor.number + 1);
          cursor = event.position;
        }
      }
    });
  }
  for (std::thread& thread : threads) thread.join();
  EXPECT_EQ(Sql("SELECT (SELECT number FROM dropped_events), min(number), "
                "count(*) FROM events"),
            "50|51|10\n");
}

TEST_F(PostgresStorageTest, FindsAndGivesUpDamageOfDeletedPairs) {
  const auto storage = MustOpen(conninfo_);
  BlockingWrites write(storage.get());
  const VehicleKey key = *write.Create("truck");
  ASSERT_THAT(write.Append(key, {1, 1, 2, "a"}), IsOk());
  for (const std::uint64_t revision : {3, 5}) {
    const PairKind kind = PairKind::kRejectedCandidate;
    ASSERT_THAT(write.AddPair(key, kind, {"a", 2, 1, 0}, revision), IsOk());
    ASSERT_THAT(write.DeletePair(key, kind, "a", revision + 1), IsOk());
  }
  Sql("UPDATE deleted_pose_pairs SET kind = 1 WHERE number = 2");
  EXPECT_THAT(storage->ListDeletedPairs(key)->front().pair.damage,
              IsError(StatusCode::kDataLoss, "STORE_CORRUPT",
                      HasSubstr("deletion 2 of vehicle 'truck'")));
  EXPECT_THAT(CheckDatabase(conninfo_)->damaged_vehicles, ElementsAre("truck"));
  ASSERT_THAT(write.DropDamaged(key, 1, "payload", 7), IsOk());
  ASSERT_EQ(storage->ListDeletedPairs(key)->size(), 1u);
  EXPECT_EQ(storage->ListDeletedPairs(key)->front().number, 1u);
  EXPECT_THAT(CheckDatabase(conninfo_)->problems, IsEmpty());
}

TEST_F(PostgresStorageTest, SaysWhatIsWrongWithTheDatabaseItIsGiven) {
  EXPECT_THAT(
      OpenPostgresStorage("host=/nonexistent dbname=x password=secret", {}),
      IsError(StatusCode::kUnavailable, "STORE_UNAVAILABLE",
              AllOf(HasSubstr("host=/nonexistent"), Not(HasSubstr("secret")))));
  EXPECT_THAT(OpenPostgresStorage("postgresql://host/name?nonsense=1", {}),
              IsError(StatusCode::kInvalidArgument, _, HasSubstr("nonsense")));
  EXPECT_EQ(WithoutSecrets("postgresql://me:secret@db:5433/revisit"),
            "postgresql user=me dbname=revisit host=db port=5433");
}

TEST_F(PostgresStorageTest, FindsDamageAndKeepsItToItsVehicle) {
  const auto storage = MustOpen(conninfo_);
  BlockingWrites write(storage.get());
  const VehicleKey key = *write.Create("truck");
  const VehicleKey other = *write.Create("other");
  for (std::uint64_t i = 1; i <= 3; ++i) {
    ASSERT_THAT(write.Append(key, {i, 1, i + 1, "a"}), IsOk());
    ASSERT_THAT(write.Append(other, {i, 1, i + 1, "b"}), IsOk());
  }
  const auto lost = IsError(StatusCode::kDataLoss, "STORE_CORRUPT", _);
  Sql("UPDATE batches SET payload = 'x' WHERE first_sequence = 3 AND "
      "vehicle_key = " +
      std::to_string(key));
  EXPECT_THAT(storage->GetVehicle("truck")->damage, lost);
  EXPECT_EQ(storage->GetVehicle("truck")->durable_sequence, 3u);
  EXPECT_THAT(ReadAll(*storage, key, 1, 3), lost);
  EXPECT_THAT(ReadAll(*storage, key, 1, 2), IsOk());
  EXPECT_THAT(storage->GetVehicle("other")->damage, IsOk());
  const auto both = storage->GetVehicles({"other", "truck"});
  ASSERT_THAT(both, IsOk());
  ASSERT_EQ(both->size(), 2u);
  EXPECT_THAT((*both)[0].damage, IsOk());
  EXPECT_THAT((*both)[1].damage, lost);
  const auto report = CheckDatabase(conninfo_);
  ASSERT_THAT(report, IsOk());
  EXPECT_THAT(report->damaged_vehicles, ElementsAre("truck"));
  EXPECT_EQ(report->vehicles, 2);
  EXPECT_EQ(report->poses, 3);
  ASSERT_THAT(write.DropDamaged(key, 2, "payload", 9), IsOk());
  EXPECT_THAT(storage->GetVehicle("truck")->damage, IsOk());
  EXPECT_THAT(write.Append(key, {3, 1, 10, "c"}), IsOk());
  EXPECT_THAT(CheckDatabase(conninfo_)->problems, IsEmpty());

  Sql("UPDATE vehicles SET revision = revision + 1 WHERE id = 'truck'");
  EXPECT_THAT(storage->GetVehicle("truck")->damage, lost);
  EXPECT_THAT(write.Update(key, "new", 11), lost);
  EXPECT_THAT(write.Delete(key), IsOk());
}

TEST_F(PostgresStorageTest, HeadThatDisagreesWithTheLastBatchIsDamage) {
  const auto storage = MustOpen(conninfo_);
  BlockingWrites write(storage.get());
  const VehicleKey key = *write.Create("truck");
  ASSERT_THAT(write.Append(key, {1, 2, 2, "a"}), IsOk());
  Sql("UPDATE heads SET durable_sequence = 5");
  EXPECT_THAT(storage->GetVehicle("truck")->damage,
              IsError(StatusCode::kDataLoss, "STORE_CORRUPT",
                      HasSubstr("its head is at sequence 5, its last batch "
                                "ends at 2")));
  EXPECT_EQ(storage->GetVehicle("truck")->durable_sequence, 5u);
  ASSERT_THAT(write.DropDamaged(key, 2, "payload", 3), IsOk());
  EXPECT_THAT(storage->GetVehicle("truck")->damage, IsOk());
}

TEST_F(PostgresStorageTest, VehicleWhoseHeadIsLostCanBeGivenUpOrDeleted) {
  for (const bool is_deleted : {false, true}) {
    const std::string id = is_deleted ? "deleted" : "given up";
    VehicleKey key = 0;
    {
      const auto storage = MustOpen(conninfo_);
      BlockingWrites write(storage.get());
      key = *write.Create(id);
      ASSERT_THAT(write.Append(key, {1, 2, 5, "a"}), IsOk());
    }
    Sql("DELETE FROM heads");
    const auto storage = MustOpen(conninfo_);
    BlockingWrites write(storage.get());
    EXPECT_THAT(storage->GetVehicle(id)->damage,
                IsError(StatusCode::kDataLoss, "STORE_CORRUPT",
                        HasSubstr("no row in heads")));
    EXPECT_THAT(write.Delete(key),
                IsError(StatusCode::kNotFound, "VEHICLE_NOT_FOUND", _));
    const auto taken = storage->TakeVehicle(id);
    ASSERT_THAT(taken, IsOk());
    EXPECT_THAT(taken->damage, IsError(StatusCode::kDataLoss, "STORE_CORRUPT",
                                       HasSubstr("its last batch ends at 2")));
    EXPECT_EQ(taken->revision, 5u);
    if (is_deleted) {
      EXPECT_THAT(write.Delete(key), IsOk());
      continue;
    }
    ASSERT_THAT(write.DropDamaged(key, 2, "payload", 6), IsOk());
    EXPECT_THAT(storage->GetVehicle(id)->damage, IsOk());
    EXPECT_THAT(write.Append(key, {3, 1, 7, "b"}), IsOk());
  }
}

TEST_F(PostgresStorageTest, RowThatIsInTheWayHoldsUpItsOwnVehicleOnly) {
  PostgresOptions options;
  options.writer_connections = 1;
  const auto storage = MustOpen(conninfo_, options);
  BlockingWrites write(storage.get());
  std::vector<VehicleKey> keys;
  for (int i = 0; i < 8; ++i) {
    keys.push_back(*write.Create("v" + std::to_string(i)));
  }
  // Beyond the head: nothing wrote it.
  Sql("INSERT INTO batches VALUES (" + std::to_string(keys[3]) +
      ", 1, 1, 4, 0, 0, '')");
  std::vector<Answer<absl::Status>> answers(keys.size());
  for (std::size_t i = 0; i < keys.size(); ++i) {
    AppendBatch(*storage, keys[i], {1, 1, 2, "a"}, std::nullopt,
                answers[i].Setter());
  }
  for (std::size_t i = 0; i < keys.size(); ++i) {
    EXPECT_EQ(answers[i].Get().ok(), i != 3) << answers[i].Get();
  }
}

TEST_F(PostgresStorageTest, RowsOfAVehicleThatWaitAreCommittedTogether) {
  PostgresOptions options;
  options.writer_connections = 1;
  const auto storage = MustOpen(conninfo_, options);
  BlockingWrites write(storage.get());
  const VehicleKey key = *write.Create("truck");
  const VehicleKey other = *write.Create("other");
  const std::uint64_t before = storage->Counts().commits;
  std::vector<Answer<absl::Status>> answers(400);
  for (std::uint64_t i = 0; i < answers.size(); ++i) {
    AppendBatch(*storage, i % 2 == 0 ? key : other,
                {i / 2 + 1, 1, i + 2, "pose " + std::to_string(i / 2 + 1)},
                std::nullopt, answers[i].Setter());
  }
  for (const auto& answer : answers) EXPECT_THAT(answer.Get(), IsOk());
  EXPECT_LT(storage->Counts().commits - before, 100u);
  EXPECT_EQ(Sql("SELECT count(*) FROM batches"), "400\n");
  const auto batches = ReadAll(*storage, key, 1, 200);
  ASSERT_THAT(batches, IsOk());
  for (std::uint64_t i = 0; i < 200; ++i) {
    EXPECT_EQ((*batches)[i].payload, "pose " + std::to_string(i + 1));
  }
}

TEST_F(PostgresStorageTest, OfRowsThatWaitThoseAreWrittenThatFollow) {
  PostgresOptions options;
  options.writer_connections = 1;
  const auto storage = MustOpen(conninfo_, options);
  BlockingWrites write(storage.get());
  const VehicleKey key = *write.Create("truck");
  const VehicleKey other = *write.Create("other");
  for (std::uint64_t i = 1; i <= 2; ++i) {
    ASSERT_THAT(write.Append(key, {i, 1, i, "a"}), IsOk());
  }
  // Keeps the connection busy until the others have come.
  const Answer<bool> have_come;
  storage->ReviseBatches(
      other,
      [&](const auto&) {
        have_come.Get();
        return absl::OkStatus();
      },
      2, [](const absl::Status&) {});
  std::vector<Answer<absl::Status>> answers(3);
  for (std::uint64_t i = 0; i < answers.size(); ++i) {
    AppendBatch(*storage, key, {i + 2, 1, i + 9, "b"}, std::nullopt,
                answers[i].Setter());
  }
  have_come.Set(true);
  EXPECT_THAT(answers[0].Get(),
              IsError(StatusCode::kFailedPrecondition, "SEQUENCE_GAP", _));
  EXPECT_THAT(answers[1].Get(), IsOk());
  EXPECT_THAT(answers[2].Get(), IsOk());
  EXPECT_EQ(storage->GetVehicle("truck")->durable_sequence, 4u);
}

TEST_F(PostgresStorageTest, SmallBatchesShareARowAsLongAsItFitsAPage) {
  PostgresOptions options;
  options.max_joined_poses = 1'000'000;
  options.writer_connections = 1;
  const auto storage = MustOpen(conninfo_, options);
  BlockingWrites write(storage.get());
  const VehicleKey key = *write.Create("truck");
  const std::string payload(100, 'p');
  std::vector<Answer<absl::Status>> answers(1000);
  for (std::uint64_t i = 0; i < answers.size(); ++i) {
    AppendBatch(*storage, key, {i + 1, 1, i + 2, payload}, std::nullopt,
                answers[i].Setter());
  }
  for (const auto& answer : answers) EXPECT_THAT(answer.Get(), IsOk());
  EXPECT_EQ(Sql("SELECT sum(count), max(length(payload)) <= 7900 FROM batches"),
            "1000|t\n");
  // What came while the first row was committed lies in few.
  EXPECT_LT(std::stoi(Sql("SELECT count(*) FROM batches")), 100);
  EXPECT_EQ(storage->GetVehicle("truck")->durable_sequence, 1000u);
}

TEST_F(PostgresStorageTest, RowsStayInTheirPagesAndHeadsAreUpdatedInPlace) {
  auto storage = MustOpen(conninfo_);
  BlockingWrites write(storage.get());
  std::vector<VehicleKey> keys;
  for (int i = 0; i < 50; ++i) {
    keys.push_back(*write.Create("v" + std::to_string(i)));
  }
  // What does not compress, as poses do not.
  std::mt19937_64 random(1);
  std::string payload(kMostInlineBytes, ' ');
  for (char& c : payload) c = static_cast<char>(random());
  for (std::uint64_t i = 1; i <= 40; ++i) {
    std::vector<Answer<absl::Status>> answers(keys.size());
    for (std::size_t k = 0; k < keys.size(); ++k) {
      AppendBatch(*storage, keys[k], {i, 1, i + 1, payload}, std::nullopt,
                  answers[k].Setter());
    }
    for (const auto& answer : answers) ASSERT_THAT(answer.Get(), IsOk());
  }
  // Who has more bytes divides them.
  EXPECT_EQ(storage->MostBatchBytes(), kMostInlineBytes);
  // Servers of the version before may share it.
  EXPECT_FALSE(storage->KeepsColumns());
  ASSERT_THAT(
      write.AppendAll(keys[0], {{41, 1, 42, payload}, {42, 9, 43, payload}}),
      IsOk());
  ASSERT_THAT(
      write.AppendAll(keys[1], {{41, 1, 42, payload}, {42, 9, 43, payload}},
                      "vehicle"),
      IsOk());
  ASSERT_THAT(write.Revise(keys[0], {BatchRecord{1, 1, 0, payload}}, 99),
              IsOk());
  EXPECT_EQ(Sql("SELECT pg_relation_size(reltoastrelid) FROM pg_class WHERE "
                "relname IN ('batches', 'revised_batches')"),
            "0\n0\n");
  // Backends report their counts when they end.
  storage.reset();
  const auto hot = [&] {
    return Sql(
        "SELECT n_tup_upd >= 2000 AND n_tup_hot_upd >= 0.95 * n_tup_upd "
        "FROM pg_stat_user_tables WHERE relname = 'heads'");
  };
  EXPECT_TRUE(Eventually([&] { return hot() == "t\n"; })) << Sql(
      "SELECT n_tup_upd, n_tup_hot_upd FROM pg_stat_user_tables WHERE relname "
      "= 'heads'");
}

TEST_F(PostgresStorageTest,
       AppendFindsTheHeadsByTheirIndexHoweverManyThereAre) {
  Sql("INSERT INTO heads (key) SELECT generate_series(1, 1000000); "
      "ANALYZE heads");
  PostgresConnection::Options options;
  options.conninfo = conninfo_;
  options.writes = true;
  const auto connection = PostgresConnection::Open(options);
  ASSERT_THAT(connection, IsOk());
  ASSERT_THAT(
      (*connection)->RunText(std::string("PREPARE p AS ") + AppendSql()),
      IsOk());
  const auto plan = (*connection)
                        ->RunText(
                            "EXPLAIN EXECUTE p('{1}', "
                            "'{00000000-0000-0000-0000-000000000001}', "
                            "'{1}', '{1}', '{1}', '{1}', '{1}', '{1}', '{1}', "
                            "'{1}', '{1}', '{1}', "
                            "'{1}', '{1}', 'a', 4, '{1}')");
  ASSERT_THAT(plan, IsOk());
  std::string text;
  for (int i = 0; i < plan->size(); ++i) text += plan->Bytes(i, 0) + "\n";
  EXPECT_THAT(text, HasSubstr("Nested Loop"));
  EXPECT_THAT(text, HasSubstr("Index Scan using heads_pkey"));
  EXPECT_THAT(text, Not(HasSubstr("Seq Scan")));
}

TEST_F(PostgresStorageTest, WhatADeletedVehicleHadIsRemovedInTheBackground) {
  auto storage = MustOpen(conninfo_);
  BlockingWrites write(storage.get());
  const VehicleKey key = *write.Create("truck");
  for (std::uint64_t i = 1; i <= 600; ++i) {
    AppendBatch(*storage, key, {i, 1, i + 1, "a"}, std::nullopt,
                [](const absl::Status&) {});
  }
  ASSERT_THAT(write.Revise(key, {BatchRecord{1, 1, 0, "A"}}, 999), IsOk());
  ASSERT_THAT(write.Delete(key), IsOk());
  const auto left = [&] {
    return Sql(
        "SELECT (SELECT count(*) FROM batches) + (SELECT count(*) FROM "
        "revised_batches) + (SELECT count(*) FROM deleted_vehicles) + "
        "(SELECT count(*) FROM heads)");
  };
  EXPECT_TRUE(Eventually([&] { return left() == "0\n"; })) << left();
}

TEST_F(PostgresStorageTest, WhatASnapshotLeavesIsRemovedInTheBackground) {
  auto storage = MustOpen(conninfo_);
  BlockingWrites write(storage.get());
  const VehicleKey key = *write.Create("truck");
  const VehicleKey other = *write.Create("other");
  ASSERT_THAT(write.Append(key, {1, 1, 2, "a"}), IsOk());
  const auto put = [&](VehicleKey vehicle) {
    for (std::uint32_t i = 0; i < 10; ++i) {
      ASSERT_THAT(write.PutSnapshotPart(vehicle, i, std::string(9000, 'p')),
                  IsOk());
    }
    ASSERT_THAT(write.PutSnapshot(vehicle, {1, 10, "rest"}), IsOk());
  };
  const auto left = [&] {
    return Sql(
        "SELECT (SELECT count(*) FROM snapshots), (SELECT count(*) FROM "
        "snapshot_parts), (SELECT count(*) FROM deleted_snapshots)");
  };
  const auto await = [&](const std::string& expected) {
    EXPECT_TRUE(Eventually([&] { return left() == expected; })) << left();
  };
  put(other);
  put(key);
  ASSERT_THAT(write.Revise(key, {BatchRecord{1, 1, 0, "A"}}, 9), IsOk());
  await("1|10|0\n");
  put(key);
  put(key);
  await("2|20|0\n");
  ASSERT_THAT(write.DropDamaged(key, 0, "payload", 10), IsOk());
  await("1|10|0\n");
  put(key);
  ASSERT_THAT(write.Delete(key), IsOk());
  await("1|10|0\n");
  EXPECT_EQ(SnapshotOf(*storage, other).substr(0, 6), "to 1: ");
}

TEST_F(PostgresStorageTest, DamageOfASnapshotIsNamedAndIsNoneOfItsVehicle) {
  const auto storage = MustOpen(conninfo_);
  BlockingWrites write(storage.get());
  for (const char* id : {"car", "truck"}) {
    const VehicleKey key = *write.Create(id);
    ASSERT_THAT(write.Append(key, {1, 1, 2, "a"}), IsOk());
    ASSERT_THAT(write.PutSnapshotPart(key, 0, std::string(id) + "'s"), IsOk());
    ASSERT_THAT(write.PutSnapshot(key, {1, 1, "rest"}), IsOk());
  }
  // One in the making is none.
  ASSERT_THAT(write.PutSnapshotPart(*write.Create("bus"), 0, "part"), IsOk());
  auto report = CheckDatabase(conninfo_);
  ASSERT_THAT(report, IsOk());
  EXPECT_EQ(report->snapshots, 2);
  EXPECT_THAT(report->problems, IsEmpty());
  EXPECT_THAT(report->damaged_snapshots, IsEmpty());
  Sql("UPDATE snapshot_parts SET payload = 'x' WHERE payload = 'truck''s'");
  Sql("INSERT INTO snapshot_parts VALUES (999, 0, 4, 0, 'of none')");
  report = CheckDatabase(conninfo_);
  EXPECT_THAT(report->damaged_vehicles, IsEmpty());
  EXPECT_THAT(report->damaged_snapshots,
              ElementsAre(AllOf(HasSubstr("truck"), HasSubstr("checksum"))));
  EXPECT_THAT(report->problems,
              ElementsAre(HasSubstr("1 snapshots or parts of snapshots")));
}

TEST_F(PostgresStorageTest, NothingAcknowledgedIsLostWhenTheDatabaseCrashes) {
  std::string missing;
  // What a process has written outlives it without a flush.
  const auto server = PostgresServer::Start({"fsync=off"}, &missing);
  ASSERT_NE(server, nullptr) << missing;
  const std::string conninfo = server->MakeStore();
  const auto storage = MustOpen(conninfo);
  const std::vector<std::string> ids = {"a", "b", "c", "d"};
  for (const std::string& id : ids) {
    ASSERT_THAT(BlockingWrites(storage.get()).Create(id), IsOk());
  }
  std::atomic<bool> stop{false};
  std::atomic<int> failures{0};
  std::vector<std::atomic<std::uint64_t>> acknowledged(ids.size());
  std::vector<std::thread> threads;
  for (std::size_t i = 0; i < ids.size(); ++i) {
    threads.emplace_back([&, i] {
      while (!stop) {
        const auto taken = storage->TakeVehicle(ids[i]);
        if (!taken.ok()) {
          std::this_thread::sleep_for(std::chrono::milliseconds(20));
          continue;
        }
        EXPECT_GE(taken->durable_sequence, acknowledged[i]);
        std::uint64_t next = taken->durable_sequence + 1;
        while (!stop && BlockingWrites(storage.get())
                            .Append(taken->key, {next, 1, next, "a"})
                            .ok()) {
          acknowledged[i] = next++;
        }
        ++failures;
      }
    });
  }
  const auto await_progress = [&] {
    for (const auto& last : acknowledged) {
      const std::uint64_t before = last;
      EXPECT_TRUE(Eventually([&] { return last > before + 10; }));
    }
  };
  for (int i = 0; i < 2; ++i) {
    await_progress();
    server->Crash();
  }
  await_progress();
  stop = true;
  for (std::thread& thread : threads) thread.join();
  EXPECT_GT(failures, 4);
  for (std::size_t i = 0; i < ids.size(); ++i) {
    const auto record = storage->GetVehicle(ids[i]);
    ASSERT_THAT(record, IsOk());
    EXPECT_THAT(record->damage, IsOk());
    EXPECT_GE(record->durable_sequence, acknowledged[i]);
  }
  EXPECT_THAT(CheckDatabase(conninfo)->problems, IsEmpty());
}

TEST_F(PostgresStorageTest, ReadersWaitForAConnectionWhereAllAreUsed) {
  ConnectionPool::Options options;
  options.most = 2;
  options.wait = std::chrono::milliseconds(200);
  ConnectionPool pool(conninfo_, options);
  const auto count = [&] {
    return std::stoi(
        Sql("SELECT count(*) FROM pg_stat_activity WHERE application_name = "
            "'revisitd' AND datname = current_database()"));
  };
  const auto nothing = [](PostgresConnection&) { return absl::OkStatus(); };
  EXPECT_THAT(pool.Use([&](PostgresConnection&) {
    return pool.Use([&](PostgresConnection&) {
      EXPECT_THAT(pool.Use(nothing),
                  IsError(StatusCode::kUnavailable, "STORE_UNAVAILABLE",
                          HasSubstr("all 2 connections")));
      EXPECT_EQ(count(), 2);
      return absl::OkStatus();
    });
  }),
              IsOk());
  // Whoever waits comes when one is free, and more come than there are.
  options.wait = std::chrono::minutes(1);
  ConnectionPool patient(conninfo_, options);
  const int others = count();
  std::vector<std::thread> threads;
  std::atomic<int> came{0};
  for (int i = 0; i < 20; ++i) {
    threads.emplace_back([&] {
      EXPECT_THAT(patient.Use([&](PostgresConnection& connection) {
        ++came;
        return connection.RunText("SELECT pg_sleep(0.005)").status();
      }),
                  IsOk());
    });
  }
  for (std::thread& thread : threads) thread.join();
  EXPECT_EQ(came, 20);
  EXPECT_LE(count(), others + 2);
  // A connection that cannot be opened takes nobody's turn.
  ConnectionPool nowhere("host=/nonexistent dbname=x", options);
  for (int i = 0; i < 3; ++i) {
    EXPECT_THAT(nowhere.Use(nothing),
                IsError(StatusCode::kUnavailable, _, HasSubstr("connect")));
  }
}

TEST_F(PostgresStorageTest, TellsTheSizeOfTheDatabaseAndNoFreeRoom) {
  const auto storage = MustOpen(conninfo_);
  ASSERT_TRUE(Eventually([&] { return storage->GetRoom().has_value(); }));
  const auto bytes = static_cast<double>(storage->GetRoom()->bytes);
  const double now =
      std::stod(Sql("SELECT pg_database_size(current_database())"));
  EXPECT_NEAR(bytes, now, 0.1 * now);
  EXPECT_EQ(storage->GetRoom()->free_bytes, std::nullopt);
}

TEST_F(PostgresStorageTest, OpenedForReadingItWritesNothing) {
  MustOpen(conninfo_).reset();
  const std::string servers = Sql("SELECT count(*) FROM servers");
  const auto storage = OpenPostgresStorageToRead(conninfo_);
  ASSERT_THAT(storage, IsOk());
  EXPECT_THAT(BlockingWrites(storage->get()).Create("truck"),
              IsError(StatusCode::kFailedPrecondition, _, _));
  EXPECT_THAT((*storage)->ListVehicles("", "", 10), IsOk());
  EXPECT_EQ(Sql("SELECT count(*) FROM servers"), servers);
}

}  // namespace
}  // namespace revisit::server
