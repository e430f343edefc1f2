#include "server/sessions/linked_poses.h"

#include <cstdint>
#include <string>
#include <vector>

#include "gmock/gmock.h"
#include "gtest/gtest.h"
#include "server/base/status.h"
#include "tests/server/error_matchers.h"
#include "tests/server/memory_storage.h"
#include "tests/server/storage_testing.h"

namespace revisit::server {
namespace {

using absl::StatusCode;
using ::testing::_;
using ::testing::ElementsAre;
using ::testing::UnorderedElementsAreArray;

// Groups "a" and "b" of two vehicles.
class LinkedPosesTest : public testing::Test {
 protected:
  LinkedPosesTest()
      : car_(*BlockingWrites(&storage_).Create("car")),
        truck_(*BlockingWrites(&storage_).Create("truck")) {
    for (const char* id : {"a", "b"}) {
      EXPECT_THAT(groups_.Create(id), IsOk());
      EXPECT_THAT(groups_.Change(id, {AddGroupMember{{car_, ""}},
                                      AddGroupMember{{truck_, ""}}}),
                  IsOk());
    }
  }

  absl::StatusOr<std::vector<std::uint64_t>> Read(VehicleKey vehicle) {
    return ReadLinkedPoses(&storage_.Groups(), vehicle);
  }

  MemoryStorage storage_;
  BlockingGroupWrites groups_{&storage_};
  const VehicleKey car_;
  const VehicleKey truck_;
};

TEST_F(LinkedPosesTest, AreTheEndsAtTheVehicleAlone) {
  EXPECT_THAT(*Read(car_), ElementsAre());
  ASSERT_THAT(
      groups_.Change(
          "a",
          {AddGroupLink{{"x", LinkState::kConfirmed, {car_, 5}, {truck_, 7}}}}),
      IsOk());
  ASSERT_THAT(
      groups_.Change(
          "b",
          {AddGroupLink{{"x", LinkState::kTentative, {truck_, 8}, {car_, 6}}}}),
      IsOk());
  EXPECT_THAT(*Read(car_), ElementsAre(5, 6));
  EXPECT_THAT(*Read(truck_), ElementsAre(7, 8));
}

TEST_F(LinkedPosesTest, AreNotThoseOfRejectedCandidates) {
  ASSERT_THAT(
      groups_.Change(
          "a",
          {AddGroupLink{{"x", LinkState::kRejected, {car_, 5}, {truck_, 7}}},
           AddGroupLink{{"y", LinkState::kSuspect, {car_, 6}, {truck_, 7}}}}),
      IsOk());
  EXPECT_THAT(*Read(car_), ElementsAre(6));
}

TEST_F(LinkedPosesTest, AreReadHoweverManyThereAre) {
  std::vector<std::uint64_t> all;
  for (const char* group : {"a", "b"}) {
    std::vector<GroupChange> changes;
    for (int i = 0; i < 1000; ++i) {
      all.push_back(all.size() + 1);
      changes.push_back(AddGroupLink{{std::to_string(i),
                                      LinkState::kConfirmed,
                                      {car_, all.back()},
                                      {truck_, 1}}});
    }
    ASSERT_THAT(groups_.Change(group, changes), IsOk());
  }
  EXPECT_THAT(*Read(car_), UnorderedElementsAreArray(all));
}

TEST_F(LinkedPosesTest, AreNotKnownWhereALinkIsDamaged) {
  GroupLinkRecord damaged{"y", LinkState::kConfirmed, {car_, 5}, {truck_, 7}};
  damaged.damage = Error(StatusCode::kDataLoss, "STORE_CORRUPT", "the row");
  ASSERT_THAT(
      groups_.Change(
          "a",
          {AddGroupLink{{"x", LinkState::kConfirmed, {car_, 5}, {truck_, 7}}},
           AddGroupLink{damaged}}),
      IsOk());
  EXPECT_THAT(Read(car_), IsError(StatusCode::kDataLoss, "STORE_CORRUPT", _));
  ASSERT_THAT(groups_.Change("a", {RemoveGroupLink{"y"}}), IsOk());
  EXPECT_THAT(*Read(car_), ElementsAre(5));
}

TEST_F(LinkedPosesTest, AreNotKnownOfAVehicleThatIsNotThere) {
  EXPECT_THAT(Read(99), IsError(StatusCode::kNotFound, "VEHICLE_NOT_FOUND", _));
}

}  // namespace
}  // namespace revisit::server
