// Several servers, each with a fleet, over one storage: who answers for a
// vehicle, and what becomes of what the others hold.
#include <chrono>
#include <memory>
#include <random>
#include <string>
#include <thread>
#include <vector>

#include "gmock/gmock.h"
#include "gtest/gtest.h"
#include "server/base/status.h"
#include "server/sessions/fleet.h"
#include "tests/random.h"
#include "tests/server/error_matchers.h"
#include "tests/server/held_storage.h"
#include "tests/server/memory_storage.h"
#include "tests/server/owned_storage.h"
#include "tests/server/plain_codec.h"
#include "tests/server/sessions/session_testing.h"

namespace revisit::server {
namespace {

using absl::StatusCode;
using ::testing::_;
using ::testing::AnyOf;

const auto kFenced = IsError(StatusCode::kAborted, "EPOCH_FENCED", _);
const auto kNotOwner = IsError(StatusCode::kUnavailable, "NOT_OWNER", _);
const auto kStale = IsError(StatusCode::kUnavailable, "LEASE_STALE", _);

class Server {
 public:
  Server(Storage* storage, Owners* owners, const std::string& name)
      : owned(storage, owners, name) {}
  ~Server() { held.ReleaseAll(); }

  absl::StatusOr<Snapshot> Create(const std::string& id) {
    const Answer<absl::StatusOr<Snapshot>> answer;
    fleet.Create(id, TestConfig(), TakingCreated(answer));
    return answer.Get();
  }
  absl::StatusOr<Snapshot> Read(const std::string& id) {
    return ReadNow(*fleet.Session(id));
  }
  absl::StatusOr<Acknowledgement> Append(const std::string& id,
                                         std::uint64_t first,
                                         std::uint64_t count) {
    return AppendNow(*fleet.Session(id), StraightBatch(first, count));
  }

  OwnedStorage owned;
  HeldStorage held{&owned};
  PlainCodec codec;
  Executor executor{2};
  Fleet fleet{&held, &codec, &executor, Fleet::Options()};
};

class OwnershipTest : public ::testing::Test {
 protected:
  VehicleKey KeyOf(const std::string& id) {
    return memory_.GetVehicle(id)->key;
  }
  // Declares the owner dead: the other server has the vehicle from now on.
  void Seize(const std::string& id, const std::string& server) {
    owners_.Seize(KeyOf(id), server);
  }

  MemoryStorage memory_;
  Owners owners_;
  Server a_{&memory_, &owners_, "a"};
  Server b_{&memory_, &owners_, "b"};
};

TEST_F(OwnershipTest, VehicleOfAnotherServerIsRefusedWithTheOwnersAddress) {
  ASSERT_THAT(a_.Create("truck"), IsOk());
  const auto refused = b_.Read("truck");
  EXPECT_THAT(refused, kNotOwner);
  EXPECT_EQ(MetadataOf(refused.status(), "owner"), "a");
  EXPECT_THAT(b_.Append("truck", 1, 2), kNotOwner);
  EXPECT_EQ(b_.fleet.loaded(), 0u);
  EXPECT_THAT(a_.Append("truck", 1, 2), IsOk());
}

TEST_F(OwnershipTest, ServerThatLostAVehicleNeitherReadsNorWritesIt) {
  ASSERT_THAT(a_.Create("truck"), IsOk());
  ASSERT_THAT(a_.Append("truck", 1, 2), IsOk());
  Seize("truck", "b");
  ASSERT_THAT(b_.Append("truck", 3, 2), IsOk());
  EXPECT_THAT(a_.Read("truck"), kNotOwner);
  EXPECT_THAT(a_.Append("truck", 5, 1), kNotOwner);
  EXPECT_EQ(b_.Read("truck")->durable_sequence, 4u);
}

TEST_F(OwnershipTest, WriteUnderWayWhenTheVehicleIsTakenIsFencedAndUndone) {
  ASSERT_THAT(a_.Create("truck"), IsOk());
  ASSERT_THAT(a_.Append("truck", 1, 2), IsOk());
  a_.held.Hold();
  const std::shared_ptr<VehicleSession> session = a_.fleet.Session("truck");
  const Appended append = Append(*session, StraightBatch(3, 2));
  const Appended behind = Append(*session, StraightBatch(5, 2));
  a_.held.Await(2);
  Seize("truck", "b");
  ASSERT_THAT(b_.Append("truck", 3, 1), IsOk());
  a_.held.ReleaseAll();
  EXPECT_THAT(append.durable.Get(), kFenced);
  EXPECT_THAT(behind.durable.Get(), kFenced);
  EXPECT_TRUE(session->gone());
  EXPECT_EQ(b_.Read("truck")->durable_sequence, 3u);
}

// It answered DATA_LOSS, although nothing but its memory was behind.
TEST_F(OwnershipTest, AcknowledgementOfAnotherServerIsNotTakenForALoss) {
  ASSERT_THAT(a_.Create("truck"), IsOk());
  ASSERT_THAT(a_.Append("truck", 1, 2), IsOk());
  a_.held.Hold();
  const std::shared_ptr<VehicleSession> session = a_.fleet.Session("truck");
  const Answer<absl::StatusOr<Snapshot>> answer;
  session->CheckAcknowledged(4, TestConfig().uid, Taking(answer));
  a_.held.Await(1);
  Seize("truck", "b");
  ASSERT_THAT(b_.Append("truck", 3, 2), IsOk());
  a_.held.ReleaseAll();
  EXPECT_THAT(answer.Get(), kFenced);
  EXPECT_THAT(b_.Append("truck", 5, 1), IsOk());
}

// A vehicle that another server wrote to is loaded anew when it comes back.
TEST_F(OwnershipTest, VehicleThatComesBackShowsWhatOthersWroteMeanwhile) {
  ASSERT_THAT(a_.Create("truck"), IsOk());
  ASSERT_THAT(a_.Append("truck", 1, 2), IsOk());
  Seize("truck", "b");
  ASSERT_THAT(b_.Append("truck", 3, 3), IsOk());
  Seize("truck", "a");
  const std::shared_ptr<VehicleSession> before = a_.fleet.Session("truck");
  EXPECT_THAT(ReadNow(*before), IsError(StatusCode::kUnavailable, _, _));
  EXPECT_TRUE(before->gone());
  EXPECT_EQ(a_.Read("truck")->durable_sequence, 5u);
}

// Otherwise every vehicle would be read again after a database was away.
TEST_F(OwnershipTest, VehicleThatNobodyElseWroteToStaysInMemory) {
  ASSERT_THAT(a_.Create("truck"), IsOk());
  ASSERT_THAT(a_.Append("truck", 1, 2), IsOk());
  const std::shared_ptr<VehicleSession> session = a_.fleet.Session("truck");
  a_.owned.ForgetEpochs();
  EXPECT_EQ(ReadNow(*session)->durable_sequence, 2u);
  a_.owned.ForgetEpochs();
  EXPECT_EQ(AppendNow(*session, StraightBatch(3, 2))->durable_sequence, 4u);
  EXPECT_FALSE(session->gone());
  EXPECT_EQ(a_.fleet.Session("truck"), session);
}

TEST_F(OwnershipTest, NothingIsReadFromMemoryWhileTheLeaseIsStale) {
  ASSERT_THAT(a_.Create("truck"), IsOk());
  ASSERT_THAT(a_.Append("truck", 1, 2), IsOk());
  a_.owned.SetLease(Error(StatusCode::kUnavailable, "LEASE_STALE", "stale"));
  EXPECT_THAT(a_.Read("truck"), kStale);
  EXPECT_THAT(a_.Append("truck", 3, 1), kStale);
  a_.owned.SetLease(absl::OkStatus());
  EXPECT_EQ(a_.Read("truck")->durable_sequence, 2u);
}

// The write had happened, though nobody said so.
TEST_F(OwnershipTest, WriteWhoseAnswerWasLostIsSettledByTakingTheVehicle) {
  ASSERT_THAT(a_.Create("truck"), IsOk());
  a_.held.Hold();
  const Appended append =
      Append(*a_.fleet.Session("truck"), StraightBatch(1, 2));
  a_.held.Await(1);
  a_.held.PassOnAndFailOne(
      Error(StatusCode::kUnavailable, "STORE_UNAVAILABLE", "no answer"));
  a_.owned.ForgetEpochs();
  a_.held.ReleaseAll();
  EXPECT_THAT(append.durable.Get(),
              IsError(StatusCode::kUnavailable, "STORE_UNAVAILABLE", _));
  EXPECT_THAT(a_.Read("truck"), IsError(StatusCode::kUnavailable, _, _));
  EXPECT_EQ(a_.Read("truck")->durable_sequence, 2u);
}

// The server listed what a failover had lost, and acknowledged it again.
TEST_F(OwnershipTest, WhatIsInMemoryIsNotAcknowledgedAgainWithoutTheStore) {
  ASSERT_THAT(a_.Create("truck"), IsOk());
  ASSERT_THAT(a_.Append("truck", 1, 2), IsOk());
  const std::shared_ptr<VehicleSession> session = a_.fleet.Session("truck");
  const PosePairRecord pair{"c", 2, 1, 7};
  ASSERT_THAT(AddPairNow(*session, PairKind::kLoopClosure, pair), IsOk());
  a_.held.Hold();
  const Answer<absl::StatusOr<AddedPair>> added;
  session->AddPosePair(PairKind::kLoopClosure, pair, {}, added.Setter());
  a_.held.Await(1);
  a_.held.ReleaseAll();
  EXPECT_THAT(added.Get(), IsOk());
  a_.held.Hold();
  const Answer<absl::StatusOr<AddedPair>> again;
  session->AddPosePair(PairKind::kLoopClosure, pair, {}, again.Setter());
  const Answer<absl::StatusOr<std::uint64_t>> deleted;
  session->DeletePosePair(PairKind::kLoopClosure, "d", {}, deleted.Setter());
  a_.held.Await(1);
  Seize("truck", "b");
  a_.held.ReleaseAll();
  EXPECT_THAT(again.Get(), kFenced);
  EXPECT_THAT(deleted.Get(), kFenced);
}

TEST_F(OwnershipTest, WantedVehicleIsHandedOverOnceItsCallsAreFinished) {
  ASSERT_THAT(a_.Create("truck"), IsOk());
  a_.held.Hold();
  const Appended append =
      Append(*a_.fleet.Session("truck"), StraightBatch(1, 2));
  a_.held.Await(1);
  EXPECT_THAT(b_.Read("truck"), kNotOwner);
  a_.owned.TellWanted();
  EXPECT_THAT(b_.Read("truck"), kNotOwner);
  a_.held.ReleaseAll();
  EXPECT_THAT(append.durable.Get(), IsOk());
  absl::StatusOr<Snapshot> read = b_.Read("truck");
  while (!read.ok()) {
    ASSERT_THAT(read, kNotOwner);
    read = b_.Read("truck");
  }
  EXPECT_EQ(read->durable_sequence, 2u);
  EXPECT_THAT(a_.Read("truck"), kNotOwner);
}

TEST_F(OwnershipTest, WantedVehicleThatIsNotInMemoryIsHandedOverAtOnce) {
  ASSERT_THAT(a_.Create("truck"), IsOk());
  // One that is busy counts as used then.
  auto now = std::chrono::steady_clock::now();
  while (a_.fleet.loaded() != 0) {
    now += std::chrono::hours(1);
    a_.fleet.UnloadIdle(now);
    std::this_thread::yield();
  }
  EXPECT_THAT(b_.Read("truck"), kNotOwner);
  a_.owned.TellWanted();
  EXPECT_THAT(b_.Read("truck"), IsOk());
}

TEST_F(OwnershipTest, CallsOnAVehicleThatWasHandedOverAreFencedAndTryAgain) {
  ASSERT_THAT(a_.Create("truck"), IsOk());
  const std::shared_ptr<VehicleSession> session = a_.fleet.Session("truck");
  EXPECT_THAT(b_.Read("truck"), kNotOwner);
  a_.owned.TellWanted();
  EXPECT_THAT(ReadNow(*session), AnyOf(IsOk(), kFenced));
  EXPECT_THAT(AppendNow(*session, StraightBatch(1, 1)), kFenced);
  EXPECT_THAT(DeletePairNow(*session, PairKind::kLoopClosure, "x"), kFenced);
}

// Two servers take turns at random: what was acknowledged is never lost, never
// doubled, and every read shows all that was acknowledged before it.
TEST_F(OwnershipTest, AcknowledgedPosesSurviveAnyOrderOfTakeovers) {
  std::mt19937_64 random = SeededRandom();
  ASSERT_THAT(a_.Create("truck"), IsOk());
  Server* const servers[] = {&a_, &b_};
  const char* const names[] = {"a", "b"};
  std::uint64_t acknowledged = 0;
  int reads = 0;
  int appends = 0;
  for (int step = 0; step < 600; ++step) {
    const std::size_t which = random() % 2;
    Server& server = *servers[which];
    switch (random() % 5) {
      case 0:
        Seize("truck", names[which]);
        break;
      case 1:
        server.owned.ForgetEpochs();
        break;
      case 2:
        server.owned.TellWanted();
        break;
      case 3: {
        const auto read = server.Read("truck");
        if (read.ok()) {
          EXPECT_EQ(read->durable_sequence, acknowledged) << "step " << step;
          ++reads;
        }
        break;
      }
      default: {
        const auto append = server.Append("truck", acknowledged + 1, 1);
        if (append.ok()) {
          EXPECT_EQ(append->durable_sequence, acknowledged + 1);
          acknowledged = append->durable_sequence;
          ++appends;
        }
      }
    }
  }
  EXPECT_EQ(memory_.GetVehicle("truck")->durable_sequence, acknowledged);
  EXPECT_GT(reads, 20);
  EXPECT_GT(appends, 20);
}

}  // namespace
}  // namespace revisit::server
