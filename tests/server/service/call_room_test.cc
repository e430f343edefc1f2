#include "server/service/call_room.h"

#include <cstdint>

#include "absl/status/statusor.h"
#include "gmock/gmock.h"
#include "gtest/gtest.h"
#include "tests/server/error_matchers.h"

namespace revisit::server {
namespace {

using absl::StatusCode;
using ::testing::_;

class CallRoomTest : public testing::Test {
 protected:
  static Limits Small() {
    Limits limits;
    limits.max_calls_per_caller = 1;
    limits.max_calls_per_vehicle = 1;
    limits.max_streams_per_caller = 1;
    limits.max_rebuilt_poses_per_caller = 1000;
    limits.max_queued_bytes_per_vehicle = 600;
    return limits;
  }

  static std::int64_t NoMemory() { return 0; }

  Admission admission_{Small(), 1, NoMemory};
  const MethodRule* const get_ = FindMethodRule("GetVehicle");
};

TEST_F(CallRoomTest, GivesBackAllThatTheCallTook) {
  CallRoom first(&admission_, get_);
  ASSERT_THAT(first.Enter("caller"), IsOk());
  ASSERT_THAT(first.ChooseVehicle("v"), IsOk());
  ASSERT_THAT(first.TakeRebuild(1000), IsOk());
  ASSERT_THAT(first.TakeBatch(600), IsOk());
  CallRoom other(&admission_, get_);
  EXPECT_THAT(other.Enter("caller"),
              IsError(StatusCode::kResourceExhausted, "QUEUE_FULL", _));
  EXPECT_THAT(other.ChooseVehicle("v"),
              IsError(StatusCode::kResourceExhausted, "QUEUE_FULL", _));
  EXPECT_THAT(other.TakeRebuild(1),
              IsError(StatusCode::kResourceExhausted, "QUEUE_FULL", _));
  EXPECT_THAT(other.TakeBatch(1),
              IsError(StatusCode::kResourceExhausted, "QUEUE_FULL", _));
  first.GiveBack();
  EXPECT_THAT(other.Enter("caller"), IsOk());
  EXPECT_THAT(other.ChooseVehicle("v"), IsOk());
  EXPECT_THAT(other.TakeRebuild(1000), IsOk());
  EXPECT_THAT(other.TakeBatch(600), IsOk());
}

TEST_F(CallRoomTest, HoldsNothingThatIsTakenAfterTheEnd) {
  CallRoom ended(&admission_, get_);
  ASSERT_THAT(ended.Enter("caller"), IsOk());
  ended.GiveBack();
  EXPECT_THAT(ended.ChooseVehicle("v"),
              IsError(StatusCode::kCancelled, "CANCELLED", _));
  CallRoom other(&admission_, get_);
  EXPECT_THAT(other.ChooseVehicle("v"), IsOk());
}

TEST_F(CallRoomTest, StreamsAndUnaryCallsHaveRoomOfTheirOwn) {
  CallRoom call(&admission_, get_);
  CallRoom stream(&admission_, FindMethodRule("StreamPoses"));
  CallRoom another(&admission_, FindMethodRule("StreamPoses"));
  ASSERT_THAT(call.Enter("caller"), IsOk());
  ASSERT_THAT(stream.Enter("caller"), IsOk());
  EXPECT_THAT(another.Enter("caller"),
              IsError(StatusCode::kResourceExhausted, "STREAM_QUOTA", _));
}

TEST_F(CallRoomTest, CallThatNeedsNothingOfTheStoreTakesNoRoom) {
  CallRoom call(&admission_, get_);
  ASSERT_THAT(call.Enter("caller"), IsOk());
  CallRoom info(&admission_, FindMethodRule("GetServerInfo"));
  EXPECT_THAT(info.Enter("caller"), IsOk());
}

TEST_F(CallRoomTest, PermitOfABatchOutlastsTheCall) {
  CallRoom room(&admission_, get_);
  ASSERT_THAT(room.ChooseVehicle("v"), IsOk());
  absl::StatusOr<Permit> permit = room.AdmitBatch(500);
  ASSERT_THAT(permit, IsOk());
  room.GiveBack();
  EXPECT_THAT(room.AdmitBatch(200),
              IsError(StatusCode::kResourceExhausted, "QUEUE_FULL", _));
  permit->reset();
  EXPECT_THAT(room.AdmitBatch(200), IsOk());
}

}  // namespace
}  // namespace revisit::server
