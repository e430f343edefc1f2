#include "server/sessions/vehicle_census.h"

#include <chrono>
#include <functional>
#include <memory>
#include <optional>
#include <string>
#include <vector>

#include "gmock/gmock.h"
#include "gtest/gtest.h"
#include "server/base/status.h"
#include "server/sessions/fleet.h"
#include "tests/server/error_matchers.h"
#include "tests/server/held_storage.h"
#include "tests/server/memory_storage.h"
#include "tests/server/plain_codec.h"
#include "tests/server/sessions/session_testing.h"
#include "tests/server/storage_testing.h"

namespace revisit::server {
namespace {

using State = VehicleCensus::State;

std::string Shown(const VehicleCensus& census) {
  const std::optional<VehicleCensus::Counts> counts = census.Read();
  if (!counts) return "unknown";
  return std::to_string(counts->active) + " active, " +
         std::to_string(counts->data_loss) + " data loss, " +
         std::to_string(counts->damaged) + " damaged";
}

// Calls something before it answers.
class WatchedStorage : public HeldStorage {
 public:
  using HeldStorage::HeldStorage;

  absl::StatusOr<std::vector<VehicleRecord>> ListVehicleRows(
      VehicleKey after_key, int limit) override {
    if (before_rows) before_rows();
    return HeldStorage::ListVehicleRows(after_key, limit);
  }

  std::function<void()> before_rows;
};

class VehicleCensusTest : public ::testing::Test {
 protected:
  VehicleKey Create(const std::string& id, bool data_loss = false,
                    bool damaged = false) {
    VehicleConfig config = TestConfig();
    config.data_loss = data_loss;
    config.damaged = damaged;
    return *BlockingWrites(&memory_).Create(id, codec_.EncodeVehicle(config));
  }

  MemoryStorage memory_;
  WatchedStorage storage_{&memory_};
  PlainCodec codec_;
};

TEST_F(VehicleCensusTest, CountsTheRowsOfTheStoreByState) {
  for (int i = 0; i < 2500; ++i) Create("active-" + std::to_string(i));
  Create("loss", true);
  Create("damaged", false, true);
  Create("both", true, true);
  Create("row");
  memory_.DamageVehicle("row");
  VehicleCensus census(&storage_, &codec_, std::nullopt);
  EXPECT_EQ(Shown(census), "unknown");
  while (!census.Read()) census.Continue();
  EXPECT_EQ(Shown(census), "2500 active, 1 data loss, 3 damaged");
  // One server alone knows the rest by itself.
  Create("unseen");
  census.Continue();
  EXPECT_EQ(Shown(census), "2500 active, 1 data loss, 3 damaged");
}

TEST_F(VehicleCensusTest, GoesOnWhereTheStoreCouldNotBeRead) {
  Create("one");
  VehicleCensus census(&storage_, &codec_, std::nullopt);
  storage_.FailReads(absl::UnavailableError("away"));
  census.Continue();
  EXPECT_EQ(Shown(census), "unknown");
  storage_.FailReads(absl::OkStatus());
  census.Continue();
  EXPECT_EQ(Shown(census), "1 active, 0 data loss, 0 damaged");
}

TEST_F(VehicleCensusTest, FollowsWhatThisServerDoes) {
  const VehicleKey first = Create("first");
  VehicleCensus census(&storage_, &codec_, std::nullopt);
  census.Continue();
  const VehicleKey second = Create("second");
  census.Created(second);
  census.Found(second, State::kActive);
  EXPECT_EQ(Shown(census), "2 active, 0 data loss, 0 damaged");
  // The rows had been read since it was created.
  census.Created(first);
  EXPECT_EQ(Shown(census), "2 active, 0 data loss, 0 damaged");
  census.Found(first, State::kDataLoss);
  census.Found(second, State::kDamaged);
  EXPECT_EQ(Shown(census), "0 active, 1 data loss, 1 damaged");
  census.Found(first, State::kActive);
  census.Deleted(second);
  EXPECT_EQ(Shown(census), "1 active, 0 data loss, 0 damaged");
}

TEST_F(VehicleCensusTest, ReadsAllAgainWhereOthersChangeVehiclesToo) {
  Create("first");
  VehicleCensus census(&storage_, &codec_, std::chrono::milliseconds(0));
  census.Continue();
  EXPECT_EQ(Shown(census), "1 active, 0 data loss, 0 damaged");
  Create("of another server", false, true);
  census.Continue();
  EXPECT_EQ(Shown(census), "1 active, 0 data loss, 1 damaged");
}

// Whatever comes between two reads of a count is in it once.
TEST_F(VehicleCensusTest, CountsWhatComesWhileRowsAreRead) {
  for (int i = 0; i < 1500; ++i) Create("v" + std::to_string(i));
  const VehicleKey early = memory_.GetVehicle("v0")->key;
  const VehicleKey late = memory_.GetVehicle("v1499")->key;
  VehicleCensus census(&storage_, &codec_, std::nullopt);
  int reads = 0;
  storage_.before_rows = [&] {
    if (++reads != 2) return;
    // The first thousand rows were read, the others were not.
    ASSERT_THAT(BlockingWrites(&memory_).Delete(early), IsOk());
    census.Deleted(early);
    ASSERT_THAT(BlockingWrites(&memory_).Delete(late), IsOk());
    census.Deleted(late);
    census.Created(Create("new"));
    census.Found(memory_.GetVehicle("v1")->key, State::kDamaged);
    census.Found(memory_.GetVehicle("v1498")->key, State::kDataLoss);
  };
  while (!census.Read()) census.Continue();
  EXPECT_EQ(Shown(census), "1497 active, 1 data loss, 1 damaged");
}

TEST_F(VehicleCensusTest, HearsOfEveryChangeOfAVehicleInMemory) {
  const auto census =
      std::make_shared<VehicleCensus>(&storage_, &codec_, std::nullopt);
  census->Continue();
  Executor executor(2);
  Fleet::Options options;
  options.census = census;
  Fleet fleet(&storage_, &codec_, &executor, options);
  const Answer<absl::StatusOr<Snapshot>> created;
  fleet.Create("truck", TestConfig(), TakingCreated(created));
  ASSERT_THAT(created.Get(), IsOk());
  EXPECT_EQ(Shown(*census), "1 active, 0 data loss, 0 damaged");
  auto session = fleet.Session("truck");
  const std::string uid = ReadNow(*session)->config.uid;
  EXPECT_FALSE(CheckAcknowledgedNow(*session, 9, uid).ok());
  EXPECT_EQ(Shown(*census), "0 active, 1 data loss, 0 damaged");
  ASSERT_THAT(AcceptDataLossNow(*session, 0), IsOk());
  EXPECT_EQ(Shown(*census), "1 active, 0 data loss, 0 damaged");
  ASSERT_THAT(DeleteNow(*session), IsOk());
  EXPECT_EQ(Shown(*census), "0 active, 0 data loss, 0 damaged");
}

}  // namespace
}  // namespace revisit::server
