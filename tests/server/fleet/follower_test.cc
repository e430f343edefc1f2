#include "server/fleet/follower.h"

#include <cstdint>
#include <memory>
#include <string>
#include <vector>

#include "gmock/gmock.h"
#include "gtest/gtest.h"
#include "server/sessions/vehicle_session.h"
#include "tests/server/error_matchers.h"
#include "tests/server/fleet/histories.h"
#include "tests/server/memory_storage.h"
#include "tests/server/plain_codec.h"
#include "tests/server/sessions/session_testing.h"
#include "tests/server/storage_testing.h"

namespace revisit::server {
namespace {

using absl::StatusCode;
using ::testing::_;

// A vehicle `truck` that a session owns, and a follower that reads the same
// store.
class FollowerTest : public ::testing::Test {
 protected:
  FollowerTest() {
    EXPECT_THAT(BlockingWrites(&memory_).Create(
                    "truck", codec_.EncodeVehicle(TestConfig())),
                IsOk());
    SnapshotPolicy snapshots;
    snapshots.poses = 100;
    session_ = VehicleSession::Load("truck", &memory_, &codec_, &executor_,
                                    VehicleSession::Limits(), snapshots);
  }
  ~FollowerTest() override { CloseNow(*session_); }

  void Append(std::uint64_t count) {
    ASSERT_THAT(AppendNow(*session_, SquareBatch(last_ + 1, count)), IsOk());
    last_ += count;
  }

  void AddClosure(std::uint64_t query, std::uint64_t matched) {
    const std::string id = std::to_string(query);
    ASSERT_THAT(AddPairNow(*session_, PairKind::kLoopClosure,
                           {id, query, matched, 1, "0.5 0.25 0.01 0.1"}),
                IsOk());
  }

  void Update(const std::function<void(core::DriveSettings*)>& change) {
    ASSERT_THAT(UpdateNow(*session_,
                          [&](const VehicleView& view) {
                            VehicleConfig config = view.config;
                            change(&config.drive);
                            return absl::StatusOr<VehicleConfig>(config);
                          }),
                IsOk());
  }

  // The history as the session has it.
  std::string Owned() {
    const Answer<std::string> answer;
    session_->Read([answer](const absl::StatusOr<VehicleView>& view) {
      answer.Set(ToText(KnownHistory{view->id, view->key, view->config,
                                     view->revision, view->durable_sequence, "",
                                     HistoryView(view->drive)}));
    });
    return answer.Get();
  }

  // Follows until nothing is left to read, a row or two at a time.
  absl::Status Follow() {
    while (true) {
      int rows = 0;
      const auto reached = follower_.Continue(*memory_.GetVehicle("truck"),
                                              [&] { return ++rows < 2; });
      if (!reached.ok()) return reached.status();
      if (*reached) return absl::OkStatus();
    }
  }

  void ExpectSame() {
    ASSERT_THAT(Follow(), IsOk());
    EXPECT_EQ(ToText(*follower_.history()), Owned());
  }

  MemoryStorage memory_;
  PlainCodec codec_;
  Executor executor_{2};
  std::shared_ptr<VehicleSession> session_;
  std::uint64_t last_ = 0;
  VehicleReader vehicle_{"truck", &memory_, &codec_};
  Follower follower_{&vehicle_};
};

TEST_F(FollowerTest, HasTheOwnersDriveToTheBit) {
  ExpectSame();
  Append(150);
  ExpectSame();
  for (const std::uint64_t count : {1u, 40u, 7u}) {
    Append(count);
    Append(count);
    ExpectSame();
  }
  EXPECT_EQ(follower_.made(), 1u);
}

TEST_F(FollowerTest, GivesTheSameHistoryWhileNothingChanges) {
  Append(100);
  ASSERT_THAT(Follow(), IsOk());
  const auto history = follower_.history();
  ASSERT_THAT(Follow(), IsOk());
  EXPECT_EQ(follower_.history(), history);
  Append(10);
  ASSERT_THAT(Follow(), IsOk());
  EXPECT_EQ(follower_.history()->series, history->series);
  EXPECT_EQ(history->last_sequence, 100u);
}

TEST_F(FollowerTest, BeginsWithASnapshot) {
  Append(300);
  const Answer<bool> written;
  session_->WriteSnapshot(100, [written] { written.Set(true); });
  EXPECT_TRUE(written.Get());
  ASSERT_NE(SnapshotOf(memory_, memory_.GetVehicle("truck")->key), "none");
  Append(30);
  AddClosure(290, 210);
  ExpectSame();
}

TEST_F(FollowerTest, MakesTheDriveAnewWherePosesWereRevised) {
  Append(100);
  Append(100);
  ASSERT_THAT(Follow(), IsOk());
  const std::string before = ToText(*follower_.history());
  const std::string series = follower_.history()->series;
  std::vector<double> moved;
  for (int i = 0; i < 100; ++i) moved.push_back(200.0 + 1.5 * i);
  ASSERT_THAT(
      ReviseNow(
          *session_,
          [&](const VehicleView&) {
            RevisionPlan plan;
            plan.batches = BatchesOf({{101, 100, 0, PlainBatch(101, moved)}});
            plan.revised_count = 100;
            return absl::StatusOr<RevisionPlan>(plan);
          }),
      IsOk());
  // The view of before serves until the other one is made.
  ASSERT_THAT(
      follower_.Continue(*memory_.GetVehicle("truck"), [] { return false; }),
      IsOk());
  EXPECT_TRUE(follower_.is_making());
  EXPECT_EQ(ToText(*follower_.history()), before);
  ExpectSame();
  EXPECT_EQ(follower_.made(), 2u);
  EXPECT_NE(follower_.history()->series, series);
}

TEST_F(FollowerTest, SeesLoopClosuresComeAndGo) {
  Append(300);
  ExpectSame();
  AddClosure(200, 120);
  ExpectSame();
  AddClosure(250, 170);
  Append(20);
  ExpectSame();
  ASSERT_THAT(DeletePairNow(*session_, PairKind::kLoopClosure, "200"), IsOk());
  ExpectSame();
  EXPECT_EQ(follower_.history()->view->loops.size(), 1u);
}

TEST_F(FollowerTest, SeesPosesThatAreKeptNoLonger) {
  Append(1500);
  ExpectSame();
  Update([](core::DriveSettings* drive) { drive->retention.max_passes = 2; });
  ASSERT_TRUE(Eventually([&] { return ReadNow(*session_)->dropped > 0; }));
  ExpectSame();
  Append(50);
  ExpectSame();
}

TEST_F(FollowerTest, SeesSettingsThatMoveNodes) {
  Append(200);
  ExpectSame();
  Update([](core::DriveSettings* drive) { drive->node_spacing_meters = 2.0; });
  ExpectSame();
  EXPECT_EQ(follower_.history()->view->node_spacing_meters, 2.0);
}

TEST_F(FollowerTest, SaysThatAVehicleIsDamaged) {
  Append(100);
  Append(100);
  memory_.DamagePose("truck", 50);
  EXPECT_THAT(Follow(), IsError(StatusCode::kDataLoss, "STORE_CORRUPT", _));
  EXPECT_EQ(follower_.history(), nullptr);
}

TEST_F(FollowerTest, SeesAnotherVehicleOfTheName) {
  Append(100);
  ExpectSame();
  ASSERT_THAT(DeleteNow(*session_), IsOk());
  CloseNow(*session_);
  VehicleConfig config = TestConfig();
  config.uid = "another";
  ASSERT_THAT(
      BlockingWrites(&memory_).Create("truck", codec_.EncodeVehicle(config)),
      IsOk());
  session_ = VehicleSession::Load("truck", &memory_, &codec_, &executor_,
                                  VehicleSession::Limits());
  last_ = 0;
  Append(100);
  ExpectSame();
  EXPECT_EQ(follower_.history()->config.uid, "another");
}

}  // namespace
}  // namespace revisit::server
