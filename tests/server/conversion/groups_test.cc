#include "server/conversion/groups.h"

#include <limits>
#include <string>
#include <vector>

#include "gmock/gmock.h"
#include "google/protobuf/util/message_differencer.h"
#include "gtest/gtest.h"
#include "server/base/status.h"
#include "server/conversion/names.h"
#include "server/groups/link_kind.h"
#include "tests/server/conversion/conversion_testing.h"
#include "tests/server/error_matchers.h"

namespace revisit::server {
namespace {

using absl::StatusCode;
using google::protobuf::util::MessageDifferencer;
using ::testing::_;
using ::testing::ElementsAre;

google::protobuf::FieldMask Mask(const std::vector<std::string>& paths) {
  google::protobuf::FieldMask mask;
  for (const std::string& path : paths) mask.add_paths(path);
  return mask;
}

constexpr char kGroup[] = R"pb(
  display_name: "Night shift"
  settings {
    geodetic_origin {
      latitude_degrees: 59.91
      longitude_degrees: 10.75
      height_meters: 7
    }
    fix_bias_meters: 1.5
  }
)pb";

GroupRecord RecordFor(const v1::Group& group) {
  GroupContent content = *DecodeGroup(group);
  content.create_time_ns = 1700000000000000001;
  return {"night", {"some-uid", 7}, EncodeGroupContent(content)};
}

// ---- Groups

TEST(GroupsTest, AreAnsweredAsTheyWereSent) {
  auto expected = FromText<v1::Group>(kGroup);
  v1::Group group;
  ASSERT_THAT(EncodeGroup(RecordFor(expected), &group), IsOk());
  expected.set_name("groups/night");
  expected.set_uid("some-uid");
  expected.set_revision(7);
  expected.mutable_create_time()->set_seconds(1700000000);
  expected.mutable_create_time()->set_nanos(1);
  EXPECT_TRUE(MessageDifferencer::Equals(group, expected))
      << group.DebugString();
}

TEST(GroupsTest, AllThatIsWrongIsToldAtOnce) {
  auto group = FromText<v1::Group>(kGroup);
  group.set_display_name("line\nfeed");
  group.mutable_settings()->set_fix_bias_meters(-1.0);
  group.mutable_settings()->mutable_geodetic_origin()->set_latitude_degrees(
      91.0);
  EXPECT_THAT(FieldsOf(DecodeGroup(group).status()),
              ElementsAre("group.display_name",
                          "group.settings.geodetic_origin.latitude_degrees",
                          "group.settings.fix_bias_meters"));
  group = FromText<v1::Group>(kGroup);
  group.mutable_settings()->set_fix_bias_meters(
      std::numeric_limits<double>::quiet_NaN());
  EXPECT_THAT(FieldsOf(DecodeGroup(group).status()),
              ElementsAre("group.settings.fix_bias_meters"));
  group.mutable_settings()->set_fix_bias_meters(1000.0);
  EXPECT_THAT(DecodeGroup(group), IsOk());
}

TEST(GroupsTest, UpdateReplacesWhatTheMaskNames) {
  const GroupContent current = *DecodeGroup(FromText<v1::Group>(kGroup));
  const auto given = FromText<v1::Group>(
      R"pb(display_name: "Day"
           settings { fix_bias_meters: 2.5 })pb");
  auto updated =
      UpdateGroupContent(current, given, Mask({"settings.fix_bias_meters"}));
  ASSERT_THAT(updated, IsOk());
  EXPECT_EQ(updated->display_name, "Night shift");
  EXPECT_EQ(updated->settings.fix_bias_meters, 2.5);
  EXPECT_TRUE(updated->settings.geodetic_origin.has_value());
  updated = UpdateGroupContent(
      current, given, Mask({"display_name", "settings.geodetic_origin"}));
  ASSERT_THAT(updated, IsOk());
  EXPECT_EQ(updated->display_name, "Day");
  EXPECT_EQ(updated->settings.fix_bias_meters, 1.5);
  EXPECT_FALSE(updated->settings.geodetic_origin.has_value());
  updated = UpdateGroupContent(current, v1::Group(), Mask({"settings"}));
  ASSERT_THAT(updated, IsOk());
  EXPECT_EQ(updated->settings, GroupSettings());
}

TEST(GroupsTest, UpdateRefusesOtherPaths) {
  const GroupContent current = *DecodeGroup(FromText<v1::Group>(kGroup));
  EXPECT_THAT(
      FieldsOf(UpdateGroupContent(current, v1::Group(), Mask({})).status()),
      ElementsAre("update_mask"));
  EXPECT_THAT(
      FieldsOf(UpdateGroupContent(
                   current, v1::Group(),
                   Mask({"name", "display_name",
                         "settings.geodetic_origin.height_meters", "uid"}))
                   .status()),
      ElementsAre("update_mask.paths[0]", "update_mask.paths[2]",
                  "update_mask.paths[3]"));
}

TEST(GroupsTest, DamagedOneHasWhatItsRowClaims) {
  GroupRecord record{"night", {"uid\xff", 7}, ""};
  record.damage = Corrupt("the row");
  v1::Group group;
  EXPECT_THAT(EncodeGroup(record, &group),
              IsError(StatusCode::kDataLoss, "STORE_CORRUPT", _));
  EXPECT_TRUE(MessageDifferencer::Equals(
      group, FromText<v1::Group>(R"pb(name: "groups/night"
                                      uid: "uid?"
                                      revision: 7)pb")));
}

TEST(GroupsTest, WhoMayNotReadIsToldWhatTheySet) {
  v1::Group group;
  ASSERT_THAT(EncodeGroup(RecordFor(FromText<v1::Group>(kGroup)), &group),
              IsOk());
  v1::Group created = group;
  TrimToSettings(&created);
  v1::Group expected;
  expected.set_name("groups/night");
  expected.set_uid("some-uid");
  v1::Group updated = expected;
  *expected.mutable_settings() = group.settings();
  EXPECT_TRUE(MessageDifferencer::Equals(created, expected));
  TrimToMask(Mask({"settings.fix_bias_meters"}), &group);
  updated.mutable_settings()->set_fix_bias_meters(1.5);
  EXPECT_TRUE(MessageDifferencer::Equals(group, updated))
      << group.DebugString();
}

// ---- Members

constexpr char kMember[] = R"pb(
  vehicle: "vehicles/truck"
  datum {
    datum_id: "site"
    pose { x_meters: 10 y_meters: -20 heading_radians: 0.5 }
    covariance {
      form: COVARIANCE_FORM_PLANAR_6
      values: [ 1, 0, 0, 1, 0, 0.01 ]
    }
  }
)pb";

TEST(GroupMembersTest, AreAnsweredAsTheyWereSent) {
  auto expected = FromText<v1::GroupMember>(kMember);
  const auto payload = DecodeMember(expected, Planar());
  ASSERT_THAT(payload, IsOk());
  v1::GroupMember member;
  ASSERT_THAT(EncodeMember("night", {1, *payload, "truck"}, &member), IsOk());
  expected.set_name("groups/night/members/truck");
  EXPECT_TRUE(MessageDifferencer::Equals(member, expected))
      << member.DebugString();
  expected.clear_datum();
  member.Clear();
  ASSERT_THAT(EncodeMember("night", {1, "", "truck"}, &member), IsOk());
  EXPECT_TRUE(MessageDifferencer::Equals(member, expected));
}

TEST(GroupMembersTest, DatumFitsTheVehicle) {
  auto member = FromText<v1::GroupMember>(kMember);
  EXPECT_THAT(FieldsOf(DecodeMember(member, Spatial()).status()),
              ElementsAre("member.datum.covariance.form"));
  EXPECT_THAT(FieldsOf(DecodeMember(member, Geodetic(Planar())).status()),
              ElementsAre("member.datum"));
  member.mutable_datum()->mutable_covariance()->set_values(0, -1.0);
  EXPECT_THAT(DecodeMember(member, Planar()),
              IsError(StatusCode::kInvalidArgument,
                      "COVARIANCE_NOT_POSITIVE_DEFINITE", _));
  member.clear_datum();
  EXPECT_THAT(DecodeMember(member, Geodetic(Planar())), IsOk());
}

TEST(GroupMembersTest, AllThatIsWrongWithADatumIsToldAtOnce) {
  auto member = FromText<v1::GroupMember>(kMember);
  member.mutable_datum()->set_datum_id("line\nfeed");
  member.mutable_datum()->mutable_pose()->set_y_meters(1e9);
  member.mutable_datum()->clear_covariance();
  EXPECT_THAT(FieldsOf(DecodeMember(member, Planar()).status()),
              ElementsAre("member.datum.datum_id", "member.datum.pose.y_meters",
                          "member.datum.covariance"));
}

TEST(GroupMembersTest, DamagedOnesAreNotAnswered) {
  v1::GroupMember member;
  GroupMemberRecord record{1, "\xff", "truck"};
  EXPECT_THAT(EncodeMember("night", record, &member),
              IsError(StatusCode::kDataLoss, "STORE_CORRUPT", _));
  record = {1, "", "truck"};
  record.damage = Corrupt("the row");
  EXPECT_THAT(EncodeMember("night", record, &member),
              IsError(StatusCode::kDataLoss, "STORE_CORRUPT", _));
}

// ---- Loop closures

constexpr char kRequest[] = R"pb(
  parent: "groups/night"
  loop_closure_id: "gate"
  loop_closure {
    query { vehicle: "vehicles/truck" sequence: 9 }
    matched { vehicle: "vehicles/car" sequence: 12 }
    measurement {
      x_meters: 1.5
      heading_radians: 3
      covariance {
        form: COVARIANCE_FORM_PLANAR_6
        values: [ 4, 0.1, 0.2, 5, 0.3, 0.06 ]
      }
    }
    note: "icp"
    score: 0
  }
)pb";

using Request = v1::AddInterVehicleLoopClosureRequest;

TEST(GroupLinksTest, AreAnsweredAsTheyWereSent) {
  const auto request = FromText<Request>(kRequest);
  const auto link = DecodeLink(request, "token:eva");
  ASSERT_THAT(link, IsOk());
  EXPECT_EQ(link->id, "gate");
  EXPECT_EQ(link->query.vehicle_id, "truck");
  EXPECT_EQ(link->matched.sequence, 12u);
  v1::InterVehicleLoopClosure closure;
  ASSERT_THAT(EncodeLink("night", "truck", "car",
                         {"gate",
                          LinkState::kConfirmed,
                          {1, 9},
                          {2, 12},
                          LinkContentCreatedAt(link->payload, 5)},
                         &closure),
              IsOk());
  v1::InterVehicleLoopClosure expected = request.loop_closure();
  expected.set_name("groups/night/loopClosures/gate");
  expected.set_decided_by("token:eva");
  expected.mutable_create_time()->set_nanos(5);
  EXPECT_TRUE(MessageDifferencer::Equals(closure, expected))
      << closure.DebugString();
}

TEST(GroupLinksTest, RejectedCandidatesAreAnsweredAsTheyWereSent) {
  auto request = FromText<v1::RejectInterVehicleCandidateRequest>(R"pb(
    rejected_candidate_id: "gate"
    rejected_candidate {
      query { vehicle: "vehicles/truck" sequence: 9 }
      matched { vehicle: "vehicles/car" sequence: 12 }
      note: "other hall"
    }
  )pb");
  const auto link = DecodeLink(request, "token:eva");
  ASSERT_THAT(link, IsOk());
  EXPECT_EQ(link->id, "gate");
  EXPECT_EQ(link->kind, PairKind::kRejectedCandidate);
  v1::InterVehicleRejectedCandidate rejection;
  ASSERT_THAT(EncodeLink("night", "truck", "car",
                         {LinkRowId(link->kind, link->id),
                          LinkState::kRejected,
                          {1, 9},
                          {2, 12},
                          LinkContentCreatedAt(link->payload, 5)},
                         &rejection),
              IsOk());
  v1::InterVehicleRejectedCandidate expected = request.rejected_candidate();
  expected.set_name("groups/night/rejectedCandidates/gate");
  expected.set_decided_by("token:eva");
  expected.mutable_create_time()->set_nanos(5);
  EXPECT_TRUE(MessageDifferencer::Equals(rejection, expected))
      << rejection.DebugString();
  request.set_rejected_candidate_id("NO");
  request.mutable_rejected_candidate()->set_note(std::string(1025, 'a'));
  request.mutable_rejected_candidate()->mutable_matched()->set_vehicle(
      "vehicles/truck");
  EXPECT_THAT(FieldsOf(DecodeLink(request, "").status()),
              ElementsAre("rejected_candidate.matched.vehicle",
                          "rejected_candidate.note", "rejected_candidate_id"));
}

TEST(GroupLinksTest, IdThatIsLeftOutIsMadeOfThePoses) {
  auto request = FromText<Request>(kRequest);
  request.clear_loop_closure_id();
  const std::string id = DecodeLink(request, "")->id;
  EXPECT_THAT(CheckId(id, FieldPath()), IsOk());
  EXPECT_EQ(id.size(), 32u);
  // Whatever else is said of them.
  request.mutable_loop_closure()->set_note("");
  EXPECT_EQ(DecodeLink(request, "token:eva")->id, id);
  const auto with = [&](const std::string& vehicle, std::uint64_t sequence) {
    request.mutable_loop_closure()->mutable_query()->set_vehicle("vehicles/" +
                                                                 vehicle);
    request.mutable_loop_closure()->mutable_query()->set_sequence(sequence);
    return DecodeLink(request, "")->id;
  };
  EXPECT_NE(with("truck", 10), id);
  EXPECT_NE(with("truck-9", 9), id);
  EXPECT_EQ(with(std::string(63, 'a'), 9).size(), 32u);
  EXPECT_EQ(with("truck", 9), id);
}

TEST(GroupLinksTest, AllThatIsWrongIsToldAtOnce) {
  auto request = FromText<Request>(kRequest);
  auto* const closure = request.mutable_loop_closure();
  closure->mutable_query()->set_vehicle("truck");
  closure->mutable_query()->set_sequence(0);
  closure->clear_matched();
  closure->mutable_measurement()->set_x_meters(1e5);
  closure->set_note(std::string(1025, 'a'));
  closure->set_score(std::numeric_limits<double>::infinity());
  request.set_loop_closure_id("NO");
  EXPECT_THAT(
      FieldsOf(DecodeLink(request, "").status()),
      ElementsAre("loop_closure.query.vehicle", "loop_closure.query.sequence",
                  "loop_closure.matched.vehicle",
                  "loop_closure.matched.sequence",
                  "loop_closure.measurement.x_meters", "loop_closure.note",
                  "loop_closure.score", "loop_closure_id"));
}

TEST(GroupLinksTest, TwoPosesOfOneVehicleAreRefused) {
  auto request = FromText<Request>(kRequest);
  request.mutable_loop_closure()->mutable_matched()->set_vehicle(
      "vehicles/truck");
  EXPECT_THAT(FieldsOf(DecodeLink(request, "").status()),
              ElementsAre("loop_closure.matched.vehicle"));
}

TEST(GroupLinksTest, IdIsChecked) {
  auto request = FromText<Request>(kRequest);
  request.set_loop_closure_id("-");
  EXPECT_THAT(DecodeLink(request, ""),
              IsError(StatusCode::kInvalidArgument, "INVALID_RESOURCE_NAME",
                      ::testing::HasSubstr("loop_closure_id: got \"-\"; an id "
                                           "is")));
}

}  // namespace
}  // namespace revisit::server
