// Groups in a SQLite file, beyond what every storage promises: damage, and what
// a check and a backup of the store say of them.
#include <cstdint>
#include <memory>
#include <string>
#include <vector>

#include "gmock/gmock.h"
#include "gtest/gtest.h"
#include "server/storage/sqlite/sqlite_reader.h"
#include "server/storage/sqlite/store_backup.h"
#include "server/storage/sqlite/store_check.h"
#include "tests/server/error_matchers.h"
#include "tests/server/storage/sqlite/sqlite_testing.h"
#include "tests/server/storage_testing.h"

namespace revisit::server {
namespace {

using absl::StatusCode;
using ::testing::_;
using ::testing::ElementsAre;
using ::testing::HasSubstr;
using ::testing::IsEmpty;

class SqliteGroupsTest : public SqliteStorageTest {
 protected:
  // Groups `one` and `two` of the vehicles `truck`, of key 1, and `van`, of key
  // 2, with links `a` and `b` in each.
  void MakeGroups() {
    const std::unique_ptr<Storage> storage = MustOpen(Path());
    BlockingGroupWrites write(storage.get());
    const VehicleKey truck = *BlockingWrites(storage.get()).Create("truck");
    const VehicleKey van = *BlockingWrites(storage.get()).Create("van");
    for (const char* id : {"one", "two"}) {
      ASSERT_THAT(write.Create(id), IsOk());
      ASSERT_THAT(
          write.Change(
              id,
              {AddGroupMember{{truck, "datum"}}, AddGroupMember{{van, "datum"}},
               AddGroupLink{
                   {"a", LinkState::kConfirmed, {truck, 1}, {van, 2}, ""}},
               AddGroupLink{{"b",
                             LinkState::kTentative,
                             {van, 3},
                             {truck, 4},
                             "mark"}}}),
          IsOk());
    }
  }

  std::vector<std::string> Problems() const {
    const absl::StatusOr<StoreReport> report =
        CheckStore(Path(), StoreUse::kIdle);
    EXPECT_THAT(report, IsOk());
    return report->problems;
  }
};

TEST_F(SqliteGroupsTest, ADamagedGroupIsReturnedBesideOthersAndCanBeDeleted) {
  MakeGroups();
  RunSql(Path(), "UPDATE vehicle_groups SET payload = 'x' WHERE id = 'one'");
  const auto storage = MustOpen(Path());
  GroupStorage& groups = storage->Groups();
  BlockingGroupWrites write(storage.get());
  EXPECT_THAT(ToTexts(*groups.ListGroups("", "", 9)),
              ElementsAre("one uid: revision 2, '', damaged",
                          "two uid: revision 2, 'payload'"));
  const auto damage = IsError(StatusCode::kDataLoss, "STORE_CORRUPT",
                              HasSubstr("stored group 'one'"));
  EXPECT_THAT(groups.GetGroup("one")->damage, damage);
  EXPECT_EQ(groups.ListMembers("one", "", 9)->size(), 2u);
  EXPECT_EQ(groups.ListLinks("one", "", 9)->size(), 2u);
  // Its row would pass for sound if it was written again.
  EXPECT_THAT(write.Change("one", {SetGroupPayload{"new"}}), damage);
  EXPECT_THAT(write.Change("one", {RemoveGroupLink{"a"}}), IsOk());
  EXPECT_THAT(write.Delete("one"), IsOk());
  EXPECT_EQ(groups.ListGroups("", "", 9)->size(), 1u);
}

TEST_F(SqliteGroupsTest, ADamagedMemberIsReturnedBesideOthersAndCanBeReplaced) {
  MakeGroups();
  RunSql(Path(),
         "UPDATE group_members SET payload = 'x' WHERE group_id = 'one' AND "
         "vehicle_key = 1");
  const auto storage = MustOpen(Path());
  GroupStorage& groups = storage->Groups();
  BlockingGroupWrites write(storage.get());
  EXPECT_THAT(ToTexts(*groups.ListMembers("one", "", 9)),
              ElementsAre("truck: '', damaged", "van: 'datum'"));
  EXPECT_THAT((*groups.ListMembers("one", "", 9))[0].damage,
              IsError(StatusCode::kDataLoss, "STORE_CORRUPT",
                      HasSubstr("stored member 'truck' of group 'one'")));
  EXPECT_THAT(groups.GetGroup("one")->damage, IsOk());
  ASSERT_THAT(write.Change("one", {SetGroupMember{{1, "new"}}}), IsOk());
  EXPECT_THAT(ToTexts(*groups.ListMembers("one", "", 9)),
              ElementsAre("truck: 'new'", "van: 'datum'"));
}

TEST_F(SqliteGroupsTest, ADamagedLinkIsReturnedBesideOthersAndCanBeRemoved) {
  for (const char* damage :
       {"payload = 'x'", "state = 2", "state = 4", "query_sequence = 9",
        "matched_vehicle = 1", "format = 99", "checksum = 5"}) {
    SCOPED_TRACE(damage);
    RemoveStore();
    MakeGroups();
    RunSql(Path(), std::string("UPDATE group_links SET ") + damage +
                       " WHERE group_id = 'one' AND id = 'a'");
    const auto storage = MustOpen(Path());
    GroupStorage& groups = storage->Groups();
    BlockingGroupWrites write(storage.get());
    const std::string b = "b, tentative: 3 of 2 at 4 of 1, 'mark'";
    EXPECT_THAT(ToTexts(*groups.ListLinks("one", "", 9)),
                ElementsAre("a, damaged", b));
    EXPECT_THAT(ToTexts(*groups.ListLinksOf(1, {}, 2)),
                ElementsAre("one/a, damaged", "one/" + b));
    EXPECT_THAT(
        write.Change("one", {SetGroupLink{"a", LinkState::kConfirmed, ""}}),
        IsError(StatusCode::kDataLoss, "STORE_CORRUPT",
                HasSubstr("stored link 'a' of group 'one'")));
    EXPECT_THAT(write.Change("one", {RemoveGroupLink{"a"}}), IsOk());
    EXPECT_THAT(ToTexts(*groups.ListLinks("one", "", 9)), ElementsAre(b));
  }
}

TEST_F(SqliteGroupsTest, ACheckCountsGroupsAndNamesEachDamagedRow) {
  MakeGroups();
  absl::StatusOr<StoreReport> report = CheckStore(Path(), StoreUse::kIdle);
  ASSERT_THAT(report, IsOk());
  EXPECT_THAT(report->problems, IsEmpty());
  EXPECT_EQ(report->groups, 2);
  EXPECT_EQ(report->members, 4);
  EXPECT_EQ(report->links, 4);
  RunSql(Path(),
         "UPDATE vehicle_groups SET payload = 'x' WHERE id = 'one';"
         "UPDATE group_members SET payload = 'x' WHERE group_id = 'one' AND "
         "vehicle_key = 2; UPDATE group_links SET payload = 'x' WHERE id = "
         "'a'");
  report = CheckStore(Path(), StoreUse::kIdle);
  EXPECT_THAT(report->problems,
              ElementsAre(HasSubstr("group 'one' fails"),
                          HasSubstr("member 'van' of group 'one' fails"),
                          HasSubstr("link 'a' of group 'one' fails"),
                          HasSubstr("link 'a' of group 'two' fails")));
  EXPECT_EQ(report->groups, 2);
  EXPECT_EQ(report->members, 4);
  EXPECT_EQ(report->links, 4);
}

TEST_F(SqliteGroupsTest, ACheckFindsRowsThatBelongToNoGroupOrMember) {
  MakeGroups();
  RunSql(Path(), "DELETE FROM vehicle_groups WHERE id = 'one'");
  EXPECT_THAT(Problems(),
              ElementsAre("2 members belong to no group or are no vehicle"));
  RunSql(Path(), "DELETE FROM group_members WHERE group_id = 'one'");
  EXPECT_THAT(Problems(), ElementsAre("2 loop closures of groups name vehicles "
                                      "that are no members"));
  RunSql(Path(), "DELETE FROM group_links WHERE group_id = 'one'");
  EXPECT_THAT(Problems(), IsEmpty());
  RunSql(Path(), "UPDATE group_links SET matched_vehicle = 3 WHERE id = 'a'");
  EXPECT_THAT(Problems(),
              ElementsAre(HasSubstr("fails its checksum"),
                          HasSubstr("1 loop closures of groups name")));
}

TEST_F(SqliteGroupsTest, ABackupHoldsTheGroups) {
  MakeGroups();
  const std::string copy = directory_.File("backup.db");
  const auto report = BackUpStore(Path(), StoreUse::kIdle, copy);
  ASSERT_THAT(report, IsOk());
  EXPECT_EQ(report->groups, 2);
  const auto storage = MustOpen(copy);
  EXPECT_EQ(storage->Groups().ListMembers("two", "", 9)->size(), 2u);
  EXPECT_EQ(storage->Groups().ListLinksOf(2, {}, 9)->size(), 4u);
}

TEST_F(SqliteGroupsTest, WithLittleRoomOnlyWhatRemovesIsTaken) {
  MakeGroups();
  SqliteOptions options;
  options.min_free_bytes = std::int64_t{1} << 50;
  const auto storage = MustOpen(Path(), options);
  BlockingGroupWrites write(storage.get());
  const auto full = IsError(StatusCode::kResourceExhausted, "STORAGE_FULL", _);
  EXPECT_THAT(write.Create("three"), full);
  EXPECT_THAT(write.Change("one", {SetGroupPayload{"x"}}), full);
  EXPECT_THAT(
      write.Change("one", {RemoveGroupLink{"a"}, SetGroupMember{{1, "x"}}}),
      full);
  EXPECT_THAT(write.Change("one", {RemoveGroupLink{"a"}, RemoveGroupMember{1}}),
              IsOk());
  EXPECT_THAT(write.Delete("two"), IsOk());
  EXPECT_THAT(ToTexts(*storage->Groups().ListGroups("", "", 9)),
              ElementsAre("one uid: revision 3, 'payload'"));
}

TEST_F(SqliteGroupsTest, AStoreThatIsOpenedForReadingTakesNoGroups) {
  MakeGroups();
  const auto storage =
      OpenSqliteStorageToRead(Path(), SqliteDatabase::Mode::kReadOnly);
  ASSERT_THAT(storage, IsOk());
  BlockingGroupWrites write(storage->get());
  const auto refused = IsError(StatusCode::kFailedPrecondition, "INTERNAL",
                               HasSubstr("opened for reading"));
  EXPECT_THAT(write.Create("three"), refused);
  EXPECT_THAT(write.Change("one", {}), refused);
  EXPECT_THAT(write.Delete("one"), refused);
  EXPECT_EQ((*storage)->Groups().ListGroups("", "", 9)->size(), 2u);
}

}  // namespace
}  // namespace revisit::server
