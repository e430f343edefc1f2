// Poses that a vehicle's settings no longer keep leave the store and the graph.
#include "server/sessions/pose_dropper.h"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <algorithm>
#include <atomic>
#include <chrono>
#include <cstdint>
#include <functional>
#include <memory>
#include <numeric>
#include <string>
#include <thread>
#include <utility>
#include <vector>

#include "core/drive/findings.h"
#include "server/sessions/executor.h"
#include "server/sessions/fleet.h"
#include "tests/server/error_matchers.h"
#include "tests/server/held_storage.h"
#include "tests/server/memory_storage.h"
#include "tests/server/plain_codec.h"
#include "tests/server/sessions/session_testing.h"
#include "tests/server/storage_testing.h"

namespace revisit::server {
namespace {

using absl::StatusCode;
using ::testing::_;
using ::testing::HasSubstr;

// A sanitizer makes a look take a hundred times as long.
#if defined(__SANITIZE_THREAD__) || defined(__SANITIZE_ADDRESS__)
constexpr std::uint64_t kLongDrive = 3000;
#else
constexpr std::uint64_t kLongDrive = 40'000;
#endif

constexpr std::int64_t kSecond = 1'000'000'000;
constexpr std::int64_t kYear = std::int64_t{365} * 24 * 3600;

constexpr auto kClosure = PairKind::kLoopClosure;

bool WarnsOfStamps(const Acknowledgement& ack) {
  return ack.stamp_ahead ||
         std::any_of(ack.findings.begin(), ack.findings.end(),
                     [](const core::Finding& found) {
                       return found.code == core::FindingCode::kStampsLeap;
                     });
}

// A fleet with one vehicle, which goes around and around a square of 20 m.
class RetentionTest : public ::testing::Test {
 protected:
  static constexpr char kId[] = "truck";
  static constexpr std::uint64_t kBatch = 10;

  RetentionTest() : storage_(&memory_) { Open(); }
  ~RetentionTest() override { storage_.ReleaseAll(); }

  void Open(std::uint64_t snapshot_poses = 0) {
    session_.reset();
    fleet_.reset();
    Fleet::Options options;
    options.snapshots.poses = snapshot_poses;
    options.retention.drop = [this](const RetentionMonitor::Drop& drop) {
      drops_.push_back(drop);
    };
    options.retention.withheld = [this](const std::string& vehicle_id,
                                        const absl::Status& status) {
      EXPECT_EQ(vehicle_id, kId);
      withheld_.push_back(status);
    };
    options.clock = [this] { return now_seconds_ * kSecond; };
    fleet_ = std::make_unique<Fleet>(&storage_, &codec_, &executor_, options);
  }

  void Create(int max_passes) {
    core::RetentionOptions retention;
    retention.max_passes = max_passes;
    Create(retention);
  }
  void Create(const core::RetentionOptions& retention) {
    VehicleConfig config = TestConfig();
    config.drive.retention = retention;
    const Answer<absl::StatusOr<Snapshot>> answer;
    fleet_->Create(kId, config, TakingCreated(answer));
    ASSERT_THAT(answer.Get(), IsOk());
    key_ = memory_.GetVehicle(kId)->key;
  }
  // Changes the settings of the vehicle that is there.
  void Keep(core::RetentionOptions retention) {
    ASSERT_THAT(UpdateNow(session(),
                          [retention](const VehicleView& view) {
                            VehicleConfig config = view.config;
                            config.drive.retention = retention;
                            return config;
                          }),
                IsOk());
  }
  void KeepPasses(int max_passes) {
    core::RetentionOptions retention;
    retention.max_passes = max_passes;
    Keep(retention);
  }
  void Drive(std::uint64_t poses) {
    for (const std::uint64_t end = last_ + poses; last_ < end;
         last_ += kBatch) {
      ASSERT_THAT(AppendNow(session(), SquareBatch(last_ + 1, kBatch)), IsOk());
    }
  }
  // With stamps from the sequences, in seconds. Answers where stamps were
  // warned of.
  std::vector<Acknowledgement> DriveAt(
      std::uint64_t poses,
      const std::function<std::int64_t(std::uint64_t)>& stamp) {
    std::vector<Acknowledgement> told;
    for (const std::uint64_t end = last_ + poses; last_ < end;
         last_ += kBatch) {
      const absl::StatusOr<Acknowledgement> ack =
          AppendNow(session(), SquareBatch(last_ + 1, kBatch, stamp));
      EXPECT_THAT(ack, IsOk());
      if (ack.ok() && WarnsOfStamps(*ack)) told.push_back(*ack);
    }
    return told;
  }
  // So long in one place that a look at it takes half a second or more.
  void DriveLong() {
    while (last_ < kLongDrive) {
      ASSERT_THAT(AppendNow(session(), SquareBatch(last_ + 1, 1000)), IsOk());
      last_ += 1000;
    }
  }
  // Whether the history is looked at. A look begins after the answer to what
  // led to it, and before what is asked next.
  bool IsLookedAt() {
    // Behind what was asked before. Nothing of the view is taken, which would
    // hold the look up by more than it takes.
    const Answer<absl::Status> read;
    session().Read([read](const absl::StatusOr<VehicleView>& view) {
      read.Set(view.status());
    });
    EXPECT_THAT(read.Get(), IsOk());
    return fleet_->retention().vehicles > 0;
  }
  // Once what fell due is done.
  Snapshot Settled() {
    while (IsLookedAt()) {
      std::this_thread::sleep_for(std::chrono::milliseconds(1));
    }
    return *UpdateNow(session(),
                      [](const VehicleView& view) { return view.config; });
  }
  VehicleSession& session() { return *(session_ = fleet_->Session(kId)); }
  std::vector<BatchRecord> Rows() { return *ReadAll(memory_, key_, 1, last_); }
  bool IsKept(std::uint64_t sequence) {
    const auto row = *ReadAll(memory_, key_, sequence, sequence);
    return row[0].payload.rfind("dropped", 0) != 0;
  }

  // A group of the vehicle and another one.
  void CreateGroup(const std::string& id) {
    const absl::StatusOr<VehicleKey> other =
        BlockingWrites(&memory_).Create("other of " + id);
    ASSERT_THAT(other, IsOk());
    other_ = *other;
    ASSERT_THAT(groups_.Create(id), IsOk());
    ASSERT_THAT(groups_.Change(id, {AddGroupMember{{key_, ""}},
                                    AddGroupMember{{other_, ""}}}),
                IsOk());
  }
  // A loop closure of a pose of the vehicle and one of the other in the last
  // group that was made.
  GroupLinkRecord LinkOf(const std::string& id, std::uint64_t sequence) const {
    return {id, LinkState::kConfirmed, {key_, sequence}, {other_, 1}};
  }
  void Link(const std::string& group, const GroupLinkRecord& link) {
    ASSERT_THAT(groups_.Change(group, {AddGroupLink{link}}), IsOk());
  }
  void Unlink(const std::string& group, const std::string& id) {
    ASSERT_THAT(groups_.Change(group, {RemoveGroupLink{id}}), IsOk());
  }

  // The vehicle as it is, and as another server loads it.
  void ExpectAsLoaded() {
    const Snapshot live = Settled();
    Executor executor(2);
    Fleet other(&memory_, &codec_, &executor, Fleet::Options());
    const auto session = other.Session(kId);
    const Snapshot loaded = *ReadNow(*session);
    EXPECT_EQ(loaded.graph, live.graph);
    EXPECT_EQ(loaded.candidates, live.candidates);
    EXPECT_EQ(loaded.first_kept, live.first_kept);
    EXPECT_EQ(loaded.dropped, live.dropped);
    EXPECT_EQ(loaded.travelled_meters, live.travelled_meters);
    EXPECT_EQ(loaded.revision, live.revision);
    EXPECT_EQ(loaded.consistency.inflation, live.consistency.inflation);
    EXPECT_EQ(loaded.consistency.confirmed, live.consistency.confirmed);
    EXPECT_EQ(loaded.consistency.rejected, live.consistency.rejected);
  }

  MemoryStorage memory_;
  HeldStorage storage_;
  const PlainCodec codec_;
  Executor executor_{2};
  // The server's clock.
  std::atomic<std::int64_t> now_seconds_{kYear};
  // Written on the vehicle's strand.
  std::vector<RetentionMonitor::Drop> drops_;
  std::vector<absl::Status> withheld_;
  std::unique_ptr<Fleet> fleet_;
  std::shared_ptr<VehicleSession> session_;
  VehicleKey key_ = 0;
  BlockingGroupWrites groups_{&memory_};
  VehicleKey other_ = 0;
  std::uint64_t last_ = 0;
};

TEST_F(RetentionTest, AVehicleThatGoesRoundStaysBounded) {
  Create(3);
  Drive(20'000);
  const Snapshot settled = Settled();
  EXPECT_LT(settled.node_count, 1400);
  EXPECT_GT(settled.node_count, 300);
  EXPECT_GT(settled.dropped, 18'000u);
  EXPECT_EQ(settled.durable_sequence, 20'000u);
  EXPECT_LT(Rows().size(), 200u);
  // Corners are cut by a little.
  EXPECT_NEAR(settled.travelled_meters, 20'000.0, 25.0);
  EXPECT_NE(settled.candidates, "");
  ExpectAsLoaded();
}

// Its first pose alone says how its frame lies to those that come later.
TEST_F(RetentionTest, KeepsThePoseThatBeganARecording) {
  core::RetentionOptions retention;
  retention.max_age_ns = 2000 * kSecond;
  Create(retention);
  ASSERT_THAT(AppendNow(session(), "recording " + SquareBatch(1, kBatch)),
              IsOk());
  last_ = kBatch;
  Drive(8000);
  const Snapshot settled = Settled();
  EXPECT_GT(settled.dropped, 4000u);
  EXPECT_EQ(settled.first_kept, 1u);
  EXPECT_THAT(Rows().front().payload, HasSubstr("recording 1 "));
  ExpectAsLoaded();
}

TEST_F(RetentionTest, FindsTheSamePlacesAsOneThatKeepsEverything) {
  Create(3);
  Drive(4000);
  const Snapshot bounded = Settled();
  EXPECT_GT(bounded.dropped, 2000u);
  // Both end at the same place of the square, so a candidate is a lap earlier.
  EXPECT_THAT(bounded.candidates, HasSubstr("0x1"));
}

TEST_F(RetentionTest, CountsAndReportsWhatItDrops) {
  Create(3);
  Drive(5000);
  const Snapshot settled = Settled();
  const RetentionMonitor::Counts counts = fleet_->retention();
  EXPECT_EQ(counts.poses, settled.dropped);
  ASSERT_GT(drops_.size(), 1u);
  std::uint64_t poses = 0;
  for (const RetentionMonitor::Drop& drop : drops_) {
    EXPECT_EQ(drop.vehicle_id, kId);
    EXPECT_GT(drop.poses, 0u);
    poses += drop.poses;
  }
  EXPECT_EQ(poses, settled.dropped);
  EXPECT_EQ(drops_.back().first_kept_sequence, settled.first_kept);
  EXPECT_EQ(std::accumulate(counts.seconds.counts.begin(),
                            counts.seconds.counts.end(), std::uint64_t{0}),
            drops_.size());
}

TEST_F(RetentionTest, AppendsReadsAndChangesGoOnWhileItLooks) {
  Create(0);
  DriveLong();
  KeepPasses(core::kMostPasses);
  ASSERT_TRUE(IsLookedAt());
  Drive(kBatch);
  // Behind the first laps, which are known best and stay.
  EXPECT_THAT(AddPairNow(session(), kClosure, {"a", 2000, 1920, 1}), IsOk());
  EXPECT_TRUE(IsLookedAt());
  EXPECT_EQ(fleet_->retention().poses, 0u);
  const Snapshot settled = Settled();
  EXPECT_GT(settled.dropped, kLongDrive / 4);
  // The poses of the closure that came meanwhile stay.
  EXPECT_THAT(DeletePairNow(session(), kClosure, "a"), IsOk());
  EXPECT_THAT(AddPairNow(session(), kClosure, {"b", 2000, 1920, 2}), IsOk());
  EXPECT_THAT(AddPairNow(session(), kClosure, {"c", 1700, 1620, 3}),
              IsError(StatusCode::kOutOfRange, "POSES_DROPPED", _));
  ExpectAsLoaded();
}

TEST_F(RetentionTest, SettingsThatChangeWhileItLooksAreThoseThatCount) {
  Create(0);
  DriveLong();
  KeepPasses(core::kMostPasses);
  ASSERT_TRUE(IsLookedAt());
  KeepPasses(0);
  EXPECT_EQ(Settled().dropped, 0u);
  KeepPasses(core::kMostPasses);
  ASSERT_TRUE(IsLookedAt());
  KeepPasses(2);
  EXPECT_GT(Settled().dropped, 3 * kLongDrive / 4);
  EXPECT_EQ(drops_.size(), 1u);
}

TEST_F(RetentionTest, KeepsEverythingUnlessItIsAsked) {
  Create(0);
  Drive(3000);
  EXPECT_EQ(Settled().dropped, 0u);
  EXPECT_EQ(Rows().size(), 300u);
  // Until it is asked for.
  KeepPasses(2);
  EXPECT_GT(Settled().dropped, 2000u);
  ExpectAsLoaded();
}

TEST_F(RetentionTest, WhatWasDroppedIsARowToWhichMoreIsAdded) {
  Create(2);
  for (int round = 0; round < 6; ++round) {
    Drive(1000);
    const std::uint64_t expected = Settled().dropped;
    std::uint64_t dropped = 0;
    std::uint64_t next = 0;
    std::size_t rows = 0;
    for (const BatchRecord& row : Rows()) {
      if (row.payload.rfind("dropped", 0) != 0) continue;
      EXPECT_NE(row.first_sequence, next) << "next to another";
      next = row.first_sequence + row.count;
      dropped += row.count;
      ++rows;
    }
    EXPECT_LT(rows, 6u);
    EXPECT_EQ(dropped, expected);
  }
  EXPECT_GT(Settled().dropped, 4000u);
}

TEST_F(RetentionTest, DividesLongRowsOfWhichAPartGoes) {
  Create(0);
  for (; last_ < 2400; last_ += 600) {
    ASSERT_THAT(AppendNow(session(), SquareBatch(last_ + 1, 600)), IsOk());
  }
  // Revised, as they were.
  ASSERT_THAT(
      ReviseNow(session(),
                [](const VehicleView&) {
                  RevisionPlan plan;
                  plan.batches = BatchesOf({{1, 600, 0, SquareBatch(1, 600)}});
                  plan.revised_count = 600;
                  return plan;
                }),
      IsOk());
  ASSERT_EQ(Rows().size(), 4u);
  KeepPasses(2);
  const Snapshot settled = Settled();
  EXPECT_GT(settled.dropped, 1500u);
  ExpectAsLoaded();
  const auto sent = *ReadAll(memory_, key_, 1, last_, BatchVersion::kAsSent);
  const auto now = Rows();
  ASSERT_EQ(sent.size(), now.size());
  std::size_t revised = 0;
  std::size_t parts = 0;
  for (std::size_t i = 0; i < sent.size(); ++i) {
    if (sent[i].payload.rfind("dropped", 0) == 0) continue;
    parts += now[i].count < 600 ? 1 : 0;
    if (now[i].revision == sent[i].revision) continue;
    EXPECT_EQ(now[i].revision, 6u);
    EXPECT_LT(sent[i].revision, 6u);
    ++revised;
  }
  EXPECT_GT(parts, 0u);
  EXPECT_GT(revised, 0u);
  // What is left of a row is compared with what comes again.
  EXPECT_THAT(AppendNow(session(), SquareBatch(1, 2400)), IsOk());
  EXPECT_THAT(
      AppendNow(session(), StraightBatch(1, 600)),
      IsError(StatusCode::kAlreadyExists, "SEQUENCE_CONTENT_MISMATCH", _));
}

TEST_F(RetentionTest, KeepsWhatLoopClosuresReferTo) {
  Create(2);
  Drive(900);
  ASSERT_THAT(AddPairNow(session(), kClosure, {"a", 845, 605, 1}), IsOk());
  ASSERT_THAT(AddPairNow(session(), kClosure, {"m", 855, 615, 2, "0 0 0 1"}),
              IsOk());
  ASSERT_THAT(
      AddPairNow(session(), PairKind::kRejectedCandidate, {"r", 700, 500, 3}),
      IsOk());
  Drive(4000);
  const Snapshot settled = Settled();
  EXPECT_GT(settled.dropped, 2000u);
  EXPECT_EQ(settled.loop_closure_count, 2);
  EXPECT_EQ(settled.consistency.confirmed, 2);
  EXPECT_THAT(settled.graph, HasSubstr(" - "));
  ExpectAsLoaded();
  // The same pair again is the one that is there; another one has no poses.
  EXPECT_THAT(
      AddPairNow(session(), PairKind::kRejectedCandidate, {"r", 700, 500, 3}),
      IsOk());
  EXPECT_THAT(AddPairNow(session(), kClosure, {"b", 4000, 1000, 4}),
              IsError(StatusCode::kOutOfRange, "POSES_DROPPED",
                      HasSubstr("no longer")));
  EXPECT_THAT(DeletePairNow(session(), PairKind::kRejectedCandidate, "r"),
              IsOk());
  // Once it is gone, so are its poses.
  ASSERT_THAT(DeletePairNow(session(), kClosure, "a"), IsOk());
  ASSERT_THAT(DeletePairNow(session(), kClosure, "m"), IsOk());
  Drive(1000);
  ExpectAsLoaded();
}

TEST_F(RetentionTest, KeepsWhatLoopClosuresOfGroupsReferTo) {
  Create(2);
  Drive(900);
  CreateGroup("one");
  Link("one", LinkOf("a", 605));
  CreateGroup("two");
  GroupLinkRecord doubted = LinkOf("b", 405);
  std::swap(doubted.query, doubted.matched);
  doubted.state = LinkState::kSuspect;
  Link("two", doubted);
  Drive(4000);
  EXPECT_GT(Settled().dropped, 2000u);
  for (const std::uint64_t end : {405, 605}) {
    // With the path that leads to it, as that of a loop closure of the vehicle.
    for (std::uint64_t i = 0; i <= 15; i += 5) {
      EXPECT_TRUE(IsKept(end - i)) << end - i;
    }
  }
  EXPECT_FALSE(IsKept(505));
  ExpectAsLoaded();
  // Once they are gone, so are their poses.
  Unlink("one", "a");
  Drive(1000);
  Settled();
  EXPECT_FALSE(IsKept(605));
  EXPECT_TRUE(IsKept(405));
  ASSERT_THAT(groups_.Delete("two"), IsOk());
  Drive(1000);
  Settled();
  EXPECT_FALSE(IsKept(405));
  ExpectAsLoaded();
}

TEST_F(RetentionTest, KeepsWhatALoopClosureOfAGroupRefersToThatCameMeanwhile) {
  Create(0);
  DriveLong();
  CreateGroup("g");
  KeepPasses(core::kMostPasses);
  ASSERT_TRUE(IsLookedAt());
  // Behind the first laps, which are known best and stay.
  Link("g", LinkOf("a", 1760));
  EXPECT_TRUE(IsLookedAt());
  EXPECT_GT(Settled().dropped, kLongDrive / 4);
  EXPECT_TRUE(IsKept(1760));
  EXPECT_FALSE(IsKept(1680));
}

TEST_F(RetentionTest, DropsNothingWhileALoopClosureOfAGroupIsDamaged) {
  Create(0);
  Drive(3000);
  CreateGroup("g");
  GroupLinkRecord link = LinkOf("a", 605);
  link.damage = Error(StatusCode::kDataLoss, "STORE_CORRUPT", "the row");
  Link("g", link);
  KeepPasses(2);
  EXPECT_EQ(Settled().dropped, 0u);
  ASSERT_EQ(withheld_.size(), 1u);
  EXPECT_THAT(withheld_[0], IsError(StatusCode::kDataLoss, "STORE_CORRUPT", _));
  Unlink("g", "a");
  Drive(1000);
  EXPECT_GT(Settled().dropped, 2000u);
  EXPECT_EQ(withheld_.size(), 1u);
}

// A loop closure that names poses that are gone, as of a server that knew
// nothing of it.
TEST_F(RetentionTest, LoopClosuresOfGroupsWhosePosesAreGoneKeepNothing) {
  Create(2);
  Drive(4000);
  Settled();
  ASSERT_FALSE(IsKept(1005));
  CreateGroup("g");
  Link("g", LinkOf("a", 1005));
  const std::uint64_t dropped = Settled().dropped;
  Drive(1000);
  EXPECT_GT(Settled().dropped, dropped + 500);
  ExpectAsLoaded();
}

TEST_F(RetentionTest, PosesThatWereDroppedAreAcknowledgedAgain) {
  Create(2);
  Drive(2000);
  const Snapshot settled = Settled();
  ASSERT_GT(settled.dropped, 500u);
  EXPECT_THAT(AppendNow(session(), SquareBatch(1001, 200)), IsOk());
  // Their content is not known any more; that of others is.
  EXPECT_THAT(AppendNow(session(), StraightBatch(1001, 10)), IsOk());
  EXPECT_THAT(
      AppendNow(session(), StraightBatch(1991, 10)),
      IsError(StatusCode::kAlreadyExists, "SEQUENCE_CONTENT_MISMATCH", _));
}

TEST_F(RetentionTest, GoesOnWithSnapshots) {
  Open(/*snapshot_poses=*/200);
  Create(2);
  for (int part = 0; part < 6; ++part) {
    Drive(700);
    fleet_->WriteSnapshots();
    const Snapshot live = Settled();
    Open(200);
    const Snapshot loaded = *ReadNow(session());
    EXPECT_EQ(loaded.graph, live.graph);
    EXPECT_EQ(loaded.candidates, live.candidates);
    EXPECT_EQ(loaded.dropped, live.dropped);
    ExpectAsLoaded();
  }
}

TEST_F(RetentionTest, AWriteThatFailsLeavesASoundVehicle) {
  Create(0);
  Drive(3000);
  storage_.Hold();
  const Answer<absl::StatusOr<Snapshot>> updated;
  session().Update(
      [](const VehicleView& view) {
        VehicleConfig config = view.config;
        config.drive.retention.max_passes = 2;
        return config;
      },
      Taking(updated));
  storage_.Await(1);
  storage_.ReleaseOne();
  ASSERT_THAT(updated.Get(), IsOk());
  // The first part gets into the store, the second does not.
  storage_.Await(1);
  storage_.ReleaseOne();
  storage_.Await(1);
  storage_.FailOne(Error(StatusCode::kResourceExhausted, "STORAGE_FULL", "no"));
  storage_.ReleaseAll();
  const Snapshot settled = Settled();
  EXPECT_GT(settled.dropped, 0u);
  EXPECT_LT(settled.dropped, 1000u);
  ExpectAsLoaded();
  // The rest follows when the vehicle has grown.
  Drive(1000);
  EXPECT_GT(Settled().dropped, 2000u);
  ExpectAsLoaded();
}

TEST_F(RetentionTest, VehicleThatIsLoadedWithPosesThatAreTooOldLosesThem) {
  Create(0);
  Drive(3000);
  core::RetentionOptions hour;
  hour.max_age_ns = std::int64_t{3600} * 1'000'000'000;
  Keep(hour);
  EXPECT_EQ(Settled().dropped, 0u);
  // The store is left as by a server that ended after the settings had
  // changed, before it looked.
  VehicleRecord record = *memory_.GetVehicle(kId);
  VehicleConfig config = *codec_.DecodeVehicle(record);
  config.drive.retention.max_age_ns = std::int64_t{1500} * 1'000'000'000;
  session_.reset();
  fleet_.reset();
  ASSERT_THAT(BlockingWrites(&memory_).Update(
                  key_, codec_.EncodeVehicle(config), record.revision + 1),
              IsOk());
  Open();
  // Poses with stamps below 1491 s are dropped, in whole rows: the newest stamp
  // is that on which ten nodes agree.
  EXPECT_EQ(Settled().dropped, 1490u);
  ExpectAsLoaded();
}

core::RetentionOptions Days(std::int64_t days) {
  core::RetentionOptions retention;
  retention.max_age_ns = days * 24 * 3600 * kSecond;
  return retention;
}

// Poses each hour.
std::int64_t Hourly(std::uint64_t sequence) {
  return static_cast<std::int64_t>(sequence) * 3600;
}

// The newest poses have wrong stamps, some decades ahead, and the server's
// clock is right.
TEST_F(RetentionTest, WrongStampsDropNothingAndAreTold) {
  now_seconds_ = Hourly(4000);
  Create(Days(365));
  EXPECT_TRUE(DriveAt(3990, Hourly).empty());
  const auto told = DriveAt(10, [](std::uint64_t sequence) {
    return Hourly(sequence) + (sequence == 4000 ? 130 * kYear : 0);
  });
  ASSERT_EQ(told.size(), 1u);
  ASSERT_TRUE(told[0].stamp_ahead);
  EXPECT_EQ(told[0].stamp_ahead->sequence, 4000u);
  EXPECT_EQ(told[0].stamp_ahead->nanoseconds / kSecond / kYear, 130);
  ASSERT_EQ(told[0].findings.size(), 1u);
  EXPECT_EQ(told[0].findings[0].code, core::FindingCode::kStampsLeap);
  ASSERT_TRUE(told[0].findings[0].leap);
  EXPECT_EQ(told[0].findings[0].leap->nanoseconds / kSecond / kYear, 130);
  EXPECT_EQ(Settled().dropped, 0u);
  // Nor by changed settings, after a load, or once the vehicle has grown.
  Keep(Days(364));
  EXPECT_EQ(Settled().dropped, 0u);
  Open();
  EXPECT_EQ(Settled().dropped, 0u);
  now_seconds_ = Hourly(4800);
  DriveAt(800, Hourly);
  EXPECT_EQ(Settled().dropped, 0u);
  ExpectAsLoaded();
}

// As the server's clock may be wrong, or the vehicle's may be behind it.
TEST_F(RetentionTest, WrongStampsThatTheClockAllowsDropNothing) {
  now_seconds_ = 200 * kYear;
  Create(Days(100));
  DriveAt(2000, Hourly);
  for (int round = 0; round < 8; ++round) {
    const std::uint64_t from = last_;
    const auto told = DriveAt(100, [from](std::uint64_t sequence) {
      return Hourly(sequence) + (sequence <= from + 4 ? 3 * kYear : 0);
    });
    ASSERT_EQ(told.size(), round == 0 ? 1u : 0u) << round;
  }
  const Snapshot settled = Settled();
  EXPECT_LE(settled.dropped, 400u);
  ExpectAsLoaded();
}

TEST_F(RetentionTest, ALeapThatLastsDropsWhatWasBeforeIt) {
  now_seconds_ = 10 * kYear;
  Create(Days(365));
  DriveAt(2000, Hourly);
  const auto leapt = [](std::uint64_t sequence) {
    return Hourly(sequence) + 5 * kYear;
  };
  const auto told = DriveAt(100, leapt);
  ASSERT_EQ(told.size(), 1u);
  EXPECT_FALSE(told[0].stamp_ahead);
  EXPECT_EQ(told[0].findings[0].code, core::FindingCode::kStampsLeap);
  Keep(Days(364));
  EXPECT_EQ(Settled().dropped, 0u);
  DriveAt(400, leapt);
  EXPECT_EQ(Settled().dropped, 2000u);
  ASSERT_EQ(drops_.size(), 1u);
  EXPECT_NEAR(static_cast<double>(drops_[0].nodes_too_old), 2000.0, 40.0);
  EXPECT_EQ(drops_[0].nodes_covered, 0);
  ExpectAsLoaded();
}

TEST_F(RetentionTest, StampsAheadOfTheClockDropNothingHoweverLongTheyLast) {
  now_seconds_ = Hourly(2000);
  Create(Days(365));
  DriveAt(2000, Hourly);
  const auto told = DriveAt(2000, [](std::uint64_t sequence) {
    return Hourly(sequence) + 74 * kYear;
  });
  // Once, not with each batch.
  ASSERT_EQ(told.size(), 1u);
  EXPECT_TRUE(told[0].stamp_ahead);
  EXPECT_EQ(Settled().dropped, 0u);
  // Once the clock has come there, they are as good as any.
  now_seconds_ = 80 * kYear;
  Open();
  EXPECT_EQ(Settled().dropped, 2000u);
}

}  // namespace
}  // namespace revisit::server
