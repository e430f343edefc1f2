#include <cstdint>
#include <string>
#include <vector>

#include "core/drive/recordings.h"
#include "core/geometry/recording_start.h"
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
using ::testing::ElementsAre;
using ::testing::HasSubstr;

// Poses of which each begins a recording.
std::string Recordings(std::uint64_t first_sequence, std::uint64_t count) {
  std::string batch;
  for (std::uint64_t i = 0; i < count; ++i) {
    batch += RecordingBatch(first_sequence + i, 1);
  }
  return batch;
}

// The first sequences of the vehicle's recordings.
std::vector<std::uint64_t> StartsOf(VehicleSession& session) {
  Answer<absl::StatusOr<std::vector<std::uint64_t>>> answer;
  session.Read([answer](const absl::StatusOr<VehicleView>& view) {
    if (!view.ok()) {
      answer.Set(view.status());
      return;
    }
    std::vector<std::uint64_t> starts;
    const core::Recordings& recordings = view->drive.recordings();
    for (std::size_t k = 0; k < recordings.size(); ++k) {
      starts.push_back(recordings[k].first_sequence);
    }
    answer.Set(starts);
  });
  const absl::StatusOr<std::vector<std::uint64_t>> starts = answer.Get();
  EXPECT_THAT(starts, IsOk());
  return starts.ok() ? *starts : std::vector<std::uint64_t>();
}

constexpr std::uint64_t kMost = core::kMostRecordings;

TEST_F(VehicleSessionTest, RecordingsAreThoseThatPosesBegan) {
  ASSERT_THAT(AppendNow(*session_, StraightBatch(1, 5)), IsOk());
  EXPECT_THAT(StartsOf(*session_), ElementsAre(1));
  // The step to its first pose is no jump.
  const auto ack =
      AppendNow(*session_,
                "recording " + PlainBatch(6, {500, 501}) + StraightBatch(8, 1));
  ASSERT_THAT(ack, IsOk());
  ASSERT_EQ(ack->jumps.size(), 1u);
  EXPECT_EQ(ack->jumps[0].sequence, 8u);
  EXPECT_THAT(StartsOf(*session_), ElementsAre(1, 6));
  Reload();
  EXPECT_THAT(StartsOf(*session_), ElementsAre(1, 6));
}

TEST_F(VehicleSessionTest, StartOfARecordingIsContentOfItsPose) {
  ASSERT_THAT(AppendNow(*session_, StraightBatch(1, 5)), IsOk());
  ASSERT_THAT(AppendNow(*session_, RecordingBatch(6, 3)), IsOk());
  EXPECT_THAT(AppendNow(*session_, RecordingBatch(6, 3)), IsOk());
  const auto other = [](const char* sequence) {
    return IsError(StatusCode::kAlreadyExists, "SEQUENCE_CONTENT_MISMATCH",
                   HasSubstr("sequence " + std::string(sequence)));
  };
  EXPECT_THAT(AppendNow(*session_, StraightBatch(6, 3)), other("6"));
  EXPECT_THAT(AppendNow(*session_, RecordingBatch(5, 1)), other("5"));
  EXPECT_THAT(StartsOf(*session_), ElementsAre(1, 6));
}

TEST_F(VehicleSessionTest, RefusesABatchThatWouldBeginTooManyRecordings) {
  // The first pose is in the first recording, whether it says so or not.
  ASSERT_THAT(AppendNow(*session_, Recordings(1, kMost - 1)), IsOk());
  const absl::Status status =
      AppendNow(*session_, StraightBatch(kMost, 1) + Recordings(kMost + 1, 2))
          .status();
  EXPECT_THAT(status,
              IsError(StatusCode::kFailedPrecondition, "RECORDING_LIMIT",
                      AllOf(HasSubstr("'truck' has 999 recordings"),
                            HasSubstr("begins 2 more; allowed are 1000"))));
  EXPECT_EQ(MetadataOf(status, "limit"), "1000");
  EXPECT_EQ(ReadNow(*session_)->durable_sequence, kMost - 1);
  ASSERT_THAT(AppendNow(*session_, Recordings(kMost, 1)), IsOk());
  EXPECT_EQ(StartsOf(*session_).size(), kMost);
  EXPECT_THAT(AppendNow(*session_, Recordings(kMost + 1, 1)),
              IsError(StatusCode::kFailedPrecondition, "RECORDING_LIMIT", _));
  // Recordings that are stored already are no new ones, and poses go on.
  EXPECT_THAT(AppendNow(*session_, Recordings(kMost - 1, 2)), IsOk());
  EXPECT_THAT(
      AppendNow(*session_, Recordings(kMost, 1) + StraightBatch(kMost + 1, 1)),
      IsOk());
  Reload();
  EXPECT_EQ(StartsOf(*session_).size(), kMost);
}

TEST_F(VehicleSessionTest, CountsTheRecordingsOfBatchesInFlight) {
  storage_.Hold();
  const Appended first = Append(*session_, Recordings(1, kMost - 1));
  const Appended second = Append(*session_, Recordings(kMost, 1));
  const Appended third = Append(*session_, Recordings(kMost + 1, 1));
  EXPECT_THAT(second.staged.Get(), IsOk());
  EXPECT_THAT(third.staged.Get(),
              IsError(StatusCode::kFailedPrecondition, "RECORDING_LIMIT",
                      HasSubstr("has 1000 recordings")));
  storage_.ReleaseAll();
  EXPECT_THAT(first.durable.Get(), IsOk());
  EXPECT_THAT(second.durable.Get(), IsOk());
  EXPECT_THAT(third.durable.Get(),
              IsError(StatusCode::kFailedPrecondition, "RECORDING_LIMIT", _));
}

TEST_F(VehicleSessionTest, StoredRecordingsBeyondTheLimitAreDamage) {
  ASSERT_THAT(AppendNow(*session_, Recordings(1, kMost)), IsOk());
  CloseNow(*session_);
  const VehicleRecord record = *memory_.GetVehicle("truck");
  ASSERT_THAT(BlockingWrites(&memory_).Append(
                  record.key, {kMost + 1, 1, record.revision + 1,
                               Recordings(kMost + 1, 1)}),
              IsOk());
  session_ = Load("truck");
  const auto read = ReadNow(*session_);
  ASSERT_THAT(read, IsOk());
  EXPECT_THAT(read->damage, IsError(StatusCode::kDataLoss, "STORE_CORRUPT",
                                    HasSubstr("more recordings than")));
  EXPECT_EQ(read->durable_sequence, kMost);
}

TEST_F(VehicleSessionTest, RevisionMayTakeTheStartsOfRecordings) {
  ASSERT_THAT(AppendNow(*session_, StraightBatch(1, 5)), IsOk());
  ASSERT_THAT(AppendNow(*session_, RecordingBatch(6, 3)), IsOk());
  ASSERT_THAT(
      ReviseNow(*session_,
                [](const VehicleView&) {
                  RevisionPlan plan;
                  plan.batches = BatchesOf({{6, 3, 0, StraightBatch(6, 3)}});
                  plan.revised_count = 3;
                  return plan;
                }),
      IsOk());
  EXPECT_THAT(StartsOf(*session_), ElementsAre(1));
  // A pose that comes again is compared with what was sent.
  EXPECT_THAT(AppendNow(*session_, RecordingBatch(6, 3)), IsOk());
  EXPECT_THAT(AppendNow(*session_, StraightBatch(6, 3)),
              IsError(StatusCode::kAlreadyExists, _, _));
  Reload();
  EXPECT_THAT(StartsOf(*session_), ElementsAre(1));
}

}  // namespace
}  // namespace revisit::server
