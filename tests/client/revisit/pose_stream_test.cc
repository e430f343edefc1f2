#include "client/revisit/pose_stream.h"

#include <atomic>
#include <cmath>
#include <condition_variable>
#include <mutex>
#include <random>
#include <string>
#include <thread>
#include <vector>

#include "client/revisit/channel.h"
#include "client/revisit/status.h"
#include "gmock/gmock.h"
#include "grpcpp/channel.h"
#include "gtest/gtest.h"
#include "tests/client/fake_server.h"

namespace revisit::client {
namespace {

using std::chrono::milliseconds;
using ::testing::Each;
using ::testing::ElementsAre;
using ::testing::HasSubstr;
using Kind = StreamFault::Kind;

v1::Pose MakePose(std::uint64_t sequence) {
  v1::Pose pose;
  pose.set_sequence(sequence);
  pose.mutable_local()->set_x_meters(0.5 * static_cast<double>(sequence));
  pose.mutable_local()->set_y_meters(std::sin(static_cast<double>(sequence)));
  pose.set_heading_radians(0.1);
  pose.mutable_covariance()->set_form(v1::COVARIANCE_FORM_PLANAR_6);
  for (const double value : {1.0, 0.0, 0.0, 1.0, 0.0, 0.01}) {
    pose.mutable_covariance()->add_values(value);
  }
  return pose;
}

v1::PoseBatch MakeBatch(std::uint64_t first, std::uint64_t count) {
  v1::PoseBatch batch;
  for (std::uint64_t i = 0; i < count; ++i) {
    *batch.add_poses() = MakePose(first + i);
  }
  return batch;
}

std::vector<std::string> Serialized(std::uint64_t count) {
  std::vector<std::string> poses;
  for (std::uint64_t i = 1; i <= count; ++i) {
    poses.push_back(MakePose(i).SerializeAsString());
  }
  return poses;
}

PoseStreamOptions Options() {
  PoseStreamOptions options;
  options.backoff.initial = milliseconds(1);
  options.backoff.max = milliseconds(20);
  options.give_up_after = milliseconds(30'000);
  return options;
}

grpc::Status Unavailable() {
  return MakeStatus(grpc::StatusCode::UNAVAILABLE, "cut");
}

// The fault at the given step, counted from 0, and none at others.
std::function<StreamFault()> FaultAt(int step, StreamFault fault) {
  return [step, fault, count = std::make_shared<int>(0)] {
    return (*count)++ == step ? fault : StreamFault();
  };
}

class PoseStreamTest : public ::testing::Test {
 protected:
  std::unique_ptr<PoseStream> Open(const PoseStreamOptions& options = Options(),
                                   const PoseStreamCallbacks& callbacks = {}) {
    return std::make_unique<PoseStream>(MakeInsecureChannel(server_.address()),
                                        "vehicles/shuttle", options, callbacks);
  }

  FakeServer server_;
};

TEST_F(PoseStreamTest, DeliversEveryPoseOnceAndInOrder) {
  const auto stream = Open();
  ASSERT_TRUE(stream->Append(MakeBatch(1, 1000)).ok());
  EXPECT_TRUE(stream->Finish().ok());
  EXPECT_TRUE(server_.Stored() == Serialized(1000));
  EXPECT_EQ(stream->acked_sequence(), 1000u);
  EXPECT_EQ(stream->pending_poses(), 0u);
  EXPECT_EQ(stream->pending_bytes(), 0u);
  EXPECT_EQ(stream->reconnects(), 0);
}

TEST_F(PoseStreamTest, TellsWhereToGoOnAndGoesOnThere) {
  {
    const auto stream = Open();
    ASSERT_TRUE(stream->Append(MakeBatch(1, 100)).ok());
    ASSERT_TRUE(stream->Finish().ok());
  }
  const auto stream = Open();
  const auto durable = stream->WaitUntilOpened();
  ASSERT_TRUE(durable.ok());
  EXPECT_EQ(*durable, 100u);
  ASSERT_TRUE(stream->Append(MakeBatch(101, 50)).ok());
  EXPECT_TRUE(stream->Finish().ok());
  EXPECT_TRUE(server_.Stored() == Serialized(150));
}

TEST_F(PoseStreamTest, GoesToTheOwnerOfItsVehicleWithEveryPose) {
  server_.FailOpens(
      FaultAt(0, {Kind::kBefore,
                  MakeStatus(grpc::StatusCode::UNAVAILABLE, "elsewhere",
                             {"NOT_OWNER", {{"owner", "10.0.0.2:50051"}}})}));
  server_.FailBatches(FaultAt(
      1, {Kind::kBefore,
          MakeStatus(grpc::StatusCode::ABORTED, "moved", {"EPOCH_FENCED"})}));
  const auto stream = Open();
  ASSERT_TRUE(stream->Append(MakeBatch(1, 1000)).ok());
  EXPECT_TRUE(stream->Finish().ok());
  EXPECT_TRUE(server_.Stored() == Serialized(1000));
  EXPECT_THAT(server_.Routes(),
              ::testing::ElementsAre("", "MTAuMC4wLjI6NTAwNTE=", ""));
}

TEST_F(PoseStreamTest, OpensOnceTheHistoriesOfItsGroupWereRead) {
  int opens = 0;
  server_.FailOpens([&opens] {
    if (++opens > 9) return StreamFault();
    return StreamFault{Kind::kBefore, MakeStatus(grpc::StatusCode::UNAVAILABLE,
                                                 "reads", {"GROUP_NOT_READY"})};
  });
  PoseStreamOptions options = Options();
  options.send_candidates = true;
  options.candidate_options.mutable_scope()->set_group("groups/depot");
  const auto stream = Open(options);
  ASSERT_TRUE(stream->Append(MakeBatch(1, 100)).ok());
  EXPECT_TRUE(stream->Finish().ok());
  EXPECT_EQ(stream->reconnects(), 9);
  EXPECT_TRUE(server_.Stored() == Serialized(100));
}

TEST_F(PoseStreamTest, SendsNoLargerBatchesThanItMay) {
  server_.set_max_batch_poses(7);
  const auto stream = Open();
  ASSERT_TRUE(stream->Append(MakeBatch(1, 100)).ok());
  EXPECT_TRUE(stream->Finish().ok());
  EXPECT_EQ(server_.durable_sequence(), 100u);
  EXPECT_LE(server_.largest_batch(), 7);
}

TEST_F(PoseStreamTest, SendsColumnsToServersThatTakeThemAndMessagesToOthers) {
  for (const bool takes : {true, false}) {
    FakeServer server;
    server.TakeColumns(takes);
    PoseStream stream(MakeInsecureChannel(server.address()), "vehicles/shuttle",
                      Options(), {});
    ASSERT_TRUE(stream.Append(MakeBatch(1, 100)).ok());
    EXPECT_TRUE(stream.Finish().ok());
    EXPECT_EQ(server.column_batches() > 0, takes);
    EXPECT_TRUE(server.Stored() == Serialized(100));
  }
}

TEST_F(PoseStreamTest, WhatColumnsCannotSayIsSentAllTheSame) {
  v1::PoseBatch batch = MakeBatch(1, 100);
  batch.mutable_poses(9)->mutable_recording_start()->set_label("again");
  batch.mutable_poses(80)->mutable_stamp()->set_seconds(5);
  std::vector<std::string> wanted;
  for (const v1::Pose& pose : batch.poses()) {
    wanted.push_back(pose.SerializeAsString());
  }
  const auto stream = Open();
  ASSERT_TRUE(stream->Append(batch).ok());
  EXPECT_TRUE(stream->Finish().ok());
  EXPECT_TRUE(server_.Stored() == wanted);
  EXPECT_GT(server_.column_batches(), 0);
}

class PoseStreamFaultTest : public ::testing::TestWithParam<unsigned> {};

TEST_P(PoseStreamFaultTest, DeliversEveryPoseOnceAndInOrderWhateverIsCut) {
  const unsigned seed = GetParam();
  SCOPED_TRACE("seed " + std::to_string(seed));
  FakeServer server;
  // Asked under the server's lock.
  auto random = std::make_shared<std::mt19937>(seed);
  const auto draw = [random](int outcomes) {
    return std::uniform_int_distribution<int>(0, outcomes - 1)(*random);
  };
  const auto status = [draw] {
    switch (draw(4)) {
      case 0:
        return MakeStatus(grpc::StatusCode::ABORTED, "moved");
      case 1:
        return MakeStatus(grpc::StatusCode::RESOURCE_EXHAUSTED, "busy",
                          {"QUEUE_FULL", {}, {}, milliseconds(1)});
      case 2:
        return grpc::Status();  // An end that nobody asked for.
      default:
        return Unavailable();
    }
  };
  server.FailOpens([draw, status] {
    StreamFault fault;
    if (draw(4) == 0) fault = {Kind::kBefore, status()};
    return fault;
  });
  server.FailBatches([draw, status] {
    StreamFault fault;
    switch (draw(15)) {
      case 0:
        fault = {Kind::kBefore, status()};
        break;
      case 1:
        fault = {Kind::kLoseAck, status()};
        break;
      case 2:
        fault = {Kind::kAfterAck, status()};
        break;
    }
    return fault;
  });

  constexpr std::uint64_t kPoses = 3000;
  PoseStreamOptions options = Options();
  options.batch_poses = 1 + static_cast<int>(seed % 64);
  options.max_pending_poses = 200;
  std::uint64_t last_ack = 0;
  bool acks_grow = true;
  PoseStreamCallbacks callbacks;
  callbacks.ack = [&](const v1::Ack& ack) {
    acks_grow = acks_grow && ack.durable_sequence() >= last_ack;
    last_ack = ack.durable_sequence();
  };
  PoseStream stream(MakeInsecureChannel(server.address()), "vehicles/shuttle",
                    options, callbacks);
  std::mt19937 sizes(seed);
  for (std::uint64_t next = 1; next <= kPoses;) {
    const std::uint64_t count = std::min<std::uint64_t>(
        std::uniform_int_distribution<std::uint64_t>(1, 300)(sizes),
        kPoses - next + 1);
    ASSERT_TRUE(stream.Append(MakeBatch(next, count)).ok());
    EXPECT_LE(stream.pending_poses(), options.max_pending_poses);
    next += count;
  }
  const absl::Status finished = stream.Finish();
  EXPECT_TRUE(finished.ok()) << finished;
  EXPECT_TRUE(server.Stored() == Serialized(kPoses));
  EXPECT_EQ(stream.acked_sequence(), kPoses);
  EXPECT_TRUE(acks_grow);
  EXPECT_GT(stream.reconnects(), 0);
  EXPECT_THAT(server.FirstSteps(), Each(1));
}

INSTANTIATE_TEST_SUITE_P(Seeds, PoseStreamFaultTest, ::testing::Range(1u, 21u));

TEST_F(PoseStreamTest, SurvivesARestartOfTheServer) {
  std::mutex mutex;
  std::condition_variable changed;
  std::uint64_t acked = 0;
  PoseStreamCallbacks callbacks;
  callbacks.ack = [&](const v1::Ack& ack) {
    std::lock_guard<std::mutex> lock(mutex);
    acked = ack.durable_sequence();
    changed.notify_all();
  };
  const auto stream = Open(Options(), callbacks);
  ASSERT_TRUE(stream->Append(MakeBatch(1, 500)).ok());
  {
    std::unique_lock<std::mutex> lock(mutex);
    changed.wait(lock, [&] { return acked >= 100; });
  }
  server_.Stop();
  ASSERT_TRUE(stream->Append(MakeBatch(501, 500)).ok());
  server_.Start();
  const absl::Status finished = stream->Finish();
  EXPECT_TRUE(finished.ok()) << finished;
  EXPECT_TRUE(server_.Stored() == Serialized(1000));
}

TEST_F(PoseStreamTest, RemembersWhatWasAcknowledgedOverConnections) {
  server_.FailBatches(FaultAt(2, {Kind::kBefore, Unavailable()}));
  PoseStreamOptions options = Options();
  options.batch_poses = 10;
  const auto stream = Open(options);
  ASSERT_TRUE(stream->Append(MakeBatch(1, 40)).ok());
  ASSERT_TRUE(stream->Finish().ok());
  EXPECT_THAT(server_.Opens(), ElementsAre(0u, 20u));
}

TEST_F(PoseStreamTest, TellsTheServerWhatAnEarlierLifeHadAcknowledged) {
  PoseStreamOptions options = Options();
  options.acked_sequence = 5;
  const absl::Status finished = Open(options)->Finish();
  EXPECT_EQ(finished.code(), absl::StatusCode::kDataLoss);
  EXPECT_EQ(DetailsOf(finished).reason, "DURABLE_SEQUENCE_REGRESSED");
  EXPECT_THAT(server_.Opens(), ElementsAre(5u));
}

TEST_F(PoseStreamTest, SeesDataLossEvenIfTheServerDoesNot) {
  server_.CheckAckedSequence(false);
  PoseStreamOptions options = Options();
  options.acked_sequence = 5;
  const absl::Status finished = Open(options)->Finish();
  EXPECT_EQ(finished.code(), absl::StatusCode::kDataLoss);
  EXPECT_THAT(
      std::string(finished.message()),
      HasSubstr("has poses up to sequence 0, but acknowledged up to 5"));
}

// A vehicle that was deleted, made again and filled by somebody else has the
// sequences that this client waits for: it took its own poses for durable, and
// claimed what it had acknowledged of the old one.
TEST_F(PoseStreamTest, TakesNoOtherVehicleOfTheSameNameForItsOwn) {
  for (const bool server_checks : {true, false}) {
    FakeServer server;
    server.CheckUid(server_checks);
    std::atomic<bool> away{false};
    server.FailOpens([&away] {
      return away ? StreamFault{Kind::kBefore, Unavailable()} : StreamFault();
    });
    server.FailBatches(FaultAt(0, {Kind::kBefore, Unavailable()}));
    const auto stream = std::make_unique<PoseStream>(
        MakeInsecureChannel(server.address()), "vehicles/shuttle", Options(),
        PoseStreamCallbacks());
    ASSERT_TRUE(stream->WaitUntilOpened().ok());
    EXPECT_EQ(stream->vehicle_uid(), "first");
    away = true;
    ASSERT_TRUE(stream->Append(MakeBatch(1, 40)).ok());
    while (server.Opens().size() < 2) {
      std::this_thread::sleep_for(milliseconds(1));
    }
    server.Replace("second", MakeBatch(1, 60));
    away = false;
    const absl::Status finished = stream->Finish();
    EXPECT_EQ(finished.code(), absl::StatusCode::kFailedPrecondition);
    if (server_checks) {
      EXPECT_EQ(DetailsOf(finished).reason, "VEHICLE_REPLACED");
    } else {
      EXPECT_THAT(std::string(finished.message()),
                  HasSubstr("vehicles/shuttle has the uid second, but the "
                            "stream began with first"));
    }
    EXPECT_EQ(stream->pending_poses(), 40u);
    EXPECT_EQ(stream->acked_sequence(), 0u);
    EXPECT_EQ(stream->vehicle_uid(), "first");
  }
}

TEST_F(PoseStreamTest, SaysWhichVehicleItMeansFromAnEarlierLife) {
  PoseStreamOptions options = Options();
  options.vehicle_uid = "first";
  ASSERT_TRUE(Open(options)->Finish().ok());
  options.vehicle_uid = "another";
  options.acked_sequence = 5;
  EXPECT_EQ(DetailsOf(Open(options)->Finish()).reason, "VEHICLE_REPLACED");
  EXPECT_THAT(server_.OpenUids(), ElementsAre("first", "another"));
}

TEST_F(PoseStreamTest, HoldsNoMorePosesThanAllowed) {
  server_.HoldStreams(true);
  PoseStreamOptions options = Options();
  options.max_pending_poses = 100;
  const auto stream = Open(options);
  ASSERT_TRUE(stream->TryAppend(MakeBatch(1, 60)).ok());
  const absl::Status full = stream->TryAppend(MakeBatch(61, 60));
  EXPECT_EQ(full.code(), absl::StatusCode::kResourceExhausted);
  EXPECT_EQ(full.message(),
            "60 poses wait for their acknowledgement; there is no room for 60 "
            "more");
  EXPECT_EQ(stream->pending_poses(), 60u);
  std::atomic<bool> appended{false};
  std::thread appender([&] {
    EXPECT_TRUE(stream->Append(MakeBatch(61, 200)).ok());
    appended = true;
  });
  while (stream->pending_poses() < 100) std::this_thread::yield();
  EXPECT_FALSE(appended);
  EXPECT_EQ(stream->pending_poses(), 100u);
  server_.HoldStreams(false);
  appender.join();
  EXPECT_TRUE(stream->Finish().ok());
  EXPECT_TRUE(server_.Stored() == Serialized(260));
}

TEST_F(PoseStreamTest, HoldsNoMoreBytesThanAllowed) {
  server_.HoldStreams(true);
  PoseStreamOptions options = Options();
  options.max_pending_bytes = 10 * MakePose(1).SpaceUsedLong();
  const auto stream = Open(options);
  EXPECT_TRUE(stream->TryAppend(MakeBatch(1, 10)).ok());
  EXPECT_EQ(stream->TryAppend(MakeBatch(11, 1)).code(),
            absl::StatusCode::kResourceExhausted);
  EXPECT_LE(stream->pending_bytes(), options.max_pending_bytes);
  server_.HoldStreams(false);
  EXPECT_TRUE(stream->Finish().ok());
  EXPECT_EQ(server_.durable_sequence(), 10u);
}

TEST_F(PoseStreamTest, RefusesSequencesThatDoNotFollow) {
  const auto stream = Open();
  ASSERT_TRUE(stream->Append(MakeBatch(1, 3)).ok());
  const absl::Status gap = stream->Append(MakeBatch(5, 1));
  EXPECT_EQ(gap.code(), absl::StatusCode::kInvalidArgument);
  EXPECT_EQ(gap.message(), "sequence 5 where 4 comes next");
  EXPECT_EQ(stream->Append(MakeBatch(3, 1)).code(),
            absl::StatusCode::kInvalidArgument);
  EXPECT_EQ(Open()->Append(MakeBatch(0, 1)).code(),
            absl::StatusCode::kInvalidArgument);
  EXPECT_TRUE(stream->Append(MakeBatch(4, 1)).ok());
  EXPECT_TRUE(stream->Finish().ok());
  const absl::Status late = stream->Append(MakeBatch(5, 1));
  EXPECT_EQ(late.code(), absl::StatusCode::kFailedPrecondition);
  EXPECT_EQ(late.message(), "the stream is finished");
}

TEST_F(PoseStreamTest, SendsStoredPosesForComparisonWhenTheyAreAppendedAgain) {
  ASSERT_TRUE([&] {
    const auto stream = Open();
    return stream->Append(MakeBatch(1, 100)).ok() && stream->Finish().ok();
  }());
  {
    const auto same = Open();
    ASSERT_TRUE(same->Append(MakeBatch(1, 120)).ok());
    EXPECT_TRUE(same->Finish().ok());
  }
  v1::PoseBatch other = MakeBatch(1, 120);
  other.mutable_poses(49)->set_heading_radians(0.2);
  const auto stream = Open();
  ASSERT_TRUE(stream->Append(other).ok());
  const absl::Status finished = stream->Finish();
  EXPECT_EQ(finished.code(), absl::StatusCode::kAlreadyExists);
  EXPECT_EQ(DetailsOf(finished).reason, "SEQUENCE_CONTENT_MISMATCH");
}

class PoseStreamFinalStatusTest
    : public ::testing::TestWithParam<grpc::StatusCode> {};

TEST_P(PoseStreamFinalStatusTest, EndsTheStreamAtOnce) {
  FakeServer server;
  server.FailBatches(FaultAt(
      1, {Kind::kBefore, MakeStatus(GetParam(), "no", {"SOME_REASON"})}));
  PoseStreamOptions options = Options();
  options.batch_poses = 10;
  options.max_pending_poses = 30;
  PoseStream stream(MakeInsecureChannel(server.address()), "vehicles/shuttle",
                    options, {});
  // Blocks on the full queue until the stream has ended, then says why.
  const auto code = static_cast<absl::StatusCode>(GetParam());
  EXPECT_EQ(stream.Append(MakeBatch(1, 1000)).code(), code);
  const absl::Status finished = stream.Finish();
  EXPECT_EQ(finished.code(), code);
  EXPECT_EQ(finished.message(), "no");
  EXPECT_EQ(DetailsOf(finished).reason, "SOME_REASON");
  EXPECT_EQ(stream.TryAppend(MakeBatch(1001, 1)).code(), code);
  EXPECT_EQ(stream.reconnects(), 0);
  EXPECT_EQ(stream.acked_sequence(), 10u);
}

INSTANTIATE_TEST_SUITE_P(
    Codes, PoseStreamFinalStatusTest,
    ::testing::Values(
        grpc::StatusCode::DATA_LOSS, grpc::StatusCode::INVALID_ARGUMENT,
        grpc::StatusCode::ALREADY_EXISTS, grpc::StatusCode::FAILED_PRECONDITION,
        grpc::StatusCode::NOT_FOUND, grpc::StatusCode::PERMISSION_DENIED,
        grpc::StatusCode::UNAUTHENTICATED, grpc::StatusCode::INTERNAL,
        // Without a RetryInfo.
        grpc::StatusCode::RESOURCE_EXHAUSTED, grpc::StatusCode::UNIMPLEMENTED));

TEST_F(PoseStreamTest, GoesOnAfterAResetOnTheWayWhichHasNoReason) {
  server_.FailBatches(FaultAt(
      1, {Kind::kBefore, MakeStatus(grpc::StatusCode::INTERNAL,
                                    "Received RST_STREAM with error code 1")}));
  const auto stream = Open();
  ASSERT_TRUE(stream->Append(MakeBatch(1, 500)).ok());
  EXPECT_TRUE(stream->Finish().ok());
  EXPECT_EQ(stream->reconnects(), 1);
  EXPECT_TRUE(server_.Stored() == Serialized(500));
}

TEST_F(PoseStreamTest, GoesOnAfterItsTokenExpiredOnceItWasOpened) {
  const grpc::Status expired =
      MakeStatus(grpc::StatusCode::UNAUTHENTICATED, "old", {"TOKEN_EXPIRED"});
  // Under the stream, and once more because the new one is late.
  int batches = 0;
  server_.FailBatches([&] {
    return ++batches == 2 ? StreamFault{Kind::kAfterAck, expired}
                          : StreamFault();
  });
  int opens = 0;
  server_.FailOpens([&] {
    return ++opens == 2 ? StreamFault{Kind::kBefore, expired} : StreamFault();
  });
  const auto stream = Open();
  ASSERT_TRUE(stream->WaitUntilOpened().ok());
  ASSERT_TRUE(stream->Append(MakeBatch(1, 500)).ok());
  EXPECT_TRUE(stream->Finish().ok());
  EXPECT_EQ(stream->reconnects(), 2);
  EXPECT_TRUE(server_.Stored() == Serialized(500));
}

TEST_F(PoseStreamTest, EndsIfItsTokenHasExpiredFromTheStart) {
  server_.FailOpens([] {
    return StreamFault{Kind::kBefore,
                       MakeStatus(grpc::StatusCode::UNAUTHENTICATED, "old",
                                  {"TOKEN_EXPIRED"})};
  });
  const auto stream = Open();
  EXPECT_EQ(stream->WaitUntilOpened().status().code(),
            absl::StatusCode::kUnauthenticated);
  EXPECT_EQ(stream->reconnects(), 0);
}

TEST_F(PoseStreamTest, DeliversCandidatesAndFinishWaitsForTheLast) {
  server_.set_check_interval(100);
  PoseStreamOptions options = Options();
  options.send_candidates = true;
  std::vector<std::uint64_t> checks;
  PoseStreamCallbacks callbacks;
  callbacks.candidates = [&](const v1::CandidateSet& set) {
    checks.push_back(set.query().sequence());
  };
  const auto stream = Open(options, callbacks);
  ASSERT_TRUE(stream->Append(MakeBatch(1, 350)).ok());
  ASSERT_TRUE(stream->Finish().ok());
  EXPECT_THAT(checks, ElementsAre(100u, 200u, 300u));
}

TEST_F(PoseStreamTest, SaysWhenItResumedSinceAnswersOfChecksMayBeLost) {
  server_.set_check_interval(10);
  // The third batch becomes durable and acknowledged, its check is not
  // answered.
  server_.FailBatches(FaultAt(2, {Kind::kAfterAck, Unavailable()}));
  PoseStreamOptions options = Options();
  options.send_candidates = true;
  options.batch_poses = 10;
  std::vector<std::uint64_t> checks;
  std::vector<std::uint64_t> resumed;
  std::vector<std::string> disconnects;
  PoseStreamCallbacks callbacks;
  callbacks.candidates = [&](const v1::CandidateSet& set) {
    checks.push_back(set.query().sequence());
  };
  callbacks.resumed = [&](std::uint64_t durable) {
    resumed.push_back(durable);
  };
  callbacks.disconnected = [&](const absl::Status& status,
                               std::chrono::nanoseconds) {
    disconnects.emplace_back(status.message());
  };
  const auto stream = Open(options, callbacks);
  ASSERT_TRUE(stream->Append(MakeBatch(1, 50)).ok());
  ASSERT_TRUE(stream->Finish().ok());
  EXPECT_THAT(checks, ElementsAre(10u, 20u, 40u, 50u));
  EXPECT_THAT(resumed, ElementsAre(30u));
  EXPECT_THAT(disconnects, ElementsAre("cut"));
  EXPECT_EQ(stream->reconnects(), 1);
}

TEST_F(PoseStreamTest, WaitsAsLongAsTheServerAsks) {
  server_.FailOpens(
      FaultAt(0, {Kind::kBefore,
                  MakeStatus(grpc::StatusCode::UNAVAILABLE, "draining",
                             {"SERVER_DRAINING", {}, {}, milliseconds(120)})}));
  std::chrono::nanoseconds waited{0};
  PoseStreamCallbacks callbacks;
  callbacks.disconnected = [&](const absl::Status&,
                               std::chrono::nanoseconds wait) {
    waited = wait;
  };
  const auto start = std::chrono::steady_clock::now();
  const auto stream = Open(Options(), callbacks);
  EXPECT_TRUE(stream->WaitUntilOpened().ok());
  EXPECT_GE(std::chrono::steady_clock::now() - start, milliseconds(120));
  EXPECT_TRUE(stream->Finish().ok());
  EXPECT_GE(waited, milliseconds(120));
  EXPECT_LT(waited, milliseconds(150));
}

TEST_F(PoseStreamTest, ReconnectsAfterAServerCutItAsItShutDown) {
  server_.FailOpens(FaultAt(
      0, {Kind::kBefore, MakeStatus(grpc::StatusCode::CANCELLED, "cut")}));
  const auto stream = Open(Options());
  ASSERT_TRUE(stream->Append(MakeBatch(1, 50)).ok());
  EXPECT_TRUE(stream->Finish().ok());
  EXPECT_TRUE(server_.Stored() == Serialized(50));
}

TEST_F(PoseStreamTest, LeavesAConnectionOnWhichNoAnswerComes) {
  server_.FailBatches(FaultAt(1, {Kind::kSilence, {}}));
  PoseStreamOptions options = Options();
  options.answer_timeout = milliseconds(100);
  options.batch_poses = 10;
  const auto stream = Open(options);
  ASSERT_TRUE(stream->Append(MakeBatch(1, 50)).ok());
  const absl::Status finished = stream->Finish();
  EXPECT_TRUE(finished.ok()) << finished;
  EXPECT_TRUE(server_.Stored() == Serialized(50));
  EXPECT_GE(stream->reconnects(), 1);
}

TEST_F(PoseStreamTest, LeavesASilentConnectionWellBeforeItGivesUp) {
  server_.FailBatches(FaultAt(1, {Kind::kSilence, {}}));
  PoseStreamOptions options = Options();
  options.give_up_after = milliseconds(4'000);
  options.batch_poses = 10;
  const auto stream = Open(options);
  ASSERT_TRUE(stream->Append(MakeBatch(1, 50)).ok());
  const absl::Status finished = stream->Finish();
  EXPECT_TRUE(finished.ok()) << finished;
  EXPECT_TRUE(server_.Stored() == Serialized(50));
}

TEST_F(PoseStreamTest, FinishWithinWaitsForAllPosesOrForItsLimit) {
  {
    const auto stream = Open();
    ASSERT_TRUE(stream->Append(MakeBatch(1, 100)).ok());
    EXPECT_TRUE(stream->FinishWithin(milliseconds(30'000)).ok());
    EXPECT_EQ(stream->acked_sequence(), 100u);
  }
  const auto stream = Open();
  ASSERT_TRUE(stream->WaitUntilOpened().ok());
  server_.HoldStreams(true);
  ASSERT_TRUE(stream->Append(MakeBatch(101, 50)).ok());
  EXPECT_TRUE(absl::IsCancelled(stream->FinishWithin(milliseconds(20))));
  EXPECT_FALSE(stream->Append(MakeBatch(151, 1)).ok());
  EXPECT_EQ(stream->acked_sequence(), 100u);
  server_.HoldStreams(false);
}

TEST_F(PoseStreamTest, GivesUpWithTheLastStatusWhereThatWasAskedFor) {
  server_.Stop();
  PoseStreamOptions options = Options();
  options.give_up_after = milliseconds(100);
  const auto stream = Open(options);
  const auto opened = stream->WaitUntilOpened();
  EXPECT_EQ(opened.status().code(), absl::StatusCode::kUnavailable);
  EXPECT_EQ(stream->Finish().code(), absl::StatusCode::kUnavailable);
}

TEST_F(PoseStreamTest, CancelEndsItWhereverItIs) {
  server_.HoldStreams(true);
  PoseStreamOptions options = Options();
  options.max_pending_poses = 10;
  const auto stream = Open(options);
  std::thread appender([&] {
    EXPECT_EQ(stream->Append(MakeBatch(1, 100)).code(),
              absl::StatusCode::kCancelled);
  });
  while (stream->pending_poses() < 10) std::this_thread::yield();
  stream->Cancel();
  appender.join();
  EXPECT_EQ(stream->Finish().code(), absl::StatusCode::kCancelled);
  server_.HoldStreams(false);
}

TEST_F(PoseStreamTest, CanBeCancelledFromACallback) {
  std::unique_ptr<PoseStream> stream;
  PoseStreamCallbacks callbacks;
  callbacks.ack = [&](const v1::Ack&) { stream->Cancel(); };
  server_.HoldStreams(true);
  stream = Open(Options(), callbacks);
  ASSERT_TRUE(stream->Append(MakeBatch(1, 10)).ok());
  server_.HoldStreams(false);
  EXPECT_EQ(stream->Finish().code(), absl::StatusCode::kCancelled);
}

TEST_F(PoseStreamTest, CanBeDestroyedWithoutFinish) {
  server_.HoldStreams(true);
  auto stream = Open();
  ASSERT_TRUE(stream->Append(MakeBatch(1, 10)).ok());
  stream.reset();
  server_.HoldStreams(false);
}

}  // namespace
}  // namespace revisit::client
