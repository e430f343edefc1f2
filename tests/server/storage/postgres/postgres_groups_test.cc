// Groups in PostgreSQL, beyond what every storage promises: writers of several
// servers, and damage.
#include <cstdint>
#include <memory>
#include <optional>
#include <string>
#include <thread>
#include <vector>

#include "gmock/gmock.h"
#include "gtest/gtest.h"
#include "server/storage/postgres/connection.h"
#include "server/storage/postgres/postgres_check.h"
#include "server/storage/postgres/postgres_storage.h"
#include "tests/server/error_matchers.h"
#include "tests/server/storage/postgres/postgres_server.h"
#include "tests/server/storage_testing.h"
#include "tests/server/waiting.h"

namespace revisit::server {
namespace {

using absl::StatusCode;
using ::testing::_;
using ::testing::AnyOf;
using ::testing::ElementsAre;
using ::testing::HasSubstr;
using ::testing::IsEmpty;

AddGroupLink LinkOf(const std::string& id, VehicleKey query,
                    VehicleKey matched) {
  return {{id, LinkState::kConfirmed, {query, 1}, {matched, 2}}};
}

// One server has the vehicles; `other_` is a second one.
class PostgresGroupsTest : public ::testing::Test {
 protected:
  void SetUp() override {
    if (PostgresServer::Shared() == nullptr) {
      GTEST_SKIP() << "PostgreSQL's server programs are not installed";
    }
    conninfo_ = PostgresServer::Shared()->MakeStore();
    storage_ = *OpenPostgresStorage(conninfo_, {});
    other_ = *OpenPostgresStorage(conninfo_, {});
    PostgresConnection::Options options;
    options.conninfo = conninfo_;
    connection_ = *PostgresConnection::Open(options);
  }

  std::string Sql(const std::string& sql) const {
    return PostgresServer::Shared()->Run(conninfo_, sql);
  }
  // Statements of somebody else, whose transaction may stay open.
  void Run(const std::string& sql) const {
    EXPECT_THAT(connection_->RunText(sql), IsOk());
  }

  BlockingWrites write() { return BlockingWrites(storage_.get()); }
  BlockingGroupWrites write_groups() {
    return BlockingGroupWrites(storage_.get());
  }
  GroupStorage& groups() { return storage_->Groups(); }

  // Makes groups of these ids, in this order, with these members.
  void MakeGroups(const std::vector<std::string>& ids,
                  const std::vector<VehicleKey>& vehicles) {
    std::vector<GroupChange> members;
    for (const VehicleKey key : vehicles) {
      members.emplace_back(AddGroupMember{{key, "datum"}});
    }
    for (const std::string& id : ids) {
      ASSERT_THAT(write_groups().Create(id), IsOk());
      ASSERT_THAT(write_groups().Change(id, members), IsOk());
    }
  }

  // Waits until somebody waits for a row that the connection holds.
  void AwaitWaiter() const {
    constexpr Statement kWaits = {
        "somebody_waits",
        "SELECT EXISTS (SELECT 1 FROM pg_locks WHERE NOT granted)"};
    EXPECT_TRUE(Eventually(
        [&] { return connection_->Run(kWaits)->Integer(0, 0) != 0; }));
  }

  std::string conninfo_;
  std::unique_ptr<Storage> storage_;
  std::unique_ptr<Storage> other_;
  std::unique_ptr<PostgresConnection> connection_;
};

TEST_F(PostgresGroupsTest, LinksThatTwoServersAddAtATimeAllLand) {
  const VehicleKey truck = *write().Create("truck");
  const VehicleKey van = *write().Create("van");
  MakeGroups({"fleet"}, {truck, van});
  std::vector<std::thread> threads;
  for (Storage* server : {storage_.get(), other_.get()}) {
    threads.emplace_back([=] {
      const std::string name = server == storage_.get() ? "one-" : "two-";
      for (int i = 0; i < 30; ++i) {
        EXPECT_THAT(
            BlockingGroupWrites(server).Change(
                "fleet", {LinkOf(name + std::to_string(i), truck, van)}),
            IsOk());
      }
    });
  }
  for (std::thread& thread : threads) thread.join();
  EXPECT_EQ(groups().GetGroup("fleet")->version.revision, 62u);
  EXPECT_EQ(groups().ListLinks("fleet", "", 99)->size(), 60u);
}

TEST_F(PostgresGroupsTest, OfTwoServersThatExpectOneVersionOneWrites) {
  MakeGroups({"fleet"}, {});
  for (std::uint64_t revision = 2; revision < 22; ++revision) {
    const GroupVersion expected = {"uid", revision};
    Answer<absl::StatusOr<std::uint64_t>> mine;
    Answer<absl::StatusOr<std::uint64_t>> theirs;
    groups().ChangeGroup("fleet", expected, {}, mine.Setter());
    other_->Groups().ChangeGroup("fleet", expected, {}, theirs.Setter());
    EXPECT_NE(mine.Get().ok(), theirs.Get().ok());
    EXPECT_THAT(mine.Get().ok() ? theirs.Get() : mine.Get(),
                IsError(StatusCode::kAborted, "REVISION_MISMATCH", _));
  }
  EXPECT_EQ(groups().GetGroup("fleet")->version.revision, 22u);
}

TEST_F(PostgresGroupsTest, NoLinkStaysOfAVehicleThatIsDeletedMeanwhile) {
  const VehicleKey van = *write().Create("van");
  MakeGroups({"b", "a"}, {van});
  for (int round = 0; round < 15; ++round) {
    const VehicleKey truck = *write().Create("truck");
    for (const char* id : {"b", "a"}) {
      ASSERT_THAT(write_groups().Change(id, {AddGroupMember{{truck, ""}}}),
                  IsOk());
    }
    std::thread adding([&] {
      for (int i = 0; i < 8; ++i) {
        const std::string id = std::to_string(round) + "-" + std::to_string(i);
        EXPECT_THAT(
            BlockingGroupWrites(other_.get())
                .Change(i % 2 == 0 ? "b" : "a", {LinkOf(id, truck, van)}),
            AnyOf(IsOk(),
                  IsError(StatusCode::kNotFound, "MEMBER_NOT_FOUND", _)));
      }
    });
    EXPECT_THAT(write().Delete(truck), IsOk());
    adding.join();
    EXPECT_THAT(*groups().ListLinksOf(van, {}, 99), IsEmpty());
  }
  EXPECT_THAT(CheckDatabase(conninfo_)->problems, IsEmpty());
}

TEST_F(PostgresGroupsTest, VehiclesOfTheSameGroupsAreDeletedAtATime) {
  std::vector<std::string> ids;
  for (char id = 'z'; id >= 'a'; --id) ids.emplace_back(1, id);
  MakeGroups(ids, {});
  for (int round = 0; round < 5; ++round) {
    const VehicleKey mine = *write().Create("mine");
    const VehicleKey theirs = *BlockingWrites(other_.get()).Create("theirs");
    for (std::size_t i = 0; i < ids.size(); ++i) {
      const AddGroupMember first = {{i % 2 == 0 ? mine : theirs, ""}};
      const AddGroupMember second = {{i % 2 == 0 ? theirs : mine, ""}};
      ASSERT_THAT(write_groups().Change(ids[i], {first, second}), IsOk());
    }
    std::thread deleting([&] {
      EXPECT_THAT(BlockingWrites(other_.get()).Delete(theirs), IsOk());
    });
    EXPECT_THAT(write().Delete(mine), IsOk());
    deleting.join();
  }
  EXPECT_EQ(Sql("SELECT count(*) FROM group_members"), "0\n");
  EXPECT_EQ(Sql("SELECT DISTINCT revision FROM vehicle_groups"), "17\n");
}

TEST_F(PostgresGroupsTest, ADeletionLocksTheGroupsOfItsVehicleByTheirIds) {
  const VehicleKey truck = *write().Create("truck");
  MakeGroups({"c", "b", "a"}, {truck});
  Run("BEGIN; SELECT id FROM vehicle_groups WHERE id = 'b' FOR UPDATE");
  Answer<absl::Status> deleted;
  storage_->DeleteVehicle(truck, {}, deleted.Setter());
  AwaitWaiter();
  EXPECT_EQ(Sql("SELECT id FROM vehicle_groups WHERE id <> 'b' ORDER BY id "
                "FOR UPDATE SKIP LOCKED"),
            "c\n");
  Run("COMMIT");
  EXPECT_THAT(deleted.Get(), IsOk());
}

TEST_F(PostgresGroupsTest, ADeletionSeesAMemberThatWasAddedJustBefore) {
  const VehicleKey truck = *write().Create("truck");
  MakeGroups({"fleet"}, {});
  const std::string key = std::to_string(truck);
  // A server that adds the member writes this.
  Run("BEGIN; SELECT key FROM vehicles WHERE key = " + key +
      " FOR KEY SHARE; INSERT INTO group_members VALUES ('fleet', " + key +
      ", 4, 0, '')");
  Answer<absl::Status> deleted;
  storage_->DeleteVehicle(truck, {}, deleted.Setter());
  AwaitWaiter();
  Run("COMMIT");
  EXPECT_THAT(deleted.Get(), IsOk());
  EXPECT_EQ(Sql("SELECT count(*) FROM group_members"), "0\n");
  EXPECT_EQ(groups().GetGroup("fleet")->version.revision, 3u);
}

TEST_F(PostgresGroupsTest, AVehicleThatIsJustBeingDeletedBecomesNoMember) {
  const VehicleKey truck = *write().Create("truck");
  MakeGroups({"fleet"}, {});
  Run("BEGIN; DELETE FROM vehicles WHERE key = " + std::to_string(truck));
  Answer<absl::StatusOr<std::uint64_t>> added;
  groups().ChangeGroup("fleet", std::nullopt, {AddGroupMember{{truck, ""}}},
                       added.Setter());
  AwaitWaiter();
  // Meanwhile the group is free: who waits for a vehicle holds none.
  EXPECT_THAT(BlockingGroupWrites(other_.get()).Change("fleet", {}), IsOk());
  Run("COMMIT");
  EXPECT_THAT(added.Get(),
              IsError(StatusCode::kNotFound, "VEHICLE_NOT_FOUND", _));
  EXPECT_EQ(Sql("SELECT count(*) FROM group_members"), "0\n");
}

TEST_F(PostgresGroupsTest, ALinkSeesThatItsMemberHasJustLeft) {
  const VehicleKey truck = *write().Create("truck");
  const VehicleKey van = *write().Create("van");
  MakeGroups({"fleet"}, {truck, van});
  Run("BEGIN; UPDATE vehicle_groups SET revision = revision + 1; DELETE FROM "
      "group_members WHERE vehicle_key = " +
      std::to_string(truck));
  Answer<absl::StatusOr<std::uint64_t>> added;
  groups().ChangeGroup("fleet", std::nullopt, {LinkOf("a", truck, van)},
                       added.Setter());
  AwaitWaiter();
  // Other groups, and vehicles, do not wait for this one.
  EXPECT_THAT(write().Append(van, {1, 1, 2, "x"}), IsOk());
  EXPECT_THAT(BlockingGroupWrites(other_.get()).Create("other"), IsOk());
  Run("COMMIT");
  EXPECT_THAT(added.Get(),
              IsError(StatusCode::kNotFound, "MEMBER_NOT_FOUND", _));
  EXPECT_THAT(*groups().ListLinks("fleet", "", 9), IsEmpty());
}

TEST_F(PostgresGroupsTest, AServerThatStopsInAWriteHoldsAGroupForSomeSeconds) {
  MakeGroups({"fleet"}, {});
  PostgresConnection::Options options;
  options.conninfo = conninfo_;
  options.writes = true;
  const auto stopped = PostgresConnection::Open(options);
  ASSERT_THAT((*stopped)->RunText("BEGIN; UPDATE vehicle_groups SET revision = "
                                  "revision + 1"),
              IsOk());
  EXPECT_THAT(write_groups().Change("fleet", {}),
              IsError(StatusCode::kUnavailable, "STORE_UNAVAILABLE", _));
  EXPECT_TRUE(
      Eventually([&] { return write_groups().Change("fleet", {}).ok(); }));
  EXPECT_EQ(groups().GetGroup("fleet")->version.revision, 3u);
}

TEST_F(PostgresGroupsTest, ServersOfTheVersionBeforeLeaveGroupsRight) {
  const VehicleKey truck = *write().Create("truck");
  const VehicleKey van = *write().Create("van");
  ASSERT_THAT(write().Append(truck, {1, 9, 2, "a"}), IsOk());
  MakeGroups({"fleet"}, {truck, van});
  AddGroupLink late = LinkOf("late", truck, van);
  late.link.query.sequence = 5;
  ASSERT_THAT(
      write_groups().Change("fleet", {LinkOf("early", van, truck), late}),
      IsOk());
  // These write a loss that is accepted, and a deletion.
  const std::string of_truck = " WHERE key = " + std::to_string(truck);
  Sql("UPDATE heads SET durable_sequence = 4" + of_truck);
  EXPECT_THAT(ToTexts(*groups().ListLinks("fleet", "", 9)),
              ElementsAre(HasSubstr("early")));
  EXPECT_EQ(groups().GetGroup("fleet")->version.revision, 4u);
  Sql("DELETE FROM heads" + of_truck + "; DELETE FROM vehicles" + of_truck);
  EXPECT_THAT(*groups().ListLinks("fleet", "", 9), IsEmpty());
  EXPECT_THAT(ToTexts(*groups().ListMembers("fleet", "", 9)),
              ElementsAre("van: 'datum'"));
  EXPECT_EQ(groups().GetGroup("fleet")->version.revision, 5u);
}

TEST_F(PostgresGroupsTest, DamageAffectsItsRowOnlyAndIsFoundByACheck) {
  const VehicleKey truck = *write().Create("truck");
  const VehicleKey van = *write().Create("van");
  MakeGroups({"one", "two"}, {truck, van});
  ASSERT_THAT(write_groups().Change(
                  "one", {LinkOf("a", truck, van), LinkOf("b", van, truck)}),
              IsOk());
  auto report = CheckDatabase(conninfo_);
  ASSERT_THAT(report, IsOk());
  EXPECT_THAT(report->problems, IsEmpty());
  EXPECT_EQ(report->groups, 2);
  EXPECT_EQ(report->members, 4);
  EXPECT_EQ(report->links, 2);
  Sql("UPDATE vehicle_groups SET payload = 'x' WHERE id = 'one'; UPDATE "
      "group_members SET payload = 'x' WHERE group_id = 'one' AND vehicle_key "
      "= " +
      std::to_string(truck) +
      "; UPDATE group_links SET state = 3 WHERE id = 'a'");
  EXPECT_THAT(ToTexts(*groups().ListGroups("", "", 9)),
              ElementsAre("one uid: revision 3, '', damaged",
                          "two uid: revision 2, 'payload'"));
  EXPECT_THAT(ToTexts(*groups().ListMembers("one", "", 9)),
              ElementsAre("truck: '', damaged", "van: 'datum'"));
  EXPECT_THAT(ToTexts(*groups().ListLinks("one", "", 9)),
              ElementsAre("a, damaged", HasSubstr("b, confirmed")));
  report = CheckDatabase(conninfo_);
  EXPECT_THAT(report->problems,
              ElementsAre(HasSubstr("group 'one' fails"),
                          HasSubstr("member 'truck' of group 'one' fails"),
                          HasSubstr("link 'a' of group 'one' fails")));
  const auto damaged = IsError(StatusCode::kDataLoss, "STORE_CORRUPT", _);
  EXPECT_THAT(write_groups().Change("one", {SetGroupPayload{"x"}}), damaged);
  EXPECT_THAT(write_groups().Change(
                  "one", {SetGroupLink{"a", LinkState::kSuspect, ""}}),
              damaged);
  EXPECT_THAT(write_groups().Change("one", {SetGroupMember{{truck, "new"}},
                                            RemoveGroupLink{"a"}}),
              IsOk());
  EXPECT_THAT(write_groups().Delete("one"), IsOk());
  EXPECT_THAT(CheckDatabase(conninfo_)->problems, IsEmpty());
}

TEST_F(PostgresGroupsTest, ACheckFindsRowsThatBelongToNoGroupOrMember) {
  const VehicleKey truck = *write().Create("truck");
  MakeGroups({"fleet"}, {truck});
  ASSERT_THAT(write_groups().Change("fleet", {LinkOf("a", truck, truck)}),
              IsOk());
  Sql("DELETE FROM vehicle_groups");
  EXPECT_THAT(CheckDatabase(conninfo_)->problems,
              ElementsAre("1 members belong to no group or are no vehicle"));
  Sql("DELETE FROM group_members");
  EXPECT_THAT(CheckDatabase(conninfo_)->problems,
              ElementsAre("1 loop closures of groups name vehicles that are no "
                          "members"));
}

}  // namespace
}  // namespace revisit::server
