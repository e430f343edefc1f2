// Vehicles that are loaded from snapshots of their graphs, beside those that
// are replayed whole.
#include "server/sessions/snapshots.h"

#include <algorithm>
#include <chrono>
#include <cstdint>
#include <memory>
#include <random>
#include <string>
#include <thread>
#include <utility>
#include <vector>

#include "gmock/gmock.h"
#include "gtest/gtest.h"
#include "server/base/status.h"
#include "server/sessions/fleet.h"
#include "server/storage/sqlite/sqlite_storage.h"
#include "tests/random.h"
#include "tests/server/error_matchers.h"
#include "tests/server/memory_storage.h"
#include "tests/server/plain_codec.h"
#include "tests/server/sessions/session_testing.h"
#include "tests/server/sessions/snapshots_testing.h"
#include "tests/server/storage_testing.h"
#include "tests/server/temporary_directory.h"

namespace revisit::server {
namespace {

using absl::StatusCode;
using std::chrono::minutes;
using std::chrono::steady_clock;
using ::testing::_;
using ::testing::HasSubstr;
using ::testing::IsEmpty;

TEST_F(SnapshotsTest, TheEndOfTheServerWritesOneIfManyPosesHaveCome) {
  Create();
  Append(49);
  session_.reset();
  Open();
  EXPECT_EQ(Stored(), "none");
  Append(1);
  session_.reset();
  Open();
  EXPECT_EQ(StoredSequence(), 50u);
  storage_.TakeLeastRead();
  EXPECT_EQ(Read().durable_sequence, 50u);
  EXPECT_EQ(storage_.TakeLeastRead(), WatchedStorage::kNone);
  ExpectAsReplayedWhole();
  EXPECT_THAT(TakeWarnings(), IsEmpty());
}

TEST_F(SnapshotsTest, NoneIsWrittenOfAGraphWithMoreNodesThanIsWorthIt) {
  // The graph has about a node for each pose.
  most_nodes_per_pose_ = 0.5;
  Open();
  Create();
  Append(60);
  session_.reset();
  most_nodes_per_pose_ = 1.25;
  Open();
  EXPECT_EQ(Stored(), "none");
  Append(1);
  session_.reset();
  Open();
  EXPECT_EQ(StoredSequence(), 61u);
}

TEST_F(SnapshotsTest, OnlyPosesAfterTheSnapshotAreReplayed) {
  Create();
  Append(60);
  session_.reset();
  Open();
  Append(20);
  session_.reset();
  Open();
  EXPECT_EQ(StoredSequence(), 60u);
  storage_.TakeLeastRead();
  EXPECT_EQ(Read().durable_sequence, 80u);
  EXPECT_EQ(storage_.TakeLeastRead(), 61u);
  ExpectAsReplayedWhole();
}

TEST_F(SnapshotsTest, ASnapshotMayEndWithinARowThatSeveralBatchesShare) {
  Create();
  Append(60);
  session_.reset();
  Open();
  session_.reset();
  // As if one row held the last poses of the snapshot too.
  const auto snapshot = **memory_.GetSnapshot(key_);
  MemoryStorage joined;
  BlockingWrites write(&joined);
  const VehicleRecord record = *memory_.GetVehicle(kId);
  const VehicleKey key = *write.Create(kId, record.payload, 1);
  ASSERT_THAT(write.Append(key, {1, 80, 2, SquareBatch(1, 80)}), IsOk());
  ASSERT_THAT(write.PutSnapshot(key, snapshot), IsOk());
  Executor executor(2);
  Fleet::Options options;
  options.snapshots.poses = 50;
  Fleet fleet(&joined, &codec_, &executor, options);
  const Snapshot loaded = *ReadNow(*fleet.Session(kId));
  EXPECT_EQ(loaded.durable_sequence, 80u);
  Append(20);
  EXPECT_EQ(loaded.graph, Read().graph);
}

TEST_F(SnapshotsTest, UnloadingWritesOneFirst) {
  Create();
  Append(60);
  session_.reset();
  UnloadAll();
  EXPECT_EQ(StoredSequence(), 60u);
  ExpectAsReplayedWhole();
}

TEST_F(SnapshotsTest, UnloadingDoesNotWaitForOneThatCannotBeWritten) {
  Create();
  Append(60);
  session_.reset();
  storage_.Hold();
  for (int i = 1; storage_.held() == 0; ++i) {
    fleet_->UnloadIdle(steady_clock::now() + i * minutes(11));
    std::this_thread::yield();
  }
  storage_.FailOne(Error(StatusCode::kResourceExhausted, "STORAGE_FULL", ""));
  UnloadAll();
  EXPECT_EQ(Stored(), "none");
  storage_.ReleaseAll();
  EXPECT_EQ(Read().durable_sequence, 60u);
}

TEST_F(SnapshotsTest, OneIsWrittenWhilePosesCome) {
  Create();
  Append(40);
  fleet_->WriteSnapshots();
  EXPECT_FALSE(session_->is_writing_snapshot());
  Append(40);
  fleet_->WriteSnapshots();
  Append(10);
  while (session_->is_writing_snapshot()) std::this_thread::yield();
  EXPECT_GE(StoredSequence(), 80u);
  Crash();
  ExpectAsReplayedWhole();
}

TEST_F(SnapshotsTest, WhatARevisionMovesIsNeverLoadedFromBefore) {
  Create();
  Append(60);
  session_.reset();
  Open();
  ASSERT_EQ(StoredSequence(), 60u);
  const auto shift = [](const VehicleView&) -> absl::StatusOr<RevisionPlan> {
    RevisionPlan plan;
    plan.batches = BatchesOf({{1, 60, 0, StraightBatch(1, 60)}});
    plan.revised_count = 60;
    return plan;
  };
  ASSERT_THAT(ReviseNow(session(), shift), IsOk());
  EXPECT_EQ(Stored(), "none");
  ExpectAsReplayedWhole();
  Crash();
  ExpectAsReplayedWhole();
  session_.reset();
  Open();
  EXPECT_EQ(StoredSequence(), 60u);
  ExpectAsReplayedWhole();
}

TEST_F(SnapshotsTest, OneOfOtherSettingsIsNotUsed) {
  Create();
  Append(60);
  session_.reset();
  Open();
  const auto wider = [](const VehicleView& view) {
    VehicleConfig config = view.config;
    config.drive.node_spacing_meters = 2.0;
    return absl::StatusOr<VehicleConfig>(config);
  };
  ASSERT_THAT(UpdateNow(session(), wider), IsOk());
  EXPECT_THAT(TakeWarnings(),
              ::testing::ElementsAre(HasSubstr("other settings")));
  ExpectAsReplayedWhole();
  Crash();
  ExpectAsReplayedWhole();
}

TEST_F(SnapshotsTest, PairsAreAddedToAGraphFromASnapshot) {
  Create();
  Append(100);
  session_.reset();
  Open();
  ASSERT_EQ(StoredSequence(), 100u);
  ASSERT_THAT(
      AddPairNow(session(), PairKind::kLoopClosure, {"plain", 90, 10, 1}),
      IsOk());
  // Its poses lie before the snapshot, and come from the store.
  ASSERT_THAT(AddPairNow(session(), PairKind::kLoopClosure,
                         {"measured", 95, 15, 2, "0.1 0.2 0.01 0.1"}),
              IsOk());
  ASSERT_THAT(
      AddPairNow(session(), PairKind::kRejectedCandidate, {"no", 96, 40, 3}),
      IsOk());
  const Snapshot before = Read();
  Crash();
  storage_.TakeLeastRead();
  const Snapshot after = Read();
  EXPECT_EQ(after.graph, before.graph);
  EXPECT_EQ(after.consistency.inflation, before.consistency.inflation);
  EXPECT_EQ(after.consistency.rejected, 1);
  ExpectAsReplayedWhole();
  // A pair that comes with an earlier time has the graph made anew.
  ASSERT_THAT(AddPairNow(session(), PairKind::kLoopClosure,
                         {"early", 80, 2, -2 * kMostClockError}),
              IsOk());
  ExpectAsReplayedWhole();
  EXPECT_THAT(TakeWarnings(), IsEmpty());
}

TEST_F(SnapshotsTest, DamageBeforeTheSnapshotIsFoundOnceSomebodyMeetsIt) {
  Create();
  Append(30);
  Append(30);
  Append(10);
  session_.reset();
  Open();
  memory_.DamagePose(kId, 35);
  Append(10);
  EXPECT_THAT(Read().damage, IsOk());
  session_->LoadAnew();
  EXPECT_FALSE(ReadNow(*session_).ok());
  const Snapshot read = Read();
  EXPECT_THAT(read.damage, IsError(StatusCode::kDataLoss, "STORE_CORRUPT", _));
  EXPECT_EQ(read.durable_sequence, 30u);
  EXPECT_EQ(Stored(), "none");
  ASSERT_THAT(AcceptDataLossNow(session(), 30), IsOk());
  ExpectAsReplayedWhole();
}

TEST_F(SnapshotsTest, DamageBehindTheSnapshotIsLookedForFromTheFirstPose) {
  Create();
  Append(30);
  Append(30);
  session_.reset();
  Open();
  Append(10);
  Append(10);
  session_.reset();
  Open();
  memory_.DamagePose(kId, 20);
  memory_.DamagePose(kId, 65);
  const Snapshot read = Read();
  EXPECT_THAT(read.damage, IsError(StatusCode::kDataLoss, "STORE_CORRUPT", _));
  EXPECT_EQ(read.durable_sequence, 0u);
}

TEST_F(SnapshotsTest, ServersWithoutSnapshotsRemoveThoseThatAreThere) {
  Create();
  Append(60);
  session_.reset();
  Open();
  ASSERT_EQ(StoredSequence(), 60u);
  Open(0);
  EXPECT_EQ(Read().durable_sequence, 60u);
  EXPECT_EQ(storage_.TakeLeastRead(), 1u);
  EXPECT_EQ(Stored(), "none");
  Append(60);
  fleet_->WriteSnapshots();
  session_.reset();
  Open(0);
  EXPECT_EQ(Stored(), "none");
}

// The vehicle is long enough to have whole parts.
class LongSnapshotsTest : public SnapshotsTest {
 protected:
  void SetUp() override {
    Open(5000);
    Create();
    for (int i = 0; i < 20; ++i) Append(1000);
    session_.reset();
  }

  // Until a part, or the snapshot, is handed to the storage, which holds it.
  void AwaitWrite() {
    while (storage_.held() == 0) {
      fleet_->WriteSnapshots();
      std::this_thread::yield();
    }
  }
};

TEST_F(LongSnapshotsTest, PartsOnceWrittenStay) {
  Open(5000);
  ASSERT_EQ(StoredSequence(), 20'000u);
  ASSERT_EQ((*memory_.GetSnapshot(key_))->part_count, 2u);
  storage_.TakeLeastRead();
  ExpectAsReplayedWhole();
  EXPECT_EQ(storage_.TakeLeastRead(), WatchedStorage::kNone);
  for (int i = 0; i < 6; ++i) Append(1000);
  storage_.Hold();
  AwaitWrite();
  // One part is new, then comes the snapshot.
  storage_.ReleaseOne();
  AwaitWrite();
  EXPECT_EQ(StoredSequence(), 20'000u);
  storage_.ReleaseOne();
  while (session_->is_writing_snapshot()) std::this_thread::yield();
  EXPECT_EQ(storage_.held(), 0u);
  EXPECT_EQ(StoredSequence(), 26'000u);
  EXPECT_EQ((*memory_.GetSnapshot(key_))->part_count, 3u);
  storage_.ReleaseAll();
  Crash();
  ExpectAsReplayedWhole();
  EXPECT_THAT(TakeWarnings(), IsEmpty());
}

TEST_F(LongSnapshotsTest, ACrashBetweenPartsLeavesTheSnapshotBefore) {
  storage_.Hold();
  AwaitWrite();
  storage_.ReleaseOne();
  AwaitWrite();
  storage_.FailOne(Error(StatusCode::kUnavailable, "STORE_UNAVAILABLE", ""));
  storage_.ReleaseAll();
  Crash();
  EXPECT_EQ(Stored(), "none");
  ExpectAsReplayedWhole();
  session_.reset();
  Open(5000);
  EXPECT_EQ(StoredSequence(), 20'000u);
  ExpectAsReplayedWhole();
}

TEST_F(LongSnapshotsTest, ARevisionWhileOneIsWrittenEndsIt) {
  session_ = fleet_->Session(kId);
  storage_.Hold();
  AwaitWrite();
  const Answer<absl::StatusOr<RevisionResult>> revised;
  session_->Revise(
      [](const VehicleView&) -> absl::StatusOr<RevisionPlan> {
        RevisionPlan plan;
        plan.batches = BatchesOf({{1, 1000, 0, StraightBatch(1, 1000)}});
        plan.revised_count = 1000;
        return plan;
      },
      revised.Setter());
  storage_.Await(2);
  storage_.ReleaseAll();
  ASSERT_THAT(revised.Get(), IsOk());
  while (session_->is_writing_snapshot()) std::this_thread::yield();
  Crash();
  ExpectAsReplayedWhole();
}

TEST_F(LongSnapshotsTest, DamagedOrForeignBytesAreNotUsed) {
  Open(5000);
  const SnapshotRecord sound = **memory_.GetSnapshot(key_);
  std::vector<std::string> parts;
  ASSERT_THAT(memory_.ReadSnapshotParts(key_, 0, 2,
                                        [&](absl::string_view part) {
                                          parts.emplace_back(part);
                                          return true;
                                        }),
              IsOk());
  const Snapshot expected = Read();
  std::mt19937_64 random = SeededRandom();
  for (int round = 0; round < 12; ++round) {
    SCOPED_TRACE(round);
    SnapshotRecord record = sound;
    std::vector<std::string> bytes = parts;
    const auto cut = [&](std::string* text) {
      text->resize(static_cast<std::size_t>(
          UniformInt(random, 0, static_cast<int>(text->size()) - 1)));
    };
    switch (round % 6) {
      case 0:
        cut(&record.payload);
        break;
      case 1:
        cut(&bytes[static_cast<std::size_t>(UniformInt(random, 0, 1))]);
        break;
      case 2:
        // The version of the bytes of another core.
        ++bytes[1][0];
        break;
      case 3:
        // Another vehicle's.
        ++record.payload[14];
        break;
      case 4:
        std::swap(bytes[0], bytes[1]);
        break;
      case 5:
        // Poses that are not there.
        record.last_sequence = 20'001;
        break;
    }
    BlockingWrites write(&memory_);
    ASSERT_THAT(write.PutSnapshotPart(key_, 0, bytes[0]), IsOk());
    ASSERT_THAT(write.PutSnapshotPart(key_, 1, bytes[1]), IsOk());
    ASSERT_THAT(write.PutSnapshot(key_, record), IsOk());
    session_.reset();
    last_snapshots_ = std::chrono::milliseconds(0);
    Open(5000);
    storage_.TakeLeastRead();
    EXPECT_EQ(Read().graph, expected.graph);
    EXPECT_EQ(storage_.TakeLeastRead(), 1u);
    EXPECT_THAT(TakeWarnings(),
                ::testing::ElementsAre(HasSubstr("without its snapshot")));
    EXPECT_EQ(Stored(), "none");
  }
}

TEST(SnapshotStressTest, VehiclesThatComeAndGoAreAsReplayedWhole) {
  std::mt19937_64 random = SeededRandom();
  const TemporaryDirectory directory;
  const PlainCodec codec;
  MemoryStorage model_storage;
  Executor model_executor(1);
  Fleet model(&model_storage, &codec, &model_executor, Fleet::Options());
  const auto create = [](Fleet* fleet) {
    const Answer<absl::StatusOr<Snapshot>> answer;
    fleet->Create("truck", TestConfig(), TakingCreated(answer));
    ASSERT_THAT(answer.Get(), IsOk());
  };
  create(&model);
  std::unique_ptr<Storage> storage;
  Executor executor(3);
  std::unique_ptr<Fleet> fleet;
  const auto open = [&] {
    fleet.reset();
    storage.reset();
    storage = *OpenSqliteStorage(directory.File("store.db"));
    Fleet::Options options;
    options.snapshots.poses = 300;
    fleet = std::make_unique<Fleet>(storage.get(), &codec, &executor, options);
  };
  open();
  create(fleet.get());
  std::uint64_t last = 0;
  for (int step = 0; step < 40; ++step) {
    SCOPED_TRACE(step);
    const auto both = [&](const auto& call) {
      call(*model.Session("truck"));
      call(*fleet->Session("truck"));
    };
    const auto count = static_cast<std::uint64_t>(UniformInt(random, 1, 700));
    both([&](VehicleSession& session) {
      ASSERT_THAT(AppendNow(session, SquareBatch(last + 1, count)), IsOk());
    });
    last += count;
    const auto pick = [&](std::uint64_t from, std::uint64_t to) {
      return static_cast<std::uint64_t>(
          UniformInt(random, static_cast<int>(from), static_cast<int>(to)));
    };
    if (last > 2 && UniformInt(random, 0, 2) == 0) {
      const std::uint64_t query = pick(2, last);
      const std::uint64_t matched = pick(1, query - 1);
      const bool measured = UniformInt(random, 0, 1) == 0;
      const PosePairRecord pair{"pair-" + std::to_string(step), query, matched,
                                step, measured ? "0.1 0.2 0.01 0.5" : ""};
      both([&](VehicleSession& session) {
        AddPairNow(session, PairKind::kLoopClosure, pair).IgnoreError();
      });
    }
    if (UniformInt(random, 0, 9) == 0) {
      const double sequence_meters = UniformInt(random, 0, 1) == 0 ? 10 : 15;
      both([&](VehicleSession& session) {
        ASSERT_THAT(UpdateNow(session,
                              [&](const VehicleView& view) {
                                VehicleConfig config = view.config;
                                config.drive.search.sequence_length_meters =
                                    sequence_meters;
                                return absl::StatusOr<VehicleConfig>(config);
                              }),
                    IsOk());
      });
    }
    switch (UniformInt(random, 0, 5)) {
      case 0:
        open();
        break;
      case 1:
      case 2:
        fleet->WriteSnapshots();
        break;
      case 3:
        fleet->UnloadIdle(steady_clock::now() + minutes(11));
        break;
      default:
        break;
    }
    if (step % 8 != 7) continue;
    const Snapshot expected = *ReadNow(*model.Session("truck"));
    const Snapshot found = *ReadNow(*fleet->Session("truck"));
    ASSERT_EQ(found.graph, expected.graph);
    ASSERT_EQ(found.revision, expected.revision);
    ASSERT_EQ(found.consistency.inflation, expected.consistency.inflation);
    ASSERT_EQ(found.loop_closure_count, expected.loop_closure_count);
    const auto search = [](VehicleSession& session) {
      const Answer<std::string> answer;
      session.Search("calls", [&](const absl::StatusOr<VehicleView>& view) {
        const auto set =
            view->search->AtEnd(view->config.drive.search, nullptr);
        std::string text;
        for (const core::Candidate& candidate : set->candidates) {
          text += std::to_string(candidate.matched) + " " +
                  std::to_string(candidate.score) + "\n";
        }
        answer.Set(text);
        return true;
      });
      return answer.Get();
    };
    ASSERT_EQ(search(*fleet->Session("truck")),
              search(*model.Session("truck")));
  }
}

}  // namespace
}  // namespace revisit::server
