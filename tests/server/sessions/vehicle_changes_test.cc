#include <cstdint>
#include <string>

#include "gmock/gmock.h"
#include "gtest/gtest.h"
#include "server/base/status.h"
#include "tests/server/error_matchers.h"
#include "tests/server/sessions/session_testing.h"
#include "tests/server/sessions/vehicle_session_testing.h"

namespace revisit::server {
namespace {

using absl::StatusCode;
using ::testing::_;
using ::testing::HasSubstr;

TEST_F(VehicleSessionTest, IsTheSameAfterReload) {
  ASSERT_THAT(AppendNow(*session_, SquareBatch(1, 33)), IsOk());
  ASSERT_THAT(AppendNow(*session_, SquareBatch(34, 60)), IsOk());
  ASSERT_THAT(AddPairNow(*session_, kClosure, {"z", 90, 10, 1}), IsOk());
  ASSERT_THAT(AddPairNow(*session_, kClosure, {"b", 90, 9, 2}), IsOk());
  ASSERT_THAT(AddPairNow(*session_, kClosure, {"a", 90, 8, 3}), IsOk());
  ASSERT_THAT(DeletePairNow(*session_, kClosure, "b"), IsOk());
  ASSERT_THAT(AddPairNow(*session_, kRejection, {"z", 90, 30, 4}), IsOk());
  ASSERT_THAT(AddPairNow(*session_, kRejection, {"a", 90, 31, 5}), IsOk());
  ASSERT_THAT(AddPairNow(*session_, kClosure, {"m", 91, 11, 6}), IsOk());
  const Snapshot before = *ReadNow(*session_);
  EXPECT_EQ(before.revision, 10u);
  EXPECT_EQ(before.loop_closure_count, 3);
  EXPECT_EQ(before.consistency.rejected, 2);
  Reload();
  const Snapshot after = *ReadNow(*session_);
  EXPECT_EQ(after.durable_sequence, before.durable_sequence);
  EXPECT_EQ(after.revision, before.revision);
  EXPECT_EQ(after.loop_closure_count, before.loop_closure_count);
  EXPECT_EQ(after.graph, before.graph);
  EXPECT_EQ(after.consistency.confirmed, before.consistency.confirmed);
  EXPECT_EQ(after.consistency.rejected, before.consistency.rejected);
  EXPECT_EQ(after.consistency.mean_normalized_innovation_squared,
            before.consistency.mean_normalized_innovation_squared);
  EXPECT_EQ(after.consistency.inflation, before.consistency.inflation);
  // And goes on the same.
  EXPECT_EQ(AppendNow(*session_, SquareBatch(94, 1))->revision, 11u);
}

TEST_F(VehicleSessionTest, RebuildsGraphWhereNodesMove) {
  ASSERT_THAT(AppendNow(*session_, StraightBatch(1, 41)), IsOk());
  const auto updated = UpdateNow(*session_, [](const VehicleView& view) {
    VehicleConfig config = view.config;
    config.drive.node_spacing_meters = 4.0;
    return config;
  });
  ASSERT_THAT(updated, IsOk());
  EXPECT_EQ(updated->node_count, 11);
  EXPECT_EQ(updated->revision, 3u);
  EXPECT_EQ(AppendNow(*session_, StraightBatch(42, 4))->revision, 4u);
  const Snapshot before = *ReadNow(*session_);
  EXPECT_EQ(before.node_count, 12);
  Reload();
  EXPECT_EQ(ReadNow(*session_)->graph, before.graph);
  EXPECT_EQ(ReadNow(*session_)->config.drive.node_spacing_meters, 4.0);
}

TEST_F(VehicleSessionTest, KeepsSettingsThatMoveNoNodes) {
  ASSERT_THAT(AppendNow(*session_, StraightBatch(1, 5)), IsOk());
  const std::string graph = ReadNow(*session_)->graph;
  const auto updated = UpdateNow(*session_, [](const VehicleView& view) {
    VehicleConfig config = view.config;
    config.drive.search.max_candidates = 9;
    return config;
  });
  ASSERT_THAT(updated, IsOk());
  EXPECT_EQ(updated->config.drive.search.max_candidates, 9);
  EXPECT_EQ(updated->graph, graph);
  EXPECT_EQ(updated->revision, 3u);
  Reload();
  EXPECT_EQ(ReadNow(*session_)->config.drive.search.max_candidates, 9);
  EXPECT_EQ(ReadNow(*session_)->revision, 3u);
}

TEST_F(VehicleSessionTest, ChangeMayRefuse) {
  EXPECT_THAT(UpdateNow(*session_,
                        [](const VehicleView& view) {
                          EXPECT_EQ(view.id, "truck");
                          return Error(StatusCode::kFailedPrecondition,
                                       "SETTING_FIXED", "no");
                        }),
              IsError(StatusCode::kFailedPrecondition, "SETTING_FIXED", "no"));
  EXPECT_EQ(ReadNow(*session_)->revision, 1u);
}

TEST_F(VehicleSessionTest, FailedChangeLeavesVehicleAsItWas) {
  ASSERT_THAT(AppendNow(*session_, StraightBatch(1, 5)), IsOk());
  storage_.Hold();
  for (const double spacing : {1.0, 2.0}) {
    const Answer<absl::StatusOr<Snapshot>> updated;
    session_->Update(
        [=](const VehicleView& view) {
          VehicleConfig config = view.config;
          config.drive.node_spacing_meters = spacing;
          config.drive.search.max_candidates = 9;
          return config;
        },
        Taking(updated));
    storage_.FailOne(DeviceFailure());
    EXPECT_THAT(updated.Get(),
                IsError(StatusCode::kUnavailable, "STORE_UNAVAILABLE", _));
    EXPECT_EQ(ReadNow(*session_)->config.drive.search.max_candidates, 5);
    EXPECT_EQ(ReadNow(*session_)->revision, 2u);
  }
  storage_.ReleaseAll();
  EXPECT_EQ(AppendNow(*session_, StraightBatch(6, 1))->revision, 3u);
}

TEST_F(VehicleSessionTest, RevisesPosesUnderOneRevision) {
  for (std::uint64_t first = 1; first <= 7; first += 3) {
    ASSERT_THAT(AppendNow(*session_, StraightBatch(first, 3)), IsOk());
  }
  ASSERT_THAT(AddPairNow(*session_, kClosure, {"a", 9, 1, 0}), IsOk());
  const auto revised = ReviseNow(*session_, ShiftSecondBatch);
  ASSERT_THAT(revised, IsOk());
  EXPECT_EQ(revised->revision, 6u);
  EXPECT_EQ(revised->revised_count, 3);
  const Snapshot snapshot = *ReadNow(*session_);
  EXPECT_EQ(snapshot.revision, 6u);
  // 200 m are beyond the maximal step: now there is a jump there and one back.
  EXPECT_EQ(snapshot.node_count, 9);
  EXPECT_THAT(snapshot.graph, HasSubstr("0x1.98p+7"));
  EXPECT_THAT(snapshot.graph, HasSubstr(" - "));
  Reload();
  EXPECT_EQ(ReadNow(*session_)->graph, snapshot.graph);
  EXPECT_EQ(ReadNow(*session_)->revision, 6u);
  // Resent poses are still compared with what was first sent.
  EXPECT_THAT(AppendNow(*session_, StraightBatch(4, 6)), IsOk());
  EXPECT_THAT(
      AppendNow(*session_, PlainBatch(4, {204, 205, 206})),
      IsError(StatusCode::kAlreadyExists, "SEQUENCE_CONTENT_MISMATCH", _));
}

TEST_F(VehicleSessionTest, PlanWithoutBatchesChangesNothing) {
  const auto revised =
      ReviseNow(*session_, [](const VehicleView&) { return RevisionPlan(); });
  ASSERT_THAT(revised, IsOk());
  EXPECT_EQ(revised->revision, 1u);
  EXPECT_EQ(revised->revised_count, 0);
}

TEST_F(VehicleSessionTest, PlanMayRefuse) {
  EXPECT_THAT(ReviseNow(*session_,
                        [](const VehicleView&) {
                          return Error(StatusCode::kAborted,
                                       "REVISION_MISMATCH", "no");
                        }),
              IsError(StatusCode::kAborted, "REVISION_MISMATCH", "no"));
}

TEST_F(VehicleSessionTest, ShowsOldGraphUntilRevisionIsDurable) {
  for (std::uint64_t first = 1; first <= 7; first += 3) {
    ASSERT_THAT(AppendNow(*session_, StraightBatch(first, 3)), IsOk());
  }
  const Snapshot before = *ReadNow(*session_);
  storage_.Hold();
  const Answer<absl::StatusOr<RevisionResult>> revised;
  session_->Revise(ShiftSecondBatch, revised.Setter());
  storage_.Await(1);
  EXPECT_EQ(ReadNow(*session_)->graph, before.graph);
  EXPECT_EQ(ReadNow(*session_)->revision, before.revision);
  storage_.ReleaseAll();
  ASSERT_THAT(revised.Get(), IsOk());
  EXPECT_NE(ReadNow(*session_)->graph, before.graph);
}

// New poses were read while the view was still of the old revision: later reads
// went back in time.
TEST_F(VehicleSessionTest, StoreIsReadAtTheRevisionOfTheView) {
  for (std::uint64_t first = 1; first <= 7; first += 3) {
    ASSERT_THAT(AppendNow(*session_, StraightBatch(first, 3)), IsOk());
  }
  const auto read_stored = [&] {
    const Answer<absl::StatusOr<Snapshot>> answer;
    session_->ReadStored(Taking(answer));
    return answer;
  };
  EXPECT_EQ(read_stored().Get()->revision, 4u);
  storage_.Hold();
  const Answer<absl::StatusOr<RevisionResult>> revised;
  session_->Revise(ShiftSecondBatch, revised.Setter());
  storage_.Await(1);
  const auto stored = read_stored();
  EXPECT_EQ(ReadNow(*session_)->revision, 4u);
  EXPECT_FALSE(stored.IsSet());
  storage_.ReleaseAll();
  EXPECT_EQ(stored.Get()->revision, 5u);
  // Nor does one that failed hold it up.
  storage_.Hold();
  session_->Revise(ShiftSecondBatch, [](const auto&) {});
  storage_.FailOne(DeviceFailure());
  EXPECT_EQ(read_stored().Get()->revision, 5u);
  storage_.ReleaseAll();
}

TEST_F(VehicleSessionTest, DeletedVehicleIsNotReadOnceTheStoreIsWithoutIt) {
  storage_.Hold();
  const Answer<absl::Status> deleted;
  session_->Delete(deleted.Setter());
  storage_.Await(1);
  const Answer<absl::StatusOr<Snapshot>> read;
  session_->Read(Taking(read));
  const Answer<absl::StatusOr<Snapshot>> behind;
  session_->LongRead(Taking(behind));
  EXPECT_FALSE(read.IsSet());
  storage_.FailOne(DeviceFailure());
  EXPECT_THAT(read.Get(), IsOk());
  EXPECT_THAT(behind.Get(), IsOk());
  const Answer<absl::Status> again;
  session_->Delete(again.Setter());
  storage_.Await(1);
  const Answer<absl::StatusOr<Snapshot>> late;
  session_->Read(Taking(late));
  storage_.ReleaseAll();
  EXPECT_THAT(late.Get(),
              IsError(StatusCode::kNotFound, "VEHICLE_NOT_FOUND", _));
}

TEST_F(VehicleSessionTest, RevisionThatWasDoneBeforeIsAnsweredAgain) {
  ASSERT_THAT(AppendNow(*session_, StraightBatch(1, 9)), IsOk());
  const auto revised = ReviseNow(*session_, [](const VehicleView&) {
    RevisionPlan plan;
    plan.batches = BatchesOf({{1, 9, 0, StraightBatch(1, 9)}});
    plan.revised_count = 4;
    plan.done_by = 2;
    return plan;
  });
  ASSERT_THAT(revised, IsOk());
  EXPECT_EQ(revised->revision, 2u);
  EXPECT_EQ(revised->revised_count, 4);
  EXPECT_EQ(ReadNow(*session_)->revision, 2u);
}

TEST_F(VehicleSessionTest, LoadsAnewIfRevisedPosesCannotBeRead) {
  for (std::uint64_t first = 1; first <= 7; first += 3) {
    ASSERT_THAT(AppendNow(*session_, StraightBatch(first, 3)), IsOk());
  }
  storage_.Hold();
  const Answer<absl::StatusOr<RevisionResult>> revised;
  session_->Revise(ShiftSecondBatch, revised.Setter());
  storage_.Await(1);
  storage_.FailReads(DeviceFailure());
  storage_.ReleaseAll();
  EXPECT_THAT(revised.Get(),
              IsError(StatusCode::kUnavailable, "STORE_UNAVAILABLE", _));
  EXPECT_TRUE(session_->gone());
  storage_.FailReads(absl::OkStatus());
  session_ = Load("truck");
  EXPECT_EQ(ReadNow(*session_)->revision, 5u);
}

}  // namespace
}  // namespace revisit::server
