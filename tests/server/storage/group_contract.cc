// The tests of what group_storage.h promises, of which storage_contract.h says
// how they are run.
#include <algorithm>
#include <map>
#include <optional>
#include <random>
#include <string>
#include <utility>
#include <vector>

#include "gmock/gmock.h"
#include "tests/random.h"
#include "tests/server/error_matchers.h"
#include "tests/server/memory_storage.h"
#include "tests/server/storage/storage_contract.h"

namespace revisit::server {

using absl::StatusCode;
using ::testing::_;
using ::testing::ElementsAre;
using ::testing::IsEmpty;

namespace {

AddGroupMember Add(VehicleKey vehicle, const std::string& payload = "datum") {
  return {{vehicle, payload}};
}

// A confirmed link.
AddGroupLink Link(const std::string& id, VehiclePose query, VehiclePose matched,
                  const std::string& payload = "") {
  return {{id, LinkState::kConfirmed, query, matched, payload}};
}

std::vector<std::string> Ids(
    const absl::StatusOr<std::vector<GroupRecord>>& groups) {
  EXPECT_THAT(groups, IsOk());
  std::vector<std::string> ids;
  for (const GroupRecord& group : *groups) ids.push_back(group.id);
  return ids;
}

std::vector<std::string> Ids(
    const absl::StatusOr<std::vector<PlacedLink>>& links) {
  EXPECT_THAT(links, IsOk());
  std::vector<std::string> ids;
  for (const PlacedLink& link : *links) {
    ids.push_back(link.group + "/" + link.link.id);
  }
  return ids;
}

}  // namespace

std::uint64_t GroupContract::RevisionOf(const std::string& id) {
  const absl::StatusOr<GroupRecord> group = groups().GetGroup(id);
  EXPECT_THAT(group, IsOk());
  return group.ok() ? group->version.revision : 0;
}

TEST_P(GroupContract, ReadsBackTheGroupThatWasCreated) {
  // Bytes of every value, the zero byte too.
  std::string payload;
  for (int i = 0; i < 256; ++i) payload.push_back(static_cast<char>(i));
  const auto revision = write_groups().Create("fleet", payload, "first");
  ASSERT_THAT(revision, IsOk());
  EXPECT_EQ(*revision, 1u);
  store_->Reopen();
  const absl::StatusOr<GroupRecord> group = groups().GetGroup("fleet");
  ASSERT_THAT(group, IsOk());
  EXPECT_THAT(group->damage, IsOk());
  EXPECT_EQ(group->id, "fleet");
  EXPECT_EQ(group->payload, payload);
  EXPECT_EQ(group->version, (GroupVersion{"first", 1}));
  EXPECT_THAT(*groups().ListMembers("fleet", "", 9), IsEmpty());
  EXPECT_THAT(*groups().ListLinks("fleet", "", 9), IsEmpty());
}

TEST_P(GroupContract, RefusesGroupIdThatIsTaken) {
  ASSERT_THAT(write_groups().Create("fleet", "first"), IsOk());
  EXPECT_THAT(write_groups().Create("fleet", "second"),
              IsError(StatusCode::kAlreadyExists, "GROUP_EXISTS", _));
  EXPECT_EQ(ToText(*groups().GetGroup("fleet")),
            "fleet uid: revision 1, 'first'");
  // A vehicle may have the name of a group.
  EXPECT_THAT(write().Create("fleet"), IsOk());
}

TEST_P(GroupContract, AnswersNotFoundForIdOfNoGroup) {
  ASSERT_THAT(write_groups().Create("fleet"), IsOk());
  const auto not_found = IsError(StatusCode::kNotFound, "GROUP_NOT_FOUND", _);
  EXPECT_THAT(groups().GetGroup("none"), not_found);
  EXPECT_THAT(groups().ListMembers("none", "", 9), not_found);
  EXPECT_THAT(groups().ListLinks("none", "", 9), not_found);
  EXPECT_THAT(write_groups().Delete("none"), not_found);
  const VehicleKey truck = *write().Create("truck");
  for (const GroupChange& change : std::vector<GroupChange>{
           SetGroupPayload{"x"}, Add(truck), SetGroupMember{{truck, "x"}},
           RemoveGroupMember{truck}, Link("a", {truck, 1}, {truck, 2}),
           SetGroupLink{"a", LinkState::kSuspect, ""}, RemoveGroupLink{"a"}}) {
    EXPECT_THAT(write_groups().Change("none", {change}), not_found);
    EXPECT_THAT(write_groups().Change("none", {change}, GroupVersion{"uid", 1}),
                not_found);
  }
}

TEST_P(GroupContract, AnswersNotFoundForGroupsOfNoVehicle) {
  const auto not_found = IsError(StatusCode::kNotFound, "VEHICLE_NOT_FOUND", _);
  EXPECT_THAT(groups().ListGroupsOf(99), not_found);
  EXPECT_THAT(groups().ListLinksOf(99, {}, 9), not_found);
  const VehicleKey truck = *write().Create("truck");
  EXPECT_THAT(*groups().ListGroupsOf(truck), IsEmpty());
  EXPECT_THAT(*groups().ListLinksOf(truck, {}, 9), IsEmpty());
}

TEST_P(GroupContract, ListsGroupsByIdInPages) {
  for (const char* id : {"c", "a", "b10", "b", "b-1"}) {
    ASSERT_THAT(write_groups().Create(id), IsOk());
  }
  EXPECT_THAT(Ids(groups().ListGroups("", "", 9)),
              ElementsAre("a", "b", "b-1", "b10", "c"));
  EXPECT_THAT(Ids(groups().ListGroups("b", "", 2)), ElementsAre("b-1", "b10"));
  EXPECT_THAT(Ids(groups().ListGroups("c", "", 9)), IsEmpty());
  EXPECT_THAT(Ids(groups().ListGroups("", "b", 9)),
              ElementsAre("b", "b-1", "b10"));
  EXPECT_THAT(Ids(groups().ListGroups("b", "b1", 9)), ElementsAre("b10"));
  EXPECT_THAT(Ids(groups().ListGroups("", "bb", 9)), IsEmpty());
}

TEST_P(GroupContract, EachWriteRaisesTheRevisionOfItsGroupByOne) {
  const VehicleKey truck = *write().Create("truck");
  const VehicleKey van = *write().Create("van");
  ASSERT_THAT(write_groups().Create("fleet"), IsOk());
  ASSERT_THAT(write_groups().Create("other"), IsOk());
  std::uint64_t revision = 1;
  for (const std::vector<GroupChange>& changes :
       std::vector<std::vector<GroupChange>>{
           {SetGroupPayload{"new"}},
           {Add(truck), Add(van)},
           {SetGroupMember{{van, "other datum"}}},
           {Link("a", {truck, 1}, {van, 2}), Link("b", {van, 3}, {truck, 4})},
           {SetGroupLink{"a", LinkState::kSuspect, "doubt"}},
           {RemoveGroupLink{"b"}},
           {RemoveGroupMember{truck}},
           {}}) {
    const auto written = write_groups().Change("fleet", changes);
    ASSERT_THAT(written, IsOk());
    EXPECT_EQ(*written, ++revision);
    EXPECT_EQ(RevisionOf("fleet"), revision);
  }
  EXPECT_EQ(RevisionOf("other"), 1u);
  store_->Reopen();
  EXPECT_EQ(ToText(*groups().GetGroup("fleet")),
            "fleet uid: revision 9, 'new'");
  EXPECT_EQ(*write_groups().Delete("fleet"), 10u);
}

TEST_P(GroupContract, RefusesWritesOfAGroupThatIsNotAsExpected) {
  const VehicleKey truck = *write().Create("truck");
  ASSERT_THAT(write_groups().Create("fleet", "first", "old"), IsOk());
  const GroupVersion first = {"old", 1};
  ASSERT_THAT(write_groups().Change("fleet", {Add(truck)}, first), IsOk());
  const auto refused = IsError(StatusCode::kAborted, "REVISION_MISMATCH", _);
  // A caller whose answer was lost sends the change again.
  const auto again = write_groups().Change("fleet", {Add(truck)}, first);
  EXPECT_THAT(again, refused);
  EXPECT_EQ(MetadataOf(again.status(), "revision"), "2");
  EXPECT_THAT(write_groups().Change("fleet", {SetGroupPayload{"x"}}, first),
              refused);
  EXPECT_THAT(write_groups().Delete("fleet", first), refused);
  EXPECT_EQ(ToText(*groups().GetGroup("fleet")),
            "fleet old: revision 2, 'first'");
  ASSERT_THAT(write_groups().Delete("fleet", GroupVersion{"old", 2}), IsOk());
  // Another group of the id may come to the same revision.
  ASSERT_THAT(write_groups().Create("fleet", "second", "new"), IsOk());
  EXPECT_THAT(write_groups().Change("fleet", {}, first), refused);
  EXPECT_THAT(write_groups().Change("fleet", {}, GroupVersion{"new", 1}),
              IsOk());
}

TEST_P(GroupContract, MakesAllChangesOfAWriteOrNone) {
  const VehicleKey truck = *write().Create("truck");
  const VehicleKey van = *write().Create("van");
  ASSERT_THAT(write_groups().Create("fleet", "old"), IsOk());
  ASSERT_THAT(write_groups().Change("fleet", {Add(van)}), IsOk());
  EXPECT_THAT(
      write_groups().Change(
          "fleet", {SetGroupPayload{"new"}, Add(truck),
                    Link("a", {truck, 1}, {van, 2}), RemoveGroupLink{"b"}}),
      IsError(StatusCode::kNotFound, "LOOP_CLOSURE_NOT_FOUND", _));
  store_->Reopen();
  EXPECT_EQ(ToText(*groups().GetGroup("fleet")),
            "fleet uid: revision 2, 'old'");
  EXPECT_THAT(ToTexts(*groups().ListMembers("fleet", "", 9)),
              ElementsAre("van: 'datum'"));
  EXPECT_THAT(*groups().ListLinks("fleet", "", 9), IsEmpty());
  // Each change sees those before it.
  ASSERT_THAT(write_groups().Change(
                  "fleet", {Add(truck), Link("a", {truck, 1}, {van, 2}),
                            RemoveGroupMember{van}, Add(van)}),
              IsOk());
  EXPECT_THAT(ToTexts(*groups().ListMembers("fleet", "", 9)),
              ElementsAre("truck: 'datum'", "van: 'datum'"));
  EXPECT_THAT(*groups().ListLinks("fleet", "", 9), IsEmpty());
}

TEST_P(GroupContract, AMemberIsAVehicleThatIsThereAndIsOneOnce) {
  const VehicleKey van = *write().Create("van");
  const VehicleKey truck = *write().Create("truck");
  ASSERT_THAT(write_groups().Create("fleet"), IsOk());
  EXPECT_THAT(write_groups().Change("fleet", {Add(99)}),
              IsError(StatusCode::kNotFound, "VEHICLE_NOT_FOUND", _));
  const auto no_member = IsError(StatusCode::kNotFound, "MEMBER_NOT_FOUND", _);
  EXPECT_THAT(write_groups().Change("fleet", {SetGroupMember{{van, "x"}}}),
              no_member);
  EXPECT_THAT(write_groups().Change("fleet", {RemoveGroupMember{van}}),
              no_member);
  ASSERT_THAT(write_groups().Change("fleet", {Add(van, "first")}), IsOk());
  EXPECT_THAT(write_groups().Change("fleet", {Add(van, "second")}),
              IsError(StatusCode::kAlreadyExists, "MEMBER_EXISTS", _));
  ASSERT_THAT(write_groups().Change("fleet", {Add(truck, "")}), IsOk());
  store_->Reopen();
  auto members = groups().ListMembers("fleet", "", 9);
  ASSERT_THAT(members, IsOk());
  EXPECT_THAT(ToTexts(*members), ElementsAre("truck: ''", "van: 'first'"));
  EXPECT_EQ((*members)[0].vehicle, truck);
  EXPECT_EQ((*members)[1].vehicle, van);
  EXPECT_THAT(ToTexts(*groups().ListMembers("fleet", "", 1)),
              ElementsAre("truck: ''"));
  EXPECT_THAT(ToTexts(*groups().ListMembers("fleet", "truck", 9)),
              ElementsAre("van: 'first'"));
  ASSERT_THAT(write_groups().Change("fleet", {SetGroupMember{{van, "third"}}}),
              IsOk());
  ASSERT_THAT(write_groups().Change("fleet", {RemoveGroupMember{truck}}),
              IsOk());
  EXPECT_THAT(ToTexts(*groups().ListMembers("fleet", "", 9)),
              ElementsAre("van: 'third'"));
}

TEST_P(GroupContract, ListsTheGroupsOfAVehicle) {
  const VehicleKey truck = *write().Create("truck");
  const VehicleKey van = *write().Create("van");
  for (const char* id : {"c", "a", "b"}) {
    ASSERT_THAT(write_groups().Create(id), IsOk());
    ASSERT_THAT(write_groups().Change(id, {Add(truck)}), IsOk());
  }
  ASSERT_THAT(write_groups().Change("b", {Add(van)}), IsOk());
  store_->Reopen();
  EXPECT_THAT(*groups().ListGroupsOf(truck), ElementsAre("a", "b", "c"));
  EXPECT_THAT(*groups().ListGroupsOf(van), ElementsAre("b"));
}

TEST_P(GroupContract, ALinkJoinsMembersOfItsGroupOnly) {
  const VehicleKey truck = *write().Create("truck");
  const VehicleKey van = *write().Create("van");
  ASSERT_THAT(write_groups().Create("fleet"), IsOk());
  ASSERT_THAT(write_groups().Create("other"), IsOk());
  ASSERT_THAT(write_groups().Change("other", {Add(truck), Add(van)}), IsOk());
  ASSERT_THAT(write_groups().Change("fleet", {Add(truck)}), IsOk());
  const auto no_member = IsError(StatusCode::kNotFound, "MEMBER_NOT_FOUND", _);
  EXPECT_THAT(write_groups().Change("fleet", {Link("a", {truck, 1}, {van, 2})}),
              no_member);
  EXPECT_THAT(write_groups().Change("fleet", {Link("a", {van, 1}, {truck, 2})}),
              no_member);
  EXPECT_THAT(write_groups().Change("fleet", {Link("a", {99, 1}, {truck, 2})}),
              no_member);
  EXPECT_EQ(RevisionOf("fleet"), 2u);
  EXPECT_THAT(write_groups().Change("other", {Link("a", {truck, 1}, {van, 2})}),
              IsOk());
}

TEST_P(GroupContract, KeepsLinksAsTheyWereAddedAndSet) {
  const VehicleKey truck = *write().Create("truck");
  const VehicleKey van = *write().Create("van");
  const std::string of_truck = " of " + std::to_string(truck);
  const std::string of_van = " of " + std::to_string(van);
  ASSERT_THAT(write_groups().Create("fleet"), IsOk());
  ASSERT_THAT(write_groups().Change("fleet", {Add(truck), Add(van)}), IsOk());
  AddGroupLink tentative = Link("b", {van, kLastSequence}, {truck, 4}, "mark");
  tentative.link.state = LinkState::kTentative;
  ASSERT_THAT(write_groups().Change("fleet",
                                    {Link("c", {truck, 1}, {van, 2}), tentative,
                                     Link("a", {truck, 5}, {truck, 6}, "one")}),
              IsOk());
  EXPECT_THAT(
      write_groups().Change("fleet", {Link("a", {truck, 5}, {truck, 6})}),
      IsError(StatusCode::kAlreadyExists, "LOOP_CLOSURE_EXISTS", _));
  store_->Reopen();
  const std::string a =
      "a, confirmed: 5" + of_truck + " at 6" + of_truck + ", 'one'";
  const std::string b = "b, tentative: " + std::to_string(kLastSequence) +
                        of_van + " at 4" + of_truck + ", 'mark'";
  const std::string c = "c, confirmed: 1" + of_truck + " at 2" + of_van;
  EXPECT_THAT(ToTexts(*groups().ListLinks("fleet", "", 9)),
              ElementsAre(a, b, c + ", ''"));
  EXPECT_THAT(ToTexts(*groups().ListLinks("fleet", "", 2)), ElementsAre(a, b));
  EXPECT_THAT(ToTexts(*groups().ListLinks("fleet", "b", 2)),
              ElementsAre(c + ", ''"));
  ASSERT_THAT(
      write_groups().Change(
          "fleet", {RemoveGroupLink{"a"},
                    SetGroupLink{"c", LinkState::kSuspect, "contradicted"}}),
      IsOk());
  store_->Reopen();
  EXPECT_THAT(ToTexts(*groups().ListLinks("fleet", "", 9)),
              ElementsAre(b, "c, suspect: 1" + of_truck + " at 2" + of_van +
                                 ", 'contradicted'"));
  const auto no_link =
      IsError(StatusCode::kNotFound, "LOOP_CLOSURE_NOT_FOUND", _);
  EXPECT_THAT(write_groups().Change("fleet", {RemoveGroupLink{"a"}}), no_link);
  EXPECT_THAT(write_groups().Change(
                  "fleet", {SetGroupLink{"a", LinkState::kSuspect, ""}}),
              no_link);
}

TEST_P(GroupContract, ListsTheLinksOfAVehicleInAllItsGroups) {
  const VehicleKey truck = *write().Create("truck");
  const VehicleKey van = *write().Create("van");
  const VehicleKey bus = *write().Create("bus");
  for (const char* id : {"two", "one"}) {
    ASSERT_THAT(write_groups().Create(id), IsOk());
    ASSERT_THAT(write_groups().Change(id, {Add(truck), Add(van), Add(bus),
                                           Link("d", {truck, 1}, {van, 2}),
                                           Link("b", {van, 3}, {truck, 4}),
                                           Link("c", {van, 5}, {bus, 6}),
                                           Link("a", {truck, 7}, {truck, 8})}),
                IsOk());
  }
  EXPECT_THAT(
      Ids(groups().ListLinksOf(truck, {}, 9)),
      ElementsAre("one/a", "one/b", "one/d", "two/a", "two/b", "two/d"));
  EXPECT_THAT(Ids(groups().ListLinksOf(truck, {"one", "a"}, 3)),
              ElementsAre("one/b", "one/d", "two/a"));
  EXPECT_THAT(Ids(groups().ListLinksOf(truck, {"two", "b"}, 9)),
              ElementsAre("two/d"));
  EXPECT_THAT(Ids(groups().ListLinksOf(truck, {"two", ""}, 9)),
              ElementsAre("two/a", "two/b", "two/d"));
  EXPECT_THAT(Ids(groups().ListLinksOf(bus, {}, 9)),
              ElementsAre("one/c", "two/c"));
  EXPECT_EQ((*groups().ListLinksOf(bus, {}, 9))[0].link.matched,
            (VehiclePose{bus, 6}));
}

TEST_P(GroupContract, AMemberThatLeavesTakesItsLinksInThatGroupAlong) {
  const VehicleKey truck = *write().Create("truck");
  const VehicleKey van = *write().Create("van");
  const VehicleKey bus = *write().Create("bus");
  for (const char* id : {"fleet", "other"}) {
    ASSERT_THAT(write_groups().Create(id), IsOk());
    ASSERT_THAT(write_groups().Change(id, {Add(truck), Add(van), Add(bus),
                                           Link("a", {truck, 1}, {van, 2}),
                                           Link("b", {bus, 3}, {truck, 4}),
                                           Link("c", {van, 5}, {bus, 6})}),
                IsOk());
  }
  ASSERT_THAT(write_groups().Change("fleet", {RemoveGroupMember{truck}}),
              IsOk());
  EXPECT_THAT(Ids(groups().ListLinksOf(van, {}, 9)),
              ElementsAre("fleet/c", "other/a", "other/c"));
  EXPECT_THAT(Ids(groups().ListLinksOf(truck, {}, 9)),
              ElementsAre("other/a", "other/b"));
  EXPECT_THAT(*groups().ListGroupsOf(truck), ElementsAre("other"));
}

TEST_P(GroupContract, AVehicleThatIsDeletedLeavesItsGroupsInTheSameStep) {
  const VehicleKey truck = *write().Create("truck");
  const VehicleKey van = *write().Create("van");
  for (const char* id : {"b", "a", "c"}) {
    ASSERT_THAT(write_groups().Create(id), IsOk());
    ASSERT_THAT(write_groups().Change(id, {Add(van)}), IsOk());
  }
  for (const char* id : {"a", "b"}) {
    ASSERT_THAT(
        write_groups().Change(id, {Add(truck), Link("a", {truck, 1}, {van, 2}),
                                   Link("b", {van, 3}, {truck, 4}),
                                   Link("c", {van, 5}, {van, 6})}),
        IsOk());
  }
  ASSERT_THAT(write().Delete(truck), IsOk());
  store_->Reopen();
  EXPECT_THAT(ToTexts(*groups().ListGroups("", "", 9)),
              ElementsAre("a uid: revision 4, 'payload'",
                          "b uid: revision 4, 'payload'",
                          "c uid: revision 2, 'payload'"));
  for (const char* id : {"a", "b", "c"}) {
    EXPECT_THAT(ToTexts(*groups().ListMembers(id, "", 9)),
                ElementsAre("van: 'datum'"));
  }
  EXPECT_THAT(Ids(groups().ListLinksOf(van, {}, 9)), ElementsAre("a/c", "b/c"));
  // A vehicle of its name is another one.
  const VehicleKey again = *write().Create("truck");
  EXPECT_THAT(*groups().ListGroupsOf(again), IsEmpty());
  EXPECT_THAT(write_groups().Change("a", {Link("d", {truck, 1}, {van, 2})}),
              IsError(StatusCode::kNotFound, "MEMBER_NOT_FOUND", _));
  EXPECT_THAT(write_groups().Change("a", {Add(truck)}),
              IsError(StatusCode::kNotFound, "VEHICLE_NOT_FOUND", _));
}

TEST_P(GroupContract, LinksGoWithThePosesThatAreGivenUp) {
  const VehicleKey truck = *write().Create("truck");
  const VehicleKey van = *write().Create("van");
  for (const VehicleKey key : {truck, van}) {
    ASSERT_THAT(write().Append(key, {1, 4, 2, "a"}), IsOk());
    ASSERT_THAT(write().Append(key, {5, 4, 3, "b"}), IsOk());
  }
  for (const char* id : {"a", "b"}) {
    ASSERT_THAT(write_groups().Create(id), IsOk());
    ASSERT_THAT(write_groups().Change(id, {Add(truck), Add(van),
                                           Link("kept", {truck, 4}, {van, 8})}),
                IsOk());
  }
  ASSERT_THAT(write_groups().Change("a", {Link("query", {truck, 5}, {van, 1}),
                                          Link("matched", {van, 1}, {truck, 8}),
                                          Link("van", {van, 5}, {van, 8})}),
              IsOk());
  ASSERT_THAT(write().DropDamaged(truck, 4, "x", 9), IsOk());
  store_->Reopen();
  EXPECT_THAT(Ids(groups().ListLinksOf(van, {}, 9)),
              ElementsAre("a/kept", "a/van", "b/kept"));
  EXPECT_EQ(RevisionOf("a"), 4u);
  EXPECT_EQ(RevisionOf("b"), 2u);
  EXPECT_THAT(*groups().ListGroupsOf(truck), ElementsAre("a", "b"));
}

TEST_P(GroupContract, DeletesAGroupWithAllThatBelongsToIt) {
  const VehicleKey truck = *write().Create("truck");
  for (const char* id : {"fleet", "other"}) {
    ASSERT_THAT(write_groups().Create(id, "old"), IsOk());
    ASSERT_THAT(write_groups().Change(
                    id, {Add(truck), Link("a", {truck, 1}, {truck, 2})}),
                IsOk());
  }
  ASSERT_THAT(write_groups().Delete("fleet"), IsOk());
  store_->Reopen();
  EXPECT_THAT(groups().GetGroup("fleet"),
              IsError(StatusCode::kNotFound, "GROUP_NOT_FOUND", _));
  EXPECT_THAT(*groups().ListGroupsOf(truck), ElementsAre("other"));
  EXPECT_THAT(Ids(groups().ListLinksOf(truck, {}, 9)), ElementsAre("other/a"));
  ASSERT_THAT(write_groups().Create("fleet", "new", "another"), IsOk());
  EXPECT_EQ(ToText(*groups().GetGroup("fleet")),
            "fleet another: revision 1, 'new'");
  EXPECT_THAT(*groups().ListMembers("fleet", "", 9), IsEmpty());
  EXPECT_THAT(*groups().ListLinks("fleet", "", 9), IsEmpty());
}

TEST_P(GroupContract, TellsTheVersionsOfAllGroupsOrOfSome) {
  for (const char* id : {"c", "a", "b"}) {
    ASSERT_THAT(write_groups().Create(id, "payload", std::string("of ") + id),
                IsOk());
  }
  ASSERT_THAT(write_groups().Change("b", {}), IsOk());
  const std::string a = "a of a: revision 1, ''";
  const std::string b = "b of b: revision 2, ''";
  EXPECT_THAT(ToTexts(*groups().ListGroupVersions(std::nullopt)),
              ElementsAre(a, b, "c of c: revision 1, ''"));
  EXPECT_THAT(ToTexts(*groups().ListGroupVersions(
                  std::vector<std::string>{"b", "none", "a", "b"})),
              ElementsAre(a, b));
  EXPECT_THAT(*groups().ListGroupVersions(std::vector<std::string>()),
              IsEmpty());
}

TEST_P(GroupContract, GroupsDoWhatTheModelDoes) {
  std::mt19937_64 random = SeededRandom();
  MemoryStorage model;
  const std::vector<std::string> vehicle_ids = {"u", "v", "w"};
  const std::vector<std::string> group_ids = {"a", "b", "c"};
  const std::vector<std::string> link_ids = {"x", "y", "z"};
  // The keys that the vehicles have here and there; one never was, and those
  // that are gone stay.
  std::vector<std::pair<VehicleKey, VehicleKey>> keys = {{99999, 99999}};
  const auto pick = [&](const auto& options) {
    return options[static_cast<std::size_t>(
        UniformInt(random, 0, static_cast<int>(options.size()) - 1))];
  };
  // All of a storage's groups, with the keys of the model.
  const auto everything = [&](Storage& from, bool is_real) {
    std::vector<std::string> texts;
    const auto in_model = [&](VehiclePose* end) {
      for (const auto& [real, modelled] : keys) {
        if (is_real && end->vehicle == real) {
          end->vehicle = modelled;
          return;
        }
      }
    };
    const auto add_link = [&](GroupLinkRecord link) {
      in_model(&link.query);
      in_model(&link.matched);
      texts.push_back(ToText(link));
    };
    GroupStorage& all = from.Groups();
    const auto groups = all.ListGroups("", "", 9);
    EXPECT_THAT(groups, IsOk());
    for (const GroupRecord& group : *groups) {
      texts.push_back(ToText(group));
      for (const std::string& member :
           ToTexts(*all.ListMembers(group.id, "", 9))) {
        texts.push_back(member);
      }
      const auto links = all.ListLinks(group.id, "", 9);
      for (const GroupLinkRecord& link : *links) add_link(link);
    }
    for (const auto& [real, modelled] : keys) {
      const VehicleKey key = is_real ? real : modelled;
      const auto groups_of = all.ListGroupsOf(key);
      texts.push_back(ReasonOf(groups_of.status()));
      if (!groups_of.ok()) continue;
      texts.insert(texts.end(), groups_of->begin(), groups_of->end());
      const auto links = all.ListLinksOf(key, {}, 99);
      for (const PlacedLink& link : *links) {
        texts.push_back(link.group);
        add_link(link.link);
      }
    }
    return texts;
  };
  for (int step = 0; step < 400; ++step) {
    SCOPED_TRACE("step " + std::to_string(step));
    if (UniformInt(random, 0, 99) == 0) store_->Reopen();
    const std::string payload(
        static_cast<std::size_t>(UniformInt(random, 0, 3000)),
        static_cast<char>(UniformInt(random, 0, 255)));
    if (UniformInt(random, 0, 9) == 0) {
      const std::string id = pick(vehicle_ids);
      const auto real = write().Create(id);
      const auto modelled = BlockingWrites(&model).Create(id);
      ASSERT_EQ(real.ok(), modelled.ok());
      if (real.ok()) keys.emplace_back(*real, *modelled);
    }
    if (UniformInt(random, 0, 19) == 0) {
      const auto key = pick(keys);
      ASSERT_EQ(write().Delete(key.first).code(),
                BlockingWrites(&model).Delete(key.second).code());
    }
    const std::string id = pick(group_ids);
    std::optional<GroupVersion> expected;
    if (UniformInt(random, 0, 2) == 0) {
      const auto group = model.Groups().GetGroup(id);
      expected.emplace();
      if (group.ok()) expected = group->version;
      if (UniformInt(random, 0, 3) == 0) ++expected->revision;
    }
    absl::StatusOr<std::uint64_t> real;
    absl::StatusOr<std::uint64_t> modelled;
    const int kind = UniformInt(random, 0, 19);
    if (kind < 2) {
      const std::string uid = std::to_string(step);
      real = write_groups().Create(id, payload, uid);
      modelled = BlockingGroupWrites(&model).Create(id, payload, uid);
    } else if (kind == 2) {
      real = write_groups().Delete(id, expected);
      modelled = BlockingGroupWrites(&model).Delete(id, expected);
    } else {
      std::vector<GroupChange> here;
      std::vector<GroupChange> there;
      for (int i = UniformInt(random, 0, 2); i >= 0; --i) {
        // Mostly some of the newest.
        const auto vehicle =
            UniformInt(random, 0, 3) == 0 ? pick(keys) : keys.back();
        const auto other =
            UniformInt(random, 0, 1) == 0
                ? pick(keys)
                : keys[keys.size() - std::min<std::size_t>(2, keys.size())];
        const std::string link = pick(link_ids);
        const auto state = static_cast<LinkState>(UniformInt(random, 1, 4));
        const auto sequence =
            static_cast<std::uint64_t>(UniformInt(random, 1, 99));
        switch (UniformInt(random, 0, 10)) {
          case 0:
            here.emplace_back(SetGroupPayload{payload});
            there.emplace_back(SetGroupPayload{payload});
            break;
          case 1:
            here.emplace_back(SetGroupMember{{vehicle.first, payload}});
            there.emplace_back(SetGroupMember{{vehicle.second, payload}});
            break;
          case 2:
            here.emplace_back(RemoveGroupMember{vehicle.first});
            there.emplace_back(RemoveGroupMember{vehicle.second});
            break;
          case 3:
            here.emplace_back(SetGroupLink{link, state, payload});
            there.emplace_back(SetGroupLink{link, state, payload});
            break;
          case 4:
            here.emplace_back(RemoveGroupLink{link});
            there.emplace_back(RemoveGroupLink{link});
            break;
          case 5:
          case 6:
          case 7:
            here.emplace_back(Link(link, {vehicle.first, sequence},
                                   {other.first, 1}, payload));
            there.emplace_back(Link(link, {vehicle.second, sequence},
                                    {other.second, 1}, payload));
            break;
          default:
            here.emplace_back(Add(vehicle.first, payload));
            there.emplace_back(Add(vehicle.second, payload));
        }
      }
      real = write_groups().Change(id, here, expected);
      modelled = BlockingGroupWrites(&model).Change(id, there, expected);
    }
    ASSERT_EQ(real.status().code(), modelled.status().code())
        << real.status() << " instead of " << modelled.status();
    ASSERT_EQ(ReasonOf(real.status()), ReasonOf(modelled.status()));
    if (real.ok()) {
      ASSERT_EQ(*real, *modelled);
    }
    ASSERT_EQ(everything(storage(), /*is_real=*/true),
              everything(model, /*is_real=*/false));
  }
}

}  // namespace revisit::server
