#include "server/conversion/names.h"

#include <string>
#include <tuple>

#include "gmock/gmock.h"
#include "gtest/gtest.h"
#include "tests/server/error_matchers.h"

namespace revisit::server {
namespace {

using namespace std::string_literals;

using absl::StatusCode;
using ::testing::HasSubstr;
using ::testing::StartsWith;

TEST(NamesTest, TakesIdsOfThePattern) {
  for (const std::string& id :
       {"a"s, "0"s, "a-b"s, "0--9"s, "vehicle-1"s, std::string(63, 'z')}) {
    EXPECT_THAT(CheckId(id, FieldPath().Field("x")), IsOk()) << id;
    EXPECT_EQ(ParseVehicleName("vehicles/" + id, FieldPath()).value(), id);
  }
}

TEST(NamesTest, RecordingsAreNamedByTheirFirstPose) {
  EXPECT_EQ(RecordingName("truck", 401), "vehicles/truck/recordings/401");
}

TEST(NamesTest, NamesInGroupsAreReadAsTheyAreWritten) {
  EXPECT_EQ(ParseGroupName(GroupName("g"), FieldPath()).value(), "g");
  const auto member = ParseMemberName(MemberName("g", "truck"), FieldPath());
  ASSERT_THAT(member, IsOk());
  EXPECT_EQ(member->group_id, "g");
  EXPECT_EQ(member->id, "truck");
  for (const PairKind kind : kPairKinds) {
    const auto link =
        ParseGroupLinkName(kind, GroupLinkName(kind, "g", "gate"), FieldPath());
    ASSERT_THAT(link, IsOk());
    EXPECT_EQ(link->group_id, "g");
    EXPECT_EQ(link->id, "gate");
  }
}

// Their names were taken for those of nothing.
TEST(NamesTest, IdsMayBeTheWordsThatNamesAreMadeOf) {
  const auto member =
      ParseMemberName(MemberName("members", "members"), FieldPath());
  ASSERT_THAT(member, IsOk());
  EXPECT_EQ(member->group_id, "members");
  EXPECT_EQ(member->id, "members");
  const auto check = ParseCheckName(CheckName("checks", 5), FieldPath());
  ASSERT_THAT(check, IsOk());
  EXPECT_EQ(check->vehicle_id, "checks");
  const auto candidate = ParseCheckCandidateName(
      CheckCandidateName("candidates", 5, 1), FieldPath());
  ASSERT_THAT(candidate, IsOk());
  EXPECT_EQ(candidate->vehicle_id, "candidates");
}

TEST(NamesTest, RefusesNamesThatAreNoneInGroups) {
  for (const char* name :
       {"", "g", "groups/", "vehicles/g", "Groups/g", "groups/g/", "groups/G",
        "groups/g/members/", "groups/g/members/a/b", "groups/g/loopClosures/A",
        "groups//members/a", "members/a", "vehicles/g/members/a",
        "Groups/g/members/a", "Groups/g/loopClosures/a"}) {
    const auto refused = [](const auto& parsed) {
      EXPECT_THAT(parsed, IsError(StatusCode::kInvalidArgument,
                                  "INVALID_RESOURCE_NAME", ::testing::_));
    };
    refused(ParseGroupName(name, FieldPath().Field("name")));
    refused(ParseMemberName(name, FieldPath().Field("name")));
    for (const PairKind kind : kPairKinds) {
      refused(ParseGroupLinkName(kind, name, FieldPath().Field("name")));
    }
  }
}

TEST(NamesTest, RefusesIdsOutsideThePattern) {
  for (const std::string& id :
       {std::string(""), std::string("-a"), std::string("a-"), std::string("-"),
        std::string("A"), std::string("a_b"), std::string("a/b"),
        std::string("\xc3\xa4"), std::string("a\0b", 3),
        std::string(64, 'a')}) {
    EXPECT_THAT(CheckId(id, FieldPath().Field("vehicle_id")),
                IsError(StatusCode::kInvalidArgument, "INVALID_RESOURCE_NAME",
                        StartsWith("vehicle_id: got \"")));
  }
}

TEST(NamesTest, RefusesNamesOfAnotherForm) {
  for (const std::string name : {"", "a", "vehicles/", "vehicles//a",
                                 "/vehicles/a", "vehicles/a/", "vehicle/a"}) {
    EXPECT_THAT(ParseVehicleName(name, FieldPath().Field("name")),
                IsError(StatusCode::kInvalidArgument, "INVALID_RESOURCE_NAME",
                        StartsWith("name: ")))
        << name;
  }
}

TEST(NamesTest, SplitsTheNameOfAPairOfPoses) {
  for (const auto& [kind, collection, form] :
       {std::tuple(PairKind::kLoopClosure, "loopClosures", "loop_closure"),
        std::tuple(PairKind::kRejectedCandidate, "rejectedCandidates",
                   "rejected_candidate")}) {
    const std::string middle = "/"s + collection + "/";
    const auto name =
        ParsePosePairName(kind, "vehicles/a" + middle + "9-3", FieldPath());
    ASSERT_THAT(name, IsOk());
    EXPECT_EQ(name->vehicle_id, "a");
    EXPECT_EQ(name->id, "9-3");
    for (const std::string& bad :
         {"vehicles/a"s, "vehicles/a" + middle, "vehicles/" + middle + "x",
          "vehicles/a" + middle + "x" + middle + "y",
          "vehicles/a/somethingElse/x"s}) {
      EXPECT_THAT(ParsePosePairName(kind, bad, FieldPath().Field("name")),
                  IsError(StatusCode::kInvalidArgument, "INVALID_RESOURCE_NAME",
                          StartsWith("name: ")))
          << bad;
    }
    EXPECT_THAT(ParsePosePairName(kind, "x", FieldPath().Field("name")),
                IsError(StatusCode::kInvalidArgument, "INVALID_RESOURCE_NAME",
                        HasSubstr("the form is vehicles/{vehicle}" + middle +
                                  "{" + form + "}")));
  }
}

TEST(NamesTest, NamesOfTwoKindsOfPairsAreNotTakenForEachOther) {
  EXPECT_FALSE(ParsePosePairName(PairKind::kRejectedCandidate,
                                 "vehicles/a/loopClosures/x", FieldPath())
                   .ok());
  EXPECT_FALSE(ParsePosePairName(PairKind::kLoopClosure,
                                 "vehicles/a/rejectedCandidates/x", FieldPath())
                   .ok());
}

}  // namespace
}  // namespace revisit::server
