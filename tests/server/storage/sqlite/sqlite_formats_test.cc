#include <fstream>
#include <memory>
#include <string>

#include "gmock/gmock.h"
#include "gtest/gtest.h"
#include "tests/server/error_matchers.h"
#include "tests/server/storage/sqlite/sqlite_testing.h"
#include "tests/server/storage_testing.h"

namespace revisit::server {
namespace {

using absl::StatusCode;
using ::testing::AllOf;
using ::testing::ElementsAre;
using ::testing::HasSubstr;
using ::testing::IsEmpty;

TEST_F(SqliteStorageTest, RefusesNewerFormat) {
  MakeStore();
  RunSql(Path(), "PRAGMA user_version = 10");
  EXPECT_THAT(OpenSqliteStorage(Path()),
              IsError(StatusCode::kFailedPrecondition, "",
                      AllOf(HasSubstr("has format 10"),
                            HasSubstr("this server reads formats 4 to 9"),
                            HasSubstr("use a newer server"))));
}

TEST_F(SqliteStorageTest, RefusesFormatThatWasNeverReleased) {
  MakeStore();
  RunSql(Path(), "PRAGMA user_version = 3");
  EXPECT_THAT(OpenSqliteStorage(Path()),
              IsError(StatusCode::kFailedPrecondition, "",
                      AllOf(HasSubstr("has format 3"),
                            HasSubstr("this server reads formats 4 to 9"))));
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

TEST_F(SqliteStorageTest, WritesFormat9) {
  // Golden: a change here is a new format. The checksums were printed by this
  // program once; record_checksum.h says what they are made of.
  const VehicleKey key = MakeStore();
  EXPECT_EQ(key, 1);
  {
    DeletedPairRecord deleted;
    deleted.kind = PairKind::kRejectedCandidate;
    deleted.pair = {"gone", 5, 2, 101, "said"};
    deleted.delete_time_ns = 102;
    const std::unique_ptr<Storage> storage = MustOpen(Path());
    BlockingWrites write(storage.get());
    ASSERT_THAT(write.AddPair(key, deleted.kind, deleted.pair, 7), IsOk());
    ASSERT_THAT(write.DeletePair(key, deleted, 7), IsOk());
    ChecksWrite checks;
    checks.after = {true, 5, 1};
    checks.checks.push_back({4, 7, 2, 103, "found"});
    checks.events.emplace_back();
    checks.events.back().time_ns = 104;
    checks.events.back().payload = "told";
    ASSERT_THAT(write.PutChecks(key, checks), IsOk());
    BlockingGroupWrites groups(storage.get());
    ASSERT_THAT(groups.Create("fleet", "settings", "unique"), IsOk());
    ASSERT_THAT(groups.Change("fleet", {AddGroupMember{{key, "datum"}},
                                        AddGroupLink{{"joined",
                                                      LinkState::kTentative,
                                                      {key, 6},
                                                      {key, 1},
                                                      "mark"}}}),
                IsOk());
  }
  EXPECT_EQ(RunSql(Path(), "PRAGMA application_id; PRAGMA user_version"),
            "1381389140\n9\n");
  EXPECT_EQ(RunSql(Path(), "PRAGMA journal_mode"), "wal\n");
  EXPECT_EQ(RunSql(Path(), "PRAGMA page_size"), "8192\n");
  EXPECT_EQ(RunSql(Path(),
                   "SELECT name FROM sqlite_schema WHERE type = "
                   "'table' ORDER BY name"),
            "batches\ncheck_heads\nchecks\ndeleted_pose_pairs\n"
            "deleted_snapshots\ndeleted_vehicles\ndropped_events\nevents\n"
            "group_links\ngroup_members\nloop_closures\n"
            "rejected_candidates\nrevised_batches\nsnapshot_parts\nsnapshots\n"
            "sqlite_sequence\nstore\nvehicle_groups\nvehicles\n");
  EXPECT_EQ(RunSql(Path(),
                   "SELECT key, id, format, revision, checksum, "
                   "payload FROM vehicles"),
            "1|truck|9|7|7142115261073619293|payload\n");
  EXPECT_EQ(RunSql(Path(), "PRAGMA auto_vacuum"), "2\n");
  // Where store_state.h says that it stands; of the rest only the number of the
  // commit, the creation's included, and that it was the last are known.
  EXPECT_EQ(RunSql(Path(),
                   "SELECT key, substr(state, 1, 8), hex(substr(state, 25, "
                   "8)), hex(substr(state, 49, 8)), length(state) FROM store"),
            "1|RVSTATE3|0F00000000000000|0100000000000000|64\n");
  const std::string batch =
      "SELECT vehicle_key, first_sequence, count, format, revision, checksum, "
      "payload FROM ";
  EXPECT_EQ(RunSql(Path(), batch + "batches"),
            "1|1|2|9|2|-6415618383081811197|alpha\n"
            "1|3|2|9|3|-182051484151242630|beta\n"
            "1|5|2|9|4|-8177843865597535832|gamma\n");
  EXPECT_EQ(RunSql(Path(), batch + "revised_batches"),
            "1|5|2|9|5|6343227125892268326|GAMMA\n");
  const std::string pair =
      "SELECT vehicle_key, id, format, query_sequence, matched_sequence, "
      "create_time_ns, checksum, payload FROM ";
  EXPECT_EQ(RunSql(Path(), pair + "loop_closures"),
            "1|link|9|6|1|99|3894719731166983954|measured\n");
  EXPECT_EQ(RunSql(Path(), pair + "rejected_candidates"),
            "1|no|9|6|2|100|-8901053670911878638|\n");
  EXPECT_EQ(RunSql(Path(),
                   "SELECT vehicle_key, number, kind, id, format, "
                   "query_sequence, matched_sequence, create_time_ns, "
                   "delete_time_ns, checksum, payload FROM deleted_pose_pairs"),
            "1|1|2|gone|9|5|2|101|102|-2449033999147468391|said\n");
  EXPECT_EQ(RunSql(Path(),
                   "SELECT vehicle_key, format, stores, checked_sequence, "
                   "last_event, checksum FROM check_heads"),
            "1|9|1|5|1|1328295749546238155\n");
  EXPECT_EQ(RunSql(Path(),
                   "SELECT vehicle_key, sequence, format, revision, "
                   "open_count, create_time_ns, checksum, payload FROM checks"),
            "1|4|9|7|2|103|3753797113483146547|found\n");
  EXPECT_EQ(RunSql(Path(),
                   "SELECT id, vehicle_key, number, format, time_ns, checksum, "
                   "payload FROM events"),
            "1|1|1|9|104|-7105728943893578983|told\n");
  EXPECT_EQ(RunSql(Path(),
                   "SELECT id, format, revision, uid, checksum, payload FROM "
                   "vehicle_groups"),
            "fleet|9|2|unique|-4520253389883713093|settings\n");
  EXPECT_EQ(RunSql(Path(),
                   "SELECT group_id, vehicle_key, format, checksum, payload "
                   "FROM group_members"),
            "fleet|1|9|2396699369029455702|datum\n");
  EXPECT_EQ(RunSql(Path(),
                   "SELECT group_id, id, format, state, query_vehicle, "
                   "query_sequence, matched_vehicle, matched_sequence, "
                   "checksum, payload FROM group_links"),
            "fleet|joined|9|2|1|6|1|1|4883537530600076510|mark\n");
}

// Makes the store of MakeStore() what a server of format 8 left: the same. The
// checksums are those that such a server wrote.
constexpr char kToFormat8[] = R"sql(
UPDATE vehicles SET format = 8, checksum = -2265942714625145979;
UPDATE batches SET format = 8, checksum = -2442835587616324140
  WHERE first_sequence = 1;
UPDATE batches SET format = 8, checksum = -6392577953320758442
  WHERE first_sequence = 3;
UPDATE batches SET format = 8, checksum = -7679106914065205411
  WHERE first_sequence = 5;
UPDATE revised_batches SET format = 8, checksum = 8068352387906842914;
UPDATE loop_closures SET format = 8, checksum = -5407416111403082421;
UPDATE rejected_candidates SET format = 8, checksum = 7018123967209369271;
PRAGMA user_version = 8;
)sql";

TEST_F(SqliteStorageTest, StoreOfFormat8OpensAndIsNoneForServersOfThatFormat) {
  MakeStore();
  RunSql(Path(), kToFormat8);
  {
    const std::unique_ptr<Storage> storage = MustOpen(Path());
    EXPECT_EQ(ToText(*storage->GetVehicle("truck")),
              "truck 1: 1 closures, 1 rejected, to 6, revision 7, 'payload'");
    EXPECT_THAT(
        ToTexts(*ReadAll(*storage, 1, 1, 6)),
        ElementsAre("1+2, revision 2, 'alpha'", "3+2, revision 3, 'beta'",
                    "5+2, revision 5, 'GAMMA'"));
    EXPECT_TRUE(storage->KeepsColumns());
  }
  EXPECT_EQ(RunSql(Path(), "PRAGMA user_version"), "9\n");
}

// Takes away the tables that came with format 8.
constexpr char kWithoutGroups[] = R"sql(
DROP TABLE vehicle_groups;
DROP TABLE group_members;
DROP TABLE group_links;
)sql";

// Makes the store of MakeStore() what a server of format 7 left: the same, but
// for groups. The checksums are those that such a server wrote.
constexpr char kToFormat7[] = R"sql(
UPDATE vehicles SET format = 7, checksum = 8067135607144566699;
UPDATE batches SET format = 7, checksum = 7290557504945994731
  WHERE first_sequence = 1;
UPDATE batches SET format = 7, checksum = -181780734265261
  WHERE first_sequence = 3;
UPDATE batches SET format = 7, checksum = -9143034401239332841
  WHERE first_sequence = 5;
UPDATE revised_batches SET format = 7, checksum = -2852123500478967986;
UPDATE loop_closures SET format = 7, checksum = 1321652235935153537;
UPDATE rejected_candidates SET format = 7, checksum = -3324854010670219591;
PRAGMA user_version = 7;
)sql";

TEST_F(SqliteStorageTest, StoreOfFormat7OpensAndKeepsGroupsFromThenOn) {
  MakeStore();
  RunSql(Path(), std::string(kWithoutGroups) + kToFormat7);
  {
    const std::unique_ptr<Storage> storage = MustOpen(Path());
    EXPECT_EQ(ToText(*storage->GetVehicle("truck")),
              "truck 1: 1 closures, 1 rejected, to 6, revision 7, 'payload'");
    EXPECT_THAT(
        ToTexts(*ReadAll(*storage, 1, 1, 6)),
        ElementsAre("1+2, revision 2, 'alpha'", "3+2, revision 3, 'beta'",
                    "5+2, revision 5, 'GAMMA'"));
    EXPECT_THAT(*storage->Groups().ListGroups("", "", 9), IsEmpty());
    BlockingGroupWrites write(storage.get());
    ASSERT_THAT(write.Create("fleet"), IsOk());
    ASSERT_THAT(write.Change("fleet", {AddGroupMember{{1, "datum"}}}), IsOk());
  }
  EXPECT_EQ(RunSql(Path(), "PRAGMA user_version"), "9\n");
  EXPECT_THAT(*MustOpen(Path())->Groups().ListGroupsOf(1),
              ElementsAre("fleet"));
}

// Takes away the tables that came with formats 7 and 8.
constexpr char kWithoutChecks[] = R"sql(
DROP TABLE vehicle_groups;
DROP TABLE group_members;
DROP TABLE group_links;
DROP TABLE check_heads;
DROP TABLE checks;
DROP TABLE events;
DROP TABLE dropped_events;
)sql";

// Makes the store of MakeStore() what a server of format 6 left: the same, but
// for checks. The checksums are those that such a server wrote.
constexpr char kToFormat6[] = R"sql(
UPDATE vehicles SET format = 6, checksum = -378043371729410139;
UPDATE batches SET format = 6, checksum = 1663941130652305546
  WHERE first_sequence = 1;
UPDATE batches SET format = 6, checksum = 4802856297871863142
  WHERE first_sequence = 3;
UPDATE batches SET format = 6, checksum = 4734102177889975241
  WHERE first_sequence = 5;
UPDATE revised_batches SET format = 6, checksum = -7756420075551789252;
UPDATE loop_closures SET format = 6, checksum = -8944790561869085503;
UPDATE rejected_candidates SET format = 6, checksum = 5282240857298780020;
PRAGMA user_version = 6;
)sql";

TEST_F(SqliteStorageTest, StoreOfFormat6OpensAndStoresChecksFromThenOn) {
  MakeStore();
  RunSql(Path(), std::string(kWithoutChecks) + kToFormat6);
  {
    const std::unique_ptr<Storage> storage = MustOpen(Path());
    BlockingWrites write(storage.get());
    EXPECT_EQ(ToText(*storage->GetVehicle("truck")),
              "truck 1: 1 closures, 1 rejected, to 6, revision 7, 'payload'");
    EXPECT_THAT(*storage->ListChecks(1, 1, 9, false, 9), IsEmpty());
    EXPECT_THAT(*storage->ReadEvents({}, 9), IsEmpty());
    ChecksWrite checks;
    checks.after = {true, 6, 0};
    EXPECT_THAT(write.PutChecks(1, checks), IsOk());
  }
  EXPECT_EQ(RunSql(Path(), "PRAGMA user_version"), "9\n");
  EXPECT_EQ(MustOpen(Path())->GetVehicle("truck")->checks,
            (ChecksHead{true, 6, 0}));
}

// Makes the store of MakeStore() what a server of format 5 left: the same, but
// for what was deleted. The checksums are those that such a server wrote.
constexpr char kToFormat5[] = R"sql(
DROP TABLE deleted_pose_pairs;
UPDATE vehicles SET format = 5, checksum = -849705879005082293;
UPDATE batches SET format = 5, checksum = 5854594566563219142
  WHERE first_sequence = 1;
UPDATE batches SET format = 5, checksum = -2588423461738458171
  WHERE first_sequence = 3;
UPDATE batches SET format = 5, checksum = -588482591432174812
  WHERE first_sequence = 5;
UPDATE revised_batches SET format = 5, checksum = 289742499483280071;
UPDATE loop_closures SET format = 5, checksum = 7278644712121708534;
UPDATE rejected_candidates SET format = 5, checksum = -6714604230668513376;
PRAGMA user_version = 5;
)sql";

TEST_F(SqliteStorageTest, StoreOfFormat5OpensAndKeepsWhatIsDeletedFromThenOn) {
  MakeStore();
  RunSql(Path(), std::string(kWithoutChecks) + kToFormat5);
  {
    const std::unique_ptr<Storage> storage = MustOpen(Path());
    EXPECT_EQ(ToText(*storage->GetVehicle("truck")),
              "truck 1: 1 closures, 1 rejected, to 6, revision 7, 'payload'");
    EXPECT_THAT(
        ToTexts(*ReadAll(*storage, 1, 1, 6)),
        ElementsAre("1+2, revision 2, 'alpha'", "3+2, revision 3, 'beta'",
                    "5+2, revision 5, 'GAMMA'"));
    EXPECT_THAT(*storage->ListDeletedPairs(1), IsEmpty());
    BlockingWrites write(storage.get());
    EXPECT_THAT(write.DeletePair(1, PairKind::kLoopClosure, "link", 8), IsOk());
  }
  EXPECT_EQ(RunSql(Path(), "PRAGMA user_version"), "9\n");
  EXPECT_EQ(MustOpen(Path())->ListDeletedPairs(1)->size(), 1u);
}

// Makes the store of MakeStore() what a server of format 4 left: the same, but
// for snapshots and what was deleted. The checksums are those that such a
// server wrote.
constexpr char kToFormat4[] = R"sql(
DROP TABLE deleted_pose_pairs;
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
  RunSql(Path(), std::string(kWithoutChecks) + kToFormat4);
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
    EXPECT_THAT(*storage->ListDeletedPairs(1), IsEmpty());
  }
  EXPECT_EQ(RunSql(Path(), "PRAGMA user_version"), "9\n");
  EXPECT_EQ(RunSql(Path(), "SELECT format, count(*) FROM batches GROUP BY 1"),
            "4|3\n");
  EXPECT_EQ(SnapshotOf(*MustOpen(Path()), 1), "to 6: part, 'rest'");
}

TEST_F(SqliteStorageTest,
       StoreOfFormat4StaysAsItIsIfItCannotBeBroughtUpToDate) {
  MakeStore();
  RunSql(Path(), std::string(kWithoutChecks) + kToFormat4);
  // The name is taken, which is as good a failure as any.
  RunSql(Path(), "CREATE TABLE snapshot_parts (mine INTEGER)");
  EXPECT_THAT(OpenSqliteStorage(Path()),
              IsError(StatusCode::kInternal, "INTERNAL",
                      HasSubstr("snapshot_parts already exists")));
  EXPECT_EQ(RunSql(Path(), "PRAGMA user_version"), "4\n");
  RunSql(Path(), "DROP TABLE snapshot_parts");
  EXPECT_EQ(MustOpen(Path())->GetVehicle("truck")->durable_sequence, 6u);
}

}  // namespace
}  // namespace revisit::server
