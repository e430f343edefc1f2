#include <cstdint>

#include "gmock/gmock.h"
#include "gtest/gtest.h"
#include "server/base/status.h"
#include "tests/server/error_matchers.h"
#include "tests/server/sessions/session_testing.h"
#include "tests/server/sessions/vehicle_session_testing.h"
#include "tests/server/storage_testing.h"

namespace revisit::server {
namespace {

using absl::StatusCode;
using ::testing::_;
using ::testing::AllOf;
using ::testing::HasSubstr;

TEST_F(VehicleSessionTest, BelievesClientThatHoldsNoMoreThanIsStored) {
  ASSERT_THAT(AppendNow(*session_, StraightBatch(1, 9)), IsOk());
  for (const std::uint64_t acked : {0, 5, 9}) {
    const auto view = CheckAcknowledgedNow(*session_, acked);
    ASSERT_THAT(view, IsOk());
    EXPECT_EQ(view->durable_sequence, 9u);
  }
}

TEST_F(VehicleSessionTest, RefusesWritesOnceDataWasLost) {
  ASSERT_THAT(AppendNow(*session_, StraightBatch(1, 9)), IsOk());
  const absl::Status status =
      CheckAcknowledgedNow(*session_, 12, kUid).status();
  EXPECT_THAT(status,
              IsError(StatusCode::kDataLoss, "DURABLE_SEQUENCE_REGRESSED",
                      HasSubstr("the 9 poses that are stored")));
  EXPECT_EQ(MetadataOf(status, "durable_sequence"), "9");
  EXPECT_EQ(MetadataOf(status, "acked_sequence"), "12");
  const auto lost =
      IsError(StatusCode::kDataLoss, "DURABLE_SEQUENCE_REGRESSED", _);
  for (int i = 0; i < 2; ++i) {
    EXPECT_THAT(AppendNow(*session_, StraightBatch(10, 1)), lost);
    EXPECT_THAT(AppendNow(*session_, StraightBatch(9, 1)), lost);
    for (const PairKind kind : {kClosure, kRejection}) {
      EXPECT_THAT(AddPairNow(*session_, kind, {"a", 9, 2, 0}), lost);
      EXPECT_THAT(DeletePairNow(*session_, kind, "a"), lost);
    }
    EXPECT_THAT(ReviseNow(*session_, ShiftSecondBatch), lost);
    EXPECT_THAT(UpdateNow(*session_,
                          [](const VehicleView& view) { return view.config; }),
                lost);
    EXPECT_THAT(CheckAcknowledgedNow(*session_, 10, kUid), lost);
    // Reads go on.
    const auto read = ReadNow(*session_);
    EXPECT_TRUE(read->config.data_loss);
    EXPECT_EQ(read->durable_sequence, 9u);
    EXPECT_EQ(read->revision, 3u);
    // It is remembered.
    Reload();
  }
}

// A vehicle was deleted and made again, and a client of the old one put the new
// one into data loss; and so could any number that somebody made up.
TEST_F(VehicleSessionTest, ClaimOfAnotherVehicleChangesNothing) {
  ASSERT_THAT(AppendNow(*session_, StraightBatch(1, 9)), IsOk());
  for (const std::uint64_t acked : {0, 5, 12}) {
    const absl::Status status =
        CheckAcknowledgedNow(*session_, acked, "uid-of-old").status();
    EXPECT_THAT(status,
                IsError(StatusCode::kFailedPrecondition, "VEHICLE_REPLACED",
                        HasSubstr("has the uid uid-of-test, got uid-of-old")));
    EXPECT_EQ(MetadataOf(status, "vehicle_uid"), "uid-of-test");
    EXPECT_EQ(MetadataOf(status, "expected_vehicle_uid"), "uid-of-old");
  }
  // One that does not say which vehicle it is of ends by itself.
  const absl::Status nameless = CheckAcknowledgedNow(*session_, 12).status();
  EXPECT_THAT(nameless,
              IsError(StatusCode::kDataLoss, "DURABLE_SEQUENCE_REGRESSED",
                      HasSubstr("only 9 poses are stored")));
  EXPECT_EQ(MetadataOf(nameless, "durable_sequence"), "9");
  EXPECT_EQ(MetadataOf(nameless, "acked_sequence"), "12");
  const auto read = ReadNow(*session_);
  EXPECT_FALSE(read->config.data_loss);
  EXPECT_EQ(read->revision, 2u);
  EXPECT_THAT(AppendNow(*session_, StraightBatch(10, 1)), IsOk());
}

TEST_F(VehicleSessionTest, WritesAgainOnceTheLossIsAccepted) {
  ASSERT_THAT(AppendNow(*session_, StraightBatch(1, 9)), IsOk());
  EXPECT_THAT(AcceptDataLossNow(*session_, 9),
              IsError(StatusCode::kFailedPrecondition, "NO_DATA_LOSS",
                      "vehicle 'truck' is neither in the state DATA_LOSS nor "
                      "DAMAGED"));
  ASSERT_FALSE(CheckAcknowledgedNow(*session_, 12, kUid).ok());
  EXPECT_THAT(
      AcceptDataLossNow(*session_, 12),
      IsError(StatusCode::kFailedPrecondition, "DURABLE_SEQUENCE_MISMATCH",
              "durable_sequence: got 12, the vehicle's is 9"));
  const auto accepted = AcceptDataLossNow(*session_, 9);
  ASSERT_THAT(accepted, IsOk());
  EXPECT_FALSE(accepted->config.data_loss);
  EXPECT_EQ(accepted->revision, 4u);
  Reload();
  EXPECT_THAT(AppendNow(*session_, StraightBatch(10, 1)), IsOk());
}

// A reader saw it, at the revision from before it, and a crash took it back.
TEST_F(VehicleSessionTest, ClaimedLossShowsOnceItIsStored) {
  ASSERT_THAT(AppendNow(*session_, StraightBatch(1, 9)), IsOk());
  storage_.Hold();
  const Answer<absl::StatusOr<Snapshot>> checked;
  session_->CheckAcknowledged(12, kUid, Taking(checked));
  storage_.Await(1);
  const auto before = ReadNow(*session_);
  EXPECT_FALSE(before->config.data_loss);
  EXPECT_EQ(before->revision, 2u);
  storage_.ReleaseAll();
  EXPECT_THAT(checked.Get(),
              IsError(StatusCode::kDataLoss, "DURABLE_SEQUENCE_REGRESSED", _));
  const auto after = ReadNow(*session_);
  EXPECT_TRUE(after->config.data_loss);
  EXPECT_EQ(after->revision, 3u);
}

TEST_F(VehicleSessionTest, RefusesWritesEvenIfTheLossCannotBeStored) {
  storage_.Hold();
  const Answer<absl::StatusOr<Snapshot>> checked;
  session_->CheckAcknowledged(12, kUid, Taking(checked));
  storage_.FailOne(DeviceFailure());
  const auto lost =
      IsError(StatusCode::kDataLoss, "DURABLE_SEQUENCE_REGRESSED", _);
  EXPECT_THAT(checked.Get(), lost);
  storage_.ReleaseAll();
  EXPECT_THAT(AppendNow(*session_, StraightBatch(1, 1)), lost);
}

// After a clock had been wrong once, all later pairs had a wrong time as well.
TEST_F(VehicleSessionTest, WrongClockDoesNotLast) {
  for (std::uint64_t first = 1; first <= 161; first += 20) {
    ASSERT_THAT(AppendNow(*session_, SquareBatch(first, 20)), IsOk());
  }
  constexpr std::int64_t kWrong = 3'155'760'000'000'000'000;  // A century.
  const auto time_of = [&](PairKind kind, const PosePairRecord& pair) {
    const auto added = AddPairNow(*session_, kind, pair);
    EXPECT_THAT(added, IsOk());
    return added->pair.create_time_ns;
  };
  EXPECT_EQ(time_of(kClosure, {"a", 100, 20, 10}), 10);
  EXPECT_EQ(time_of(kClosure, {"b", 120, 40, kWrong}), kWrong);
  EXPECT_EQ(time_of(kClosure, {"c", 140, 61, 30}), 30);
  EXPECT_EQ(time_of(kRejection, {"d", 140, 62, 40}), 40);
  // What is corrected by no more than clocks are goes behind the last.
  EXPECT_EQ(time_of(kClosure, {"e", 150, 70, kWrong - kMostClockError}),
            kWrong + 1);
  // The order is that of the times, as it will be once it is loaded again.
  const Snapshot before = *ReadNow(*session_);
  EXPECT_EQ(before.loop_closure_count, 4);
  EXPECT_EQ(before.consistency.confirmed, 4);
  Reload();
  const Snapshot after = *ReadNow(*session_);
  EXPECT_EQ(after.graph, before.graph);
  EXPECT_EQ(after.revision, before.revision);
  EXPECT_EQ(after.consistency.inflation, before.consistency.inflation);
  // Gone with the pair that had it.
  ASSERT_THAT(DeletePairNow(*session_, kClosure, "e"), IsOk());
  ASSERT_THAT(DeletePairNow(*session_, kClosure, "b"), IsOk());
  EXPECT_EQ(time_of(kClosure, {"f", 160, 80, 7}), 41);
}

TEST_F(VehicleSessionTest, DamagedVehicleIsReadAsFarAsItIsSound) {
  for (std::uint64_t first = 1; first <= 7; first += 3) {
    ASSERT_THAT(AppendNow(*session_, StraightBatch(first, 3)), IsOk());
  }
  ASSERT_THAT(AddPairNow(*session_, kClosure, {"in", 3, 1, 0}), IsOk());
  ASSERT_THAT(AddPairNow(*session_, kRejection, {"out", 9, 1, 0}), IsOk());
  const std::uint64_t revision = ReadNow(*session_)->revision;
  memory_.DamagePose("truck", 5);
  Reload();
  const auto damaged =
      IsError(StatusCode::kDataLoss, "STORE_CORRUPT",
              AllOf(HasSubstr("vehicle 'truck' is damaged: batch is damaged"),
                    HasSubstr("AcceptDataLoss with durable_sequence 3")));
  for (int i = 0; i < 2; ++i) {
    const auto read = ReadNow(*session_);
    ASSERT_THAT(read, IsOk());
    EXPECT_THAT(read->damage, damaged);
    EXPECT_EQ(read->durable_sequence, 3u);
    EXPECT_EQ(read->node_count, 3);
    EXPECT_EQ(read->loop_closure_count, 1);
    EXPECT_EQ(read->consistency.rejected, 0);
    // Nobody knows which revisions the lost poses had brought.
    EXPECT_EQ(read->revision, revision + 6);
    EXPECT_THAT(AppendNow(*session_, StraightBatch(4, 1)), damaged);
    EXPECT_THAT(AppendNow(*session_, StraightBatch(1, 1)), damaged);
    EXPECT_THAT(AddPairNow(*session_, kClosure, {"a", 3, 2, 0}), damaged);
    EXPECT_THAT(DeletePairNow(*session_, kClosure, "in"), damaged);
    EXPECT_THAT(CheckAcknowledgedNow(*session_, 9, kUid), damaged);
    EXPECT_THAT(
        CheckAcknowledgedNow(*session_, 9, "uid-of-old"),
        IsError(StatusCode::kFailedPrecondition, "VEHICLE_REPLACED", _));
    EXPECT_THAT(UpdateNow(*session_,
                          [](const VehicleView& view) { return view.config; }),
                damaged);
    Reload();
  }
  EXPECT_THAT(
      AcceptDataLossNow(*session_, 9),
      IsError(StatusCode::kFailedPrecondition, "DURABLE_SEQUENCE_MISMATCH", _));
  const auto accepted = AcceptDataLossNow(*session_, 3);
  ASSERT_THAT(accepted, IsOk());
  EXPECT_THAT(accepted->damage, IsOk());
  EXPECT_EQ(accepted->revision, revision + 7);
  ASSERT_THAT(AppendNow(*session_, StraightBatch(4, 2)), IsOk());
  const Snapshot whole = *ReadNow(*session_);
  Reload();
  EXPECT_EQ(ReadNow(*session_)->graph, whole.graph);
  EXPECT_EQ(ReadNow(*session_)->revision, revision + 8);
  EXPECT_EQ(ReadNow(*session_)->durable_sequence, 5u);
}

TEST_F(VehicleSessionTest, DamagedPairIsGivenUpAlone) {
  ASSERT_THAT(AppendNow(*session_, StraightBatch(1, 9)), IsOk());
  ASSERT_THAT(AddPairNow(*session_, kClosure, {"a", 9, 1, 0}), IsOk());
  ASSERT_THAT(AddPairNow(*session_, kClosure, {"b", 8, 1, 0}), IsOk());
  memory_.DamagePair("truck", kClosure, "a");
  Reload();
  EXPECT_THAT(ReadNow(*session_)->damage,
              IsError(StatusCode::kDataLoss, "STORE_CORRUPT",
                      HasSubstr("pair a is damaged")));
  EXPECT_EQ(ReadNow(*session_)->loop_closure_count, 1);
  EXPECT_EQ(ReadNow(*session_)->durable_sequence, 9u);
  ASSERT_THAT(AcceptDataLossNow(*session_, 9), IsOk());
  Reload();
  EXPECT_THAT(ReadNow(*session_)->damage, IsOk());
  EXPECT_EQ(ReadNow(*session_)->loop_closure_count, 1);
}

// It was ACTIVE again to those who asked the store, once it had left memory.
TEST_F(VehicleSessionTest, StoreKeepsThatAVehicleIsDamagedUntilThatIsAccepted) {
  for (std::uint64_t first = 1; first <= 7; first += 3) {
    ASSERT_THAT(AppendNow(*session_, StraightBatch(first, 3)), IsOk());
  }
  const auto is_marked = [&] {
    return codec_.DecodeVehicle(*memory_.GetVehicle("truck"))->damaged;
  };
  const std::uint64_t revision = memory_.GetVehicle("truck")->revision;
  memory_.DamagePose("truck", 5);
  EXPECT_FALSE(is_marked());
  Reload();
  EXPECT_FALSE(ReadNow(*session_)->damage.ok());
  CloseNow(*session_);
  EXPECT_TRUE(is_marked());
  EXPECT_EQ(memory_.GetVehicle("truck")->revision, revision);
  session_ = Load("truck");
  ASSERT_THAT(AcceptDataLossNow(*session_, 3), IsOk());
  EXPECT_FALSE(is_marked());
}

TEST_F(VehicleSessionTest, DamageThatIsNotFoundAgainEndsOnlyByADecision) {
  ASSERT_THAT(AppendNow(*session_, StraightBatch(1, 9)), IsOk());
  VehicleConfig marked = TestConfig();
  marked.damaged = true;
  const VehicleKey key = memory_.GetVehicle("truck")->key;
  ASSERT_THAT(
      BlockingWrites(&memory_).Update(key, codec_.EncodeVehicle(marked), 0),
      IsOk());
  Reload();
  const auto damaged = IsError(
      StatusCode::kDataLoss, "STORE_CORRUPT",
      AllOf(HasSubstr("damage was found in it before, although none is found"),
            HasSubstr("AcceptDataLoss with durable_sequence 9")));
  EXPECT_THAT(ReadNow(*session_)->damage, damaged);
  EXPECT_THAT(AppendNow(*session_, StraightBatch(10, 1)), damaged);
  ASSERT_THAT(AcceptDataLossNow(*session_, 9), IsOk());
  EXPECT_THAT(AppendNow(*session_, StraightBatch(10, 1)), IsOk());
  Reload();
  EXPECT_THAT(ReadNow(*session_)->damage, IsOk());
  EXPECT_EQ(ReadNow(*session_)->durable_sequence, 10u);
}

TEST_F(VehicleSessionTest, DamagedVehicleIsReadWhereTheMarkCannotBeWritten) {
  ASSERT_THAT(AppendNow(*session_, StraightBatch(1, 9)), IsOk());
  memory_.DamagePose("truck", 5);
  CloseNow(*session_);
  storage_.Hold();
  session_ = Load("truck");
  storage_.Await(1);
  EXPECT_FALSE(ReadNow(*session_)->damage.ok());
  storage_.FailOne(
      Error(StatusCode::kResourceExhausted, "STORAGE_FULL", "no room"));
  storage_.ReleaseAll();
  const auto damaged = IsError(StatusCode::kDataLoss, "STORE_CORRUPT", _);
  EXPECT_THAT(AppendNow(*session_, StraightBatch(10, 1)), damaged);
  EXPECT_THAT(ReadNow(*session_)->damage, damaged);
  EXPECT_FALSE(session_->gone());
}

TEST_F(VehicleSessionTest, VehicleWithoutItsSettingsCanBeDeleted) {
  ASSERT_THAT(AppendNow(*session_, StraightBatch(1, 9)), IsOk());
  memory_.DamageVehicle("truck");
  Reload();
  const auto damaged = IsError(
      StatusCode::kDataLoss, "STORE_CORRUPT",
      HasSubstr("vehicle is damaged; without its settings it can only be "
                "deleted"));
  EXPECT_THAT(ReadNow(*session_)->damage, damaged);
  EXPECT_FALSE(ReadNow(*session_)->config_is_known);
  EXPECT_EQ(ReadNow(*session_)->durable_sequence, 0u);
  EXPECT_THAT(AppendNow(*session_, StraightBatch(1, 1)), damaged);
  EXPECT_THAT(CheckAcknowledgedNow(*session_, 9, kUid), damaged);
  EXPECT_THAT(AcceptDataLossNow(*session_, 0), damaged);
  EXPECT_THAT(DeleteNow(*session_), IsOk());
  EXPECT_FALSE(memory_.GetVehicle("truck").ok());
}

TEST_F(VehicleSessionTest, IsLoadedAnewWhereSomebodyMetDamage) {
  ASSERT_THAT(AppendNow(*session_, StraightBatch(1, 9)), IsOk());
  session_->LoadAnew();
  EXPECT_THAT(AppendNow(*session_, StraightBatch(10, 1)),
              IsError(StatusCode::kUnavailable, "STORE_UNAVAILABLE",
                      HasSubstr("has to be loaded anew")));
  EXPECT_TRUE(session_->gone());
}

}  // namespace
}  // namespace revisit::server
