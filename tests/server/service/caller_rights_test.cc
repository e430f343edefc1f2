#include "server/service/caller_rights.h"

#include <cstdint>
#include <functional>
#include <memory>
#include <optional>
#include <utility>

#include "absl/status/statusor.h"
#include "gmock/gmock.h"
#include "gtest/gtest.h"
#include "tests/server/error_matchers.h"

namespace revisit::server {
namespace {

using absl::StatusCode;
using ::testing::_;
using ::testing::HasSubstr;

constexpr auto kRead = static_cast<std::uint8_t>(Verb::kRead);
constexpr auto kWrite = static_cast<std::uint8_t>(Verb::kWrite);

// Lets everyone in as one caller, whose rights tests change.
class OneCaller final : public Gatekeeper {
 public:
  // Grants these verbs on the vehicles whose ids begin with "a-".
  void Grant(std::uint8_t verbs) {
    Caller caller;
    caller.tenant = "a";
    caller.grants = {{{"a-", {"*"}, verbs, {"*group"}}}};
    answer_ = std::make_shared<const Caller>(std::move(caller));
  }
  void Refuse(absl::Status refusal) { answer_ = std::move(refusal); }

  bool asks() const override { return true; }
  absl::StatusOr<std::shared_ptr<const Caller>> Admit(const Credentials&,
                                                      Time) override {
    return answer_;
  }
  WatchId Watch(Time, std::function<void()>) override { return 0; }
  void Unwatch(WatchId) override {}
  std::optional<FilesState> files() const override { return std::nullopt; }
  void LookAtFiles() override {}

 private:
  absl::StatusOr<std::shared_ptr<const Caller>> answer_;
};

class CallerRightsTest : public testing::Test {
 protected:
  CallerRights RightsFor(const char* method) {
    return CallerRights(&gatekeeper_, {}, method, FindMethodRule(method));
  }

  OneCaller gatekeeper_;
};

TEST_F(CallerRightsTest, CallerWhoIsNotLetInMayDoNothing) {
  gatekeeper_.Refuse(
      Error(StatusCode::kUnauthenticated, "UNAUTHENTICATED", "no token"));
  CallerRights rights = RightsFor("GetVehicle");
  EXPECT_THAT(rights.entry(),
              IsError(StatusCode::kUnauthenticated, "UNAUTHENTICATED", _));
  EXPECT_FALSE(rights.caller().May(Verb::kRead, "a-1"));
}

TEST_F(CallerRightsTest, VehicleThatTheCallerMayNotSeeDoesNotExist) {
  gatekeeper_.Grant(kRead);
  CallerRights rights = RightsFor("GetVehicle");
  ASSERT_THAT(rights.entry(), IsOk());
  EXPECT_THAT(rights.Choose(Resource::kVehicle, "a-1"), IsOk());
  EXPECT_THAT(rights.Choose(Resource::kVehicle, "b-1"),
              IsError(StatusCode::kNotFound, "VEHICLE_NOT_FOUND", _));
}

TEST_F(CallerRightsTest, GroupThatTheCallerMayNotSeeDoesNotExist) {
  gatekeeper_.Grant(kRead);
  CallerRights rights = RightsFor("GetGroup");
  EXPECT_THAT(rights.Choose(Resource::kGroup, "a-group"), IsOk());
  // One of vehicles alone.
  EXPECT_THAT(rights.Choose(Resource::kGroup, "a-1"),
              IsError(StatusCode::kNotFound, "GROUP_NOT_FOUND", _));
  EXPECT_THAT(RightsFor("UpdateGroup").Choose(Resource::kGroup, "a-group"),
              IsError(StatusCode::kPermissionDenied, "NOT_GRANTED",
                      HasSubstr("verb write on this group")));
}

TEST_F(CallerRightsTest, FurtherVehiclesAreChecked) {
  gatekeeper_.Grant(kRead | kWrite);
  CallerRights rights = RightsFor("AddGroupMember");
  ASSERT_THAT(rights.Choose(Resource::kGroup, "a-group"), IsOk());
  EXPECT_THAT(rights.AlsoNeeds(Verb::kWrite, "a-1"), IsOk());
  EXPECT_THAT(rights.AlsoNeeds(Verb::kWrite, "b-1"),
              IsError(StatusCode::kNotFound, "VEHICLE_NOT_FOUND", _));
  EXPECT_THAT(rights.AlsoNeeds(Verb::kAdmin, "a-1"),
              IsError(StatusCode::kPermissionDenied, "NOT_GRANTED",
                      HasSubstr("verb admin on this vehicle")));
}

TEST_F(CallerRightsTest, RefusalNamesTheVerbThatIsMissing) {
  gatekeeper_.Grant(kRead);
  CallerRights rights = RightsFor("StreamPoses");
  EXPECT_THAT(rights.Choose(Resource::kVehicle, "a-1"),
              IsError(StatusCode::kPermissionDenied, "NOT_GRANTED",
                      HasSubstr("StreamPoses needs the verb write")));
}

TEST_F(CallerRightsTest, VehicleThatIsToBeCreatedIsNotCalledMissing) {
  gatekeeper_.Grant(kRead);
  CallerRights rights = RightsFor("CreateVehicle");
  EXPECT_THAT(rights.Choose(Resource::kVehicle, "b-1"),
              IsError(StatusCode::kPermissionDenied, "NOT_GRANTED", _));
}

TEST_F(CallerRightsTest, RecheckFindsThatAVerbWasLost) {
  gatekeeper_.Grant(kWrite);
  CallerRights rights = RightsFor("StreamPoses");
  ASSERT_THAT(rights.Choose(Resource::kVehicle, "a-1"), IsOk());
  EXPECT_THAT(rights.Recheck(), IsOk());
  gatekeeper_.Grant(kRead);
  EXPECT_THAT(rights.Recheck(),
              IsError(StatusCode::kPermissionDenied, "NOT_GRANTED",
                      HasSubstr("verb write")));
}

TEST_F(CallerRightsTest, RecheckFindsThatAFurtherVerbWasLost) {
  gatekeeper_.Grant(kRead | kWrite);
  CallerRights rights = RightsFor("StreamPoses");
  ASSERT_THAT(rights.Choose(Resource::kVehicle, "a-1"), IsOk());
  ASSERT_THAT(rights.AlsoNeeds(Verb::kRead), IsOk());
  EXPECT_THAT(rights.Recheck(), IsOk());
  gatekeeper_.Grant(kWrite);
  EXPECT_THAT(rights.Recheck(), IsError(StatusCode::kPermissionDenied,
                                        "NOT_GRANTED", HasSubstr("verb read")));
}

TEST_F(CallerRightsTest, RecheckBeforeAVehicleIsChosenAsksForTheCallerOnly) {
  gatekeeper_.Grant(kRead);
  CallerRights rights = RightsFor("StreamPoses");
  EXPECT_THAT(rights.Recheck(), IsOk());
  gatekeeper_.Refuse(
      Error(StatusCode::kUnauthenticated, "UNAUTHENTICATED", "expired"));
  EXPECT_THAT(rights.Recheck(),
              IsError(StatusCode::kUnauthenticated, "UNAUTHENTICATED", _));
}

}  // namespace
}  // namespace revisit::server
