#include "server/groups/group_edits.h"

#include <cstdint>
#include <string>
#include <variant>
#include <vector>

#include "gmock/gmock.h"
#include "gtest/gtest.h"
#include "server/base/status.h"
#include "server/groups/group_reads.h"
#include "server/groups/link_kind.h"
#include "server/groups/stored_vehicle.h"
#include "server/records/group_content.h"
#include "server/records/proto_record_codec.h"
#include "server/storage/record_check.h"
#include "tests/server/error_matchers.h"
#include "tests/server/memory_storage.h"

namespace revisit::server {
namespace {

using absl::StatusCode;
using ::testing::_;
using ::testing::HasSubstr;

std::string LinkPayload(const std::string& note,
                        std::int64_t create_time_ns = 0) {
  LinkContent content;
  content.content.note = note;
  content.create_time_ns = create_time_ns;
  return EncodeLinkContent(content);
}

std::int64_t TimeOf(const GroupLinkRecord& link) {
  std::int64_t time = 0;
  EXPECT_THAT(ReadLinkContent(
                  link.payload,
                  [&](const LinkContent& read) { time = read.create_time_ns; }),
              IsOk());
  return time;
}

// A group "g" with vehicles "car" and "truck", which have 20 poses each.
class GroupEditsTest : public testing::Test {
 protected:
  GroupEditsTest() {
    car_ = AddVehicle("car", core::StateSpace::kPlanar);
    truck_ = AddVehicle("truck", core::StateSpace::kPlanar);
    GroupRecord group;
    group.id = "g";
    group.version.uid = "one";
    groups().CreateGroup(group, [](const absl::StatusOr<std::uint64_t>& made) {
      EXPECT_THAT(made, IsOk());
    });
    Apply({AddGroupMember{{car_, "a"}}, AddGroupMember{{truck_, ""}}});
  }

  VehicleKey AddVehicle(const std::string& id, core::StateSpace space) {
    VehicleConfig config;
    config.drive.state_space = space;
    VehicleRecord record;
    record.id = id;
    record.payload = codec_.EncodeVehicle(config);
    record.revision = 1;
    VehicleKey key = 0;
    storage_.CreateVehicle(record, [&](const absl::StatusOr<VehicleKey>& made) {
      ASSERT_THAT(made, IsOk());
      key = *made;
    });
    // Poses 1 to 10 and 16 to 20 are kept; those are not looked at.
    AppendBatch(key, 1, 10, "");
    AppendBatch(key, 11, 5, codec_.EncodeDropped({11, 15, 5.0, std::nullopt}));
    AppendBatch(key, 16, 5, "");
    return key;
  }

  void AppendBatch(VehicleKey key, std::uint64_t first, std::uint32_t count,
                   const std::string& payload) {
    storage_.AppendBatches(
        key, {{first, count, first, payload}}, std::nullopt,
        [](const absl::Status& status) { EXPECT_THAT(status, IsOk()); });
  }

  void Apply(const std::vector<GroupChange>& changes) {
    groups().ChangeGroup("g", std::nullopt, changes,
                         [](const absl::StatusOr<std::uint64_t>& changed) {
                           EXPECT_THAT(changed, IsOk());
                         });
  }

  absl::StatusOr<GroupEdit> AddMember(const GroupMemberRecord& member,
                                      std::size_t limit = 3) {
    return EditToAddMember(&groups(), *groups().GetGroup("g"), member,
                           {limit, 3});
  }

  absl::StatusOr<GroupEdit> AddLink(const NewLink& wanted,
                                    std::int64_t now_ns = 1000) {
    return EditToAddLink(&storage_, codec_, *groups().GetGroup("g"), wanted,
                         now_ns, {3, 3}, &link_);
  }

  GroupStorage& groups() { return storage_.Groups(); }

  const ProtoRecordCodec codec_;
  MemoryStorage storage_;
  VehicleKey car_ = 0;
  VehicleKey truck_ = 0;
  GroupLinkRecord link_;
};

TEST_F(GroupEditsTest, NewMemberIsAdded) {
  const VehicleKey van = AddVehicle("van", core::StateSpace::kPlanar);
  const auto edit = AddMember({van, "datum", "van"});
  ASSERT_THAT(edit, IsOk());
  ASSERT_EQ(edit->changes.size(), 1u);
  EXPECT_FALSE(edit->fits_any_revision);
  const auto& added = std::get<AddGroupMember>(edit->changes[0]).member;
  EXPECT_EQ(added.vehicle, van);
  EXPECT_EQ(added.payload, "datum");
}

TEST_F(GroupEditsTest, MemberIsAddedOnceWithItsDatum) {
  const auto again = AddMember({car_, "a", "car"});
  ASSERT_THAT(again, IsOk());
  EXPECT_TRUE(again->changes.empty());
  EXPECT_THAT(AddMember({car_, "b", "car"}),
              IsError(StatusCode::kAlreadyExists, "MEMBER_EXISTS",
                      HasSubstr("'car' is a member of group 'g'")));
}

TEST_F(GroupEditsTest, MembersAreLimited) {
  const VehicleKey van = AddVehicle("van", core::StateSpace::kPlanar);
  const auto refused = AddMember({van, "", "van"}, 2);
  EXPECT_THAT(refused,
              IsError(StatusCode::kFailedPrecondition, "GROUP_LIMIT", _));
  EXPECT_EQ(MetadataOf(refused.status(), "limit"), "2");
  EXPECT_THAT(AddMember({van, "", "van"}, 3), IsOk());
  // One that is there takes no more room.
  EXPECT_THAT(AddMember({car_, "a", "car"}, 2), IsOk());
}

TEST_F(GroupEditsTest, DamagedGroupGetsNoMoreMembersAndLinks) {
  GroupRecord group = *groups().GetGroup("g");
  group.damage = Corrupt("the row");
  EXPECT_THAT(EditToAddMember(&groups(), group, {car_, "a", "car"}, {}),
              IsError(StatusCode::kDataLoss, "STORE_CORRUPT", _));
  EXPECT_THAT(EditToAddLink(&storage_, codec_, group,
                            {"l", {"car", 1}, {"truck", 1}, LinkPayload("")}, 1,
                            {}, &link_),
              IsError(StatusCode::kDataLoss, "STORE_CORRUPT", _));
}

TEST_F(GroupEditsTest, NewLinkIsAddedWithItsTime) {
  const auto edit =
      AddLink({"l", {"car", 20}, {"truck", 10}, LinkPayload("icp")});
  ASSERT_THAT(edit, IsOk());
  ASSERT_EQ(edit->changes.size(), 1u);
  EXPECT_FALSE(edit->fits_any_revision);
  EXPECT_EQ(link_.id, "l");
  EXPECT_EQ(link_.state, LinkState::kConfirmed);
  EXPECT_EQ(link_.query, (VehiclePose{car_, 20}));
  EXPECT_EQ(link_.matched, (VehiclePose{truck_, 10}));
  EXPECT_EQ(TimeOf(link_), 1000);
  EXPECT_EQ(std::get<AddGroupLink>(edit->changes[0]).link.payload,
            link_.payload);
}

TEST_F(GroupEditsTest, EachLinkIsLaterThanAllOthers) {
  Apply({AddGroupLink{{"z",
                       LinkState::kConfirmed,
                       {car_, 1},
                       {truck_, 1},
                       LinkPayload("", 5000)}}});
  const NewLink wanted = {"a", {"car", 20}, {"truck", 10}, LinkPayload("")};
  ASSERT_THAT(AddLink(wanted, 1000), IsOk());
  EXPECT_EQ(TimeOf(link_), 5001);
  ASSERT_THAT(AddLink(wanted, 6000), IsOk());
  EXPECT_EQ(TimeOf(link_), 6000);
}

TEST_F(GroupEditsTest, LinkThatSaysTheSameIsTheOneThatIsThere) {
  NewLink wanted = {"l", {"car", 20}, {"truck", 10}, LinkPayload("icp")};
  const auto edit = AddLink(wanted, 1000);
  ASSERT_THAT(edit, IsOk());
  Apply(edit->changes);
  const auto again = AddLink(wanted, 2000);
  ASSERT_THAT(again, IsOk());
  EXPECT_TRUE(again->changes.empty());
  EXPECT_EQ(TimeOf(link_), 1000);
  wanted.payload = LinkPayload("other");
  EXPECT_THAT(AddLink(wanted),
              IsError(StatusCode::kAlreadyExists, "LOOP_CLOSURE_EXISTS", _));
  wanted = {"l", {"truck", 10}, {"car", 20}, LinkPayload("icp")};
  EXPECT_THAT(AddLink(wanted),
              IsError(StatusCode::kAlreadyExists, "LOOP_CLOSURE_EXISTS", _));
  // The same poses are linked under another id too.
  wanted.id = "other";
  EXPECT_THAT(AddLink(wanted), IsOk());
}

TEST_F(GroupEditsTest, LinksAreLimited) {
  for (const char* id : {"a", "b", "c"}) {
    Apply({AddGroupLink{
        {id, LinkState::kConfirmed, {car_, 1}, {truck_, 1}, LinkPayload("")}}});
  }
  const auto refused =
      AddLink({"d", {"car", 1}, {"truck", 1}, LinkPayload("")});
  EXPECT_THAT(refused,
              IsError(StatusCode::kFailedPrecondition, "GROUP_LIMIT", _));
  EXPECT_EQ(MetadataOf(refused.status(), "limit"), "3");
  EXPECT_THAT(AddLink({"c", {"car", 1}, {"truck", 1}, LinkPayload("")}),
              IsOk());
}

NewLink Rejection(const std::string& id, const NewLink::Pose& query,
                  const NewLink::Pose& matched, const std::string& note = "") {
  return {id, query, matched, LinkPayload(note), PairKind::kRejectedCandidate};
}

TEST_F(GroupEditsTest, RejectedCandidateIsALinkWithAnIdOfItsOwn) {
  ASSERT_THAT(AddLink({"l", {"car", 20}, {"truck", 10}, LinkPayload("", 7)}),
              IsOk());
  Apply({AddGroupLink{link_}});
  const NewLink wanted = Rejection("l", {"car", 1}, {"truck", 1}, "other hall");
  const auto edit = AddLink(wanted, 500);
  ASSERT_THAT(edit, IsOk());
  EXPECT_EQ(link_.state, LinkState::kRejected);
  EXPECT_EQ(KindOf(link_), PairKind::kRejectedCandidate);
  EXPECT_EQ(LinkIdOf(link_), "l");
  EXPECT_EQ(TimeOf(link_), 1001);
  Apply(edit->changes);
  EXPECT_TRUE(AddLink(wanted)->changes.empty());
  EXPECT_THAT(AddLink(Rejection("l", {"car", 1}, {"truck", 1})),
              IsError(StatusCode::kAlreadyExists, "REJECTED_CANDIDATE_EXISTS",
                      HasSubstr("rejected candidate 'l'")));
  Apply(EditToRemoveLink(PairKind::kRejectedCandidate, "l").changes);
  EXPECT_EQ(groups().ListLinks("g", "", 9)->size(), 1u);
  Apply(EditToRemoveLink(PairKind::kLoopClosure, "l").changes);
  EXPECT_TRUE(groups().ListLinks("g", "", 9)->empty());
}

TEST_F(GroupEditsTest, TwoPosesAreNoLinksOfBothKinds) {
  ASSERT_THAT(AddLink({"l", {"car", 20}, {"truck", 10}, LinkPayload("")}),
              IsOk());
  Apply({AddGroupLink{link_}});
  // Whichever of them asked.
  for (const auto& wanted : {Rejection("r", {"car", 20}, {"truck", 10}),
                             Rejection("r", {"truck", 10}, {"car", 20})}) {
    const auto refused = AddLink(wanted);
    EXPECT_THAT(refused,
                IsError(StatusCode::kFailedPrecondition, "POSE_PAIR_CONFLICT",
                        HasSubstr("loop closure 'l'")));
    EXPECT_EQ(MetadataOf(refused.status(), "name"), "groups/g/loopClosures/l");
  }
  ASSERT_THAT(AddLink(Rejection("r", {"car", 19}, {"truck", 10})), IsOk());
  Apply({AddGroupLink{link_}});
  const auto refused =
      AddLink({"m", {"truck", 10}, {"car", 19}, LinkPayload("")});
  EXPECT_THAT(refused, IsError(StatusCode::kFailedPrecondition,
                               "POSE_PAIR_CONFLICT", _));
  EXPECT_EQ(MetadataOf(refused.status(), "name"),
            "groups/g/rejectedCandidates/r");
}

TEST_F(GroupEditsTest, BothKindsShareTheLimit) {
  for (const char* id : {"a", "~a", "~b"}) {
    Apply({AddGroupLink{
        {id, LinkState::kConfirmed, {car_, 2}, {truck_, 2}, LinkPayload("")}}});
  }
  EXPECT_THAT(AddLink(Rejection("d", {"car", 1}, {"truck", 1})),
              IsError(StatusCode::kFailedPrecondition, "GROUP_LIMIT",
                      HasSubstr("rejected candidates")));
  EXPECT_THAT(AddLink({"d", {"car", 1}, {"truck", 1}, LinkPayload("")}),
              IsError(StatusCode::kFailedPrecondition, "GROUP_LIMIT", _));
}

TEST_F(GroupEditsTest, RemovalSaysWhichKindIsNotThere) {
  const absl::Status missing = NoSuchPair(PairKind::kLoopClosure, "~x");
  EXPECT_THAT(RemovalError(PairKind::kRejectedCandidate, "x", missing),
              IsError(StatusCode::kNotFound, "REJECTED_CANDIDATE_NOT_FOUND",
                      HasSubstr("'x'")));
  EXPECT_THAT(RemovalError(PairKind::kLoopClosure, "x", missing),
              IsError(StatusCode::kNotFound, "LOOP_CLOSURE_NOT_FOUND", _));
  const absl::Status other = absl::UnavailableError("away");
  EXPECT_EQ(RemovalError(PairKind::kLoopClosure, "x", other), other);
}

TEST_F(GroupEditsTest, LinkIsBetweenMembers) {
  AddVehicle("van", core::StateSpace::kPlanar);
  EXPECT_THAT(AddLink({"l", {"car", 1}, {"van", 1}, LinkPayload("")}),
              IsError(StatusCode::kNotFound, "MEMBER_NOT_FOUND",
                      HasSubstr("'van' is no member of group 'g'")));
  EXPECT_THAT(AddLink({"l", {"nobody", 1}, {"car", 1}, LinkPayload("")}),
              IsError(StatusCode::kNotFound, "VEHICLE_NOT_FOUND", _));
}

TEST_F(GroupEditsTest, LinkIsBetweenPosesThatAreStored) {
  const auto refused =
      AddLink({"l", {"car", 21}, {"truck", 1}, LinkPayload("")});
  EXPECT_THAT(refused, IsError(StatusCode::kNotFound, "POSE_NOT_FOUND",
                               HasSubstr("'car' has no pose of sequence 21")));
  EXPECT_EQ(MetadataOf(refused.status(), "durable_sequence"), "20");
  const auto dropped =
      AddLink({"l", {"car", 1}, {"truck", 13}, LinkPayload("")});
  EXPECT_THAT(dropped, IsError(StatusCode::kOutOfRange, "POSES_DROPPED", _));
  EXPECT_EQ(MetadataOf(dropped.status(), "next_kept_sequence"), "16");
  EXPECT_EQ(MetadataOf(dropped.status(), "first_kept_sequence"), "1");
  for (const std::uint64_t kept : {1, 10, 16, 20}) {
    EXPECT_THAT(AddLink({"l", {"car", kept}, {"truck", 1}, LinkPayload("")}),
                IsOk());
  }
}

TEST_F(GroupEditsTest, LinkIsBetweenVehiclesOfOneStateSpace) {
  const VehicleKey plane = AddVehicle("plane", core::StateSpace::kSpatial);
  Apply({AddGroupMember{{plane, ""}}});
  EXPECT_THAT(AddLink({"l", {"car", 1}, {"plane", 1}, LinkPayload("")}),
              IsError(StatusCode::kInvalidArgument, "INVALID_FIELD",
                      HasSubstr("loop_closure.matched.vehicle")));
}

TEST_F(GroupEditsTest, MeasurementFitsTheStateSpace) {
  google::protobuf::RepeatedField<double> values;
  for (const double value : {1.0, 0.0, 0.0, -1.0, 0.0, 0.01}) values.Add(value);
  LinkContent content;
  content.content.measurement.emplace();
  content.content.measurement->covariance =
      CovarianceFields{CovarianceForm::kPlanar6, values};
  const NewLink wanted = {
      "l", {"car", 1}, {"truck", 1}, EncodeLinkContent(content)};
  EXPECT_THAT(
      AddLink(wanted),
      IsError(StatusCode::kInvalidArgument, "COVARIANCE_NOT_POSITIVE_DEFINITE",
              HasSubstr("loop_closure.measurement.covariance")));
}

TEST_F(GroupEditsTest, MemberIsFoundByItsVehicle) {
  const auto found = FindMember(&groups(), "g", "truck");
  ASSERT_THAT(found, IsOk());
  EXPECT_EQ(found->vehicle, truck_);
  EXPECT_THAT(FindMember(&groups(), "g", "van"),
              IsError(StatusCode::kNotFound, "MEMBER_NOT_FOUND", _));
  EXPECT_THAT(FindMember(&groups(), "h", "car"),
              IsError(StatusCode::kNotFound, "GROUP_NOT_FOUND", _));
}

}  // namespace
}  // namespace revisit::server
