#include <pthread.h>

#include <cstdint>
#include <string>

#include "gmock/gmock.h"
#include "gtest/gtest.h"
#include "tests/server/error_matchers.h"
#include "tests/server/sessions/session_testing.h"
#include "tests/server/sessions/vehicle_session_testing.h"
#include "tests/server/storage_testing.h"

namespace revisit::server {
namespace {

using absl::StatusCode;
using ::testing::_;
using ::testing::ElementsAre;
using ::testing::HasSubstr;

TEST_F(VehicleSessionTest, AddsPairOfEachKindOnce) {
  ASSERT_THAT(AppendNow(*session_, StraightBatch(1, 9)), IsOk());
  std::uint64_t revision = 2;
  for (const PairKind kind : {kClosure, kRejection}) {
    const PairWords words = WordsOf(kind);
    SCOPED_TRACE(words.noun);
    const std::uint64_t query = kind == kClosure ? 9 : 8;
    const auto added = AddPairNow(*session_, kind, {"a", query, 2, 77});
    ASSERT_THAT(added, IsOk());
    EXPECT_EQ(added->revision, ++revision);
    const auto again = AddPairNow(*session_, kind, {"a", query, 2, 99});
    ASSERT_THAT(again, IsOk());
    EXPECT_EQ(again->revision, revision);
    EXPECT_EQ(ToText(again->pair), ToText(added->pair));
    EXPECT_THAT(AddPairNow(*session_, kind, {"a", 9, 3, 0}),
                IsError(StatusCode::kAlreadyExists, words.exists,
                        std::string(words.noun) + " 'a' names sequences " +
                            std::to_string(query) + " and 2, got 9 and 3"));
  }
  const Snapshot snapshot = *ReadNow(*session_);
  EXPECT_EQ(snapshot.loop_closure_count, 1);
  EXPECT_EQ(snapshot.consistency.rejected, 1);
  EXPECT_THAT(snapshot.graph, HasSubstr("1 - 8"));
}

TEST_F(VehicleSessionTest, RepetitionByAnotherCallerAnswersWhatIsThere) {
  ASSERT_THAT(AppendNow(*session_, StraightBatch(1, 9)), IsOk());
  for (const PairKind kind : {kClosure, kRejection}) {
    const std::uint64_t query = kind == kClosure ? 9 : 8;
    const std::string said = "0 0 0 1";
    ASSERT_THAT(
        AddPairNow(*session_, kind, {"a", query, 2, 77, said + " by eva"}),
        IsOk());
    const auto again =
        AddPairNow(*session_, kind, {"a", query, 2, 99, said + " by tom"});
    ASSERT_THAT(again, IsOk());
    EXPECT_FALSE(again->is_new);
    EXPECT_EQ(again->pair.payload, said + " by eva");
    EXPECT_THAT(
        AddPairNow(*session_, kind, {"a", query, 2, 0, "1 0 0 1 by eva"}),
        IsError(absl::StatusCode::kAlreadyExists, WordsOf(kind).exists, _));
  }
}

TEST_F(VehicleSessionTest, RefusesPairThatIsOneOfTheOtherKind) {
  ASSERT_THAT(AppendNow(*session_, StraightBatch(1, 9)), IsOk());
  ASSERT_THAT(AddPairNow(*session_, kClosure, {"same", 9, 2, 0}), IsOk());
  ASSERT_THAT(AddPairNow(*session_, kRejection, {"other", 9, 3, 0}), IsOk());
  const absl::Status rejected =
      AddPairNow(*session_, kRejection, {"a", 9, 2, 0}).status();
  EXPECT_THAT(rejected,
              IsError(StatusCode::kFailedPrecondition, "POSE_PAIR_CONFLICT",
                      HasSubstr("are the loop closure 'same'")));
  EXPECT_EQ(MetadataOf(rejected, "name"), "vehicles/truck/loopClosures/same");
  const absl::Status closed =
      AddPairNow(*session_, kClosure, {"a", 9, 3, 0}).status();
  EXPECT_THAT(closed,
              IsError(StatusCode::kFailedPrecondition, "POSE_PAIR_CONFLICT",
                      HasSubstr("are the rejected candidate 'other'")));
  EXPECT_EQ(MetadataOf(closed, "name"),
            "vehicles/truck/rejectedCandidates/other");
  EXPECT_EQ(ReadNow(*session_)->loop_closure_count, 1);
  // Undone, it is free. The same pair twice under other names never conflicts.
  ASSERT_THAT(DeletePairNow(*session_, kClosure, "same"), IsOk());
  EXPECT_THAT(AddPairNow(*session_, kRejection, {"a", 9, 2, 0}), IsOk());
  EXPECT_THAT(AddPairNow(*session_, kRejection, {"b", 9, 2, 0}), IsOk());
}

TEST_F(VehicleSessionTest, PairOfBothKindsFromAnOlderServerStaysAsItIs) {
  ASSERT_THAT(AppendNow(*session_, StraightBatch(1, 9)), IsOk());
  const VehicleKey key = memory_.GetVehicle("truck")->key;
  BlockingWrites write(&memory_);
  ASSERT_THAT(write.AddPair(key, kClosure, {"a", 9, 2, 1}, 3), IsOk());
  ASSERT_THAT(write.AddPair(key, kRejection, {"a", 9, 2, 2}, 4), IsOk());
  Reload();
  EXPECT_EQ(ReadNow(*session_)->loop_closure_count, 1);
  EXPECT_EQ(ReadNow(*session_)->consistency.rejected, 1);
  EXPECT_THAT(AddPairNow(*session_, kClosure, {"a", 9, 2, 0}), IsOk());
  EXPECT_THAT(AddPairNow(*session_, kRejection, {"a", 9, 2, 0}), IsOk());
}

TEST_F(VehicleSessionTest,
       MeasuredClosureIsComparedWholeAndAgreesWithTheGraph) {
  ASSERT_THAT(AppendNow(*session_, StraightBatch(1, 9)), IsOk());
  // 7 m apart, as they are estimated; and 2 m more than that.
  PosePairRecord right{"a", 9, 2, 0, "7 0 0 0.5"};
  const auto added = AddPairNow(*session_, kClosure, right);
  ASSERT_THAT(added, IsOk());
  ASSERT_TRUE(added->agreement);
  EXPECT_NEAR(added->agreement->squared_mahalanobis, 0.0, 1e-9);
  EXPECT_NEAR(added->agreement->p_value, 1.0, 1e-6);
  const auto again = AddPairNow(*session_, kClosure, right);
  ASSERT_THAT(again, IsOk());
  EXPECT_EQ(again->revision, added->revision);
  EXPECT_TRUE(again->agreement);
  for (const char* const other : {"7 0 0 0.25", ""}) {
    EXPECT_THAT(AddPairNow(*session_, kClosure, {"a", 9, 2, 0, other}),
                IsError(StatusCode::kAlreadyExists, "LOOP_CLOSURE_EXISTS",
                        HasSubstr("another measurement")));
  }
  const auto off = AddPairNow(*session_, kClosure, {"b", 8, 1, 0, "9 0 0 0.5"});
  ASSERT_THAT(off, IsOk());
  // Beside the measurement's variance of 0.25, the metres between the poses
  // count as those of a usual odometer.
  EXPECT_NEAR(off->agreement->squared_mahalanobis, 4.0 / 0.273, 0.1);
  EXPECT_FALSE(AddPairNow(*session_, kClosure, {"c", 7, 1, 0, ""})->agreement);
}

TEST_F(VehicleSessionTest, MeasurementsComeOutTheSameWheneverTheGraphIsMade) {
  ASSERT_THAT(AppendNow(*session_, SquareBatch(1, 200)), IsOk());
  ASSERT_THAT(AddPairNow(*session_, kClosure, {"a", 90, 10, 1, "0 1 0 0.2"}),
              IsOk());
  ASSERT_THAT(AddPairNow(*session_, kClosure, {"b", 171, 10, 2, "1 2 0.1 1"}),
              IsOk());
  const core::Consistency before = ReadNow(*session_)->consistency;
  const auto expect_same = [&] {
    const core::Consistency after = ReadNow(*session_)->consistency;
    EXPECT_EQ(after.mean_normalized_innovation_squared,
              before.mean_normalized_innovation_squared);
    EXPECT_EQ(after.inflation, before.inflation);
  };
  Reload();
  expect_same();
  // A change that makes the graph anew, there and back.
  for (const double spacing : {2.0, TestConfig().drive.node_spacing_meters}) {
    ASSERT_THAT(UpdateNow(*session_,
                          [&](const VehicleView& view) {
                            VehicleConfig config = view.config;
                            config.drive.node_spacing_meters = spacing;
                            return config;
                          }),
                IsOk());
  }
  expect_same();
}

TEST_F(VehicleSessionTest, PairThatDoesNotDecodeIsDamage) {
  ASSERT_THAT(AppendNow(*session_, StraightBatch(1, 9)), IsOk());
  const VehicleKey key = memory_.GetVehicle("truck")->key;
  for (const PairKind kind : {kClosure, kRejection}) {
    ASSERT_THAT(BlockingWrites(&memory_).AddPair(
                    key, kind, {"a", 9, 2, 1, "no measurement"}, 3),
                IsOk());
    Reload();
    EXPECT_THAT(AppendNow(*session_, StraightBatch(10, 1)),
                IsError(StatusCode::kDataLoss, "STORE_CORRUPT",
                        HasSubstr(std::string(WordsOf(kind).noun) +
                                  " 'a' does not decode")));
    ASSERT_THAT(BlockingWrites(&memory_).DeletePair(key, kind, "a", 4), IsOk());
  }
}

TEST_F(VehicleSessionTest, RefusesPairWithPoseThatIsNotThere) {
  EXPECT_THAT(
      AddPairNow(*session_, kClosure, {"a", 2, 1, 0}).status(),
      IsError(StatusCode::kNotFound, "POSE_NOT_FOUND",
              "vehicle 'truck' has no pose of sequence 2, it has none yet"));
  ASSERT_THAT(AppendNow(*session_, StraightBatch(1, 9)), IsOk());
  for (const PairKind kind : {kClosure, kRejection}) {
    const absl::Status status =
        AddPairNow(*session_, kind, {"a", 10, 2, 0}).status();
    EXPECT_THAT(status, IsError(StatusCode::kNotFound, "POSE_NOT_FOUND",
                                "vehicle 'truck' has no pose of sequence 10, "
                                "it has 1 to 9"));
    EXPECT_EQ(MetadataOf(status, "sequence"), "10");
  }
}

TEST_F(VehicleSessionTest, DeletesPairOfEachKind) {
  ASSERT_THAT(AppendNow(*session_, StraightBatch(1, 9)), IsOk());
  const std::string graph = ReadNow(*session_)->graph;
  std::uint64_t revision = 2;
  for (const PairKind kind : {kClosure, kRejection}) {
    const PairWords words = WordsOf(kind);
    SCOPED_TRACE(words.noun);
    ASSERT_THAT(AddPairNow(*session_, kind, {"a", 9, 2, 0}), IsOk());
    const auto deleted = DeletePairNow(*session_, kind, "a");
    ASSERT_THAT(deleted, IsOk());
    revision += 2;
    EXPECT_EQ(*deleted, revision);
    EXPECT_EQ(ReadNow(*session_)->graph, graph);
    EXPECT_EQ(ReadNow(*session_)->revision, revision);
    EXPECT_EQ(ReadNow(*session_)->consistency.rejected, 0);
    EXPECT_THAT(
        DeletePairNow(*session_, kind, "a"),
        IsError(StatusCode::kNotFound, words.not_found,
                "vehicle 'truck' has no " + std::string(words.noun) + " 'a'"));
  }
}

TEST_F(VehicleSessionTest, KeepsDeletedPairsWithWhoDeletedThem) {
  for (const std::uint64_t first : {1, 4, 7}) {
    ASSERT_THAT(AppendNow(*session_, StraightBatch(first, 3)), IsOk());
  }
  const VehicleKey key = memory_.GetVehicle("truck")->key;
  ASSERT_THAT(
      AddPairNow(*session_, kClosure, {"a", 9, 2, 50, "0 0 0 1 by eva"}),
      IsOk());
  ASSERT_THAT(AddPairNow(*session_, kRejection, {"a", 8, 3, 60, "0 0 0 1"}),
              IsOk());
  EXPECT_THAT(DeletePairNow(*session_, kRejection, "a", {70, "tom"}), IsOk());
  EXPECT_THAT(DeletePairNow(*session_, kRejection, "a", {75, "tom"}),
              IsError(StatusCode::kNotFound, _, _));
  EXPECT_THAT(DeletePairNow(*session_, kClosure, "a", {80, "ida"}), IsOk());
  // Neither a new pair of the id nor a new graph changes them.
  ASSERT_THAT(AddPairNow(*session_, kClosure, {"a", 9, 1, 90}), IsOk());
  ASSERT_THAT(ReviseNow(*session_, ShiftSecondBatch).status(), IsOk());
  Reload();
  EXPECT_THAT(ReadNow(*session_)->damage, IsOk());
  EXPECT_THAT(
      ToTexts(*memory_.ListDeletedPairs(key)),
      ElementsAre("2, closure a: 9 at 2, 50 ns, '0 0 0 1 by eva undone by "
                  "ida', deleted at 80 ns",
                  "1, rejected a: 8 at 3, 60 ns, '0 0 0 1 undone by tom', "
                  "deleted at 70 ns"));
}

TEST_F(VehicleSessionTest, DamageOfADeletedPairIsFoundAndGivenUp) {
  ASSERT_THAT(AppendNow(*session_, StraightBatch(1, 9)), IsOk());
  const VehicleKey key = memory_.GetVehicle("truck")->key;
  for (const char* const id : {"a", "b"}) {
    ASSERT_THAT(AddPairNow(*session_, kClosure, {id, 9, 2, 0}), IsOk());
    ASSERT_THAT(DeletePairNow(*session_, kClosure, id), IsOk());
  }
  memory_.DamageDeletedPair("truck");
  Reload();
  EXPECT_THAT(ReadNow(*session_)->damage,
              IsError(StatusCode::kDataLoss, "STORE_CORRUPT", _));
  ASSERT_THAT(AcceptDataLossNow(*session_, 9).status(), IsOk());
  Reload();
  EXPECT_THAT(ReadNow(*session_)->damage, IsOk());
  EXPECT_EQ(ReadNow(*session_)->durable_sequence, 9u);
  EXPECT_EQ(memory_.ListDeletedPairs(key)->size(), 1u);
}

TEST_F(VehicleSessionTest, LooksAtManyLoopClosuresWhereLongWorkRuns) {
  CloseNow(*session_);
  Executor short_work("short", 1);
  Executor long_work("long", 1);
  session_ = VehicleSession::Load("truck", &storage_, &codec_,
                                  Lanes(&short_work, &long_work), limits_);
  ASSERT_THAT(AppendNow(*session_, SquareBatch(1, 99)), IsOk());
  const auto thread_of_delete = [this](const std::string& id) {
    const Answer<std::string> thread;
    session_->DeletePosePair(
        kClosure, id, {}, [&](const absl::StatusOr<std::uint64_t>& revision) {
          EXPECT_THAT(revision.status(), IsOk());
          char name[16] = "";
          pthread_getname_np(pthread_self(), name, sizeof(name));
          thread.Set(name);
        });
    return thread.Get();
  };
  for (int i = 0; i < 600; ++i) {
    const std::string id = "c" + std::to_string(i);
    ASSERT_THAT(AddPairNow(*session_, kClosure, {id, 82, 2, i + 1}).status(),
                IsOk());
    if (i == 99) {
      EXPECT_EQ(thread_of_delete(id), "short");
    }
  }
  EXPECT_EQ(thread_of_delete("c0"), "long");
  const Answer<std::string> thread;
  session_->Update(
      [](const VehicleView& view) {
        VehicleConfig config = view.config;
        config.drive.apply_inflation = true;
        return config;
      },
      [&](const absl::StatusOr<VehicleView>& view) {
        EXPECT_THAT(view.status(), IsOk());
        char name[16] = "";
        pthread_getname_np(pthread_self(), name, sizeof(name));
        thread.Set(name);
      });
  EXPECT_EQ(thread.Get(), "long");
  EXPECT_EQ(ReadNow(*session_)->loop_closure_count, 598);
  CloseNow(*session_);
  session_ = nullptr;
}

TEST_F(VehicleSessionTest, RejectionChangesNoGraph) {
  ASSERT_THAT(AppendNow(*session_, StraightBatch(1, 9)), IsOk());
  const std::string graph = ReadNow(*session_)->graph;
  ASSERT_THAT(AddPairNow(*session_, kRejection, {"a", 9, 2, 0}), IsOk());
  EXPECT_EQ(ReadNow(*session_)->graph, graph);
  EXPECT_EQ(ReadNow(*session_)->loop_closure_count, 0);
  Reload();
  EXPECT_EQ(ReadNow(*session_)->graph, graph);
  EXPECT_EQ(ReadNow(*session_)->consistency.rejected, 1);
}

TEST_F(VehicleSessionTest, CreationTimesTellTheOrderEvenIfTheClockGoesBack) {
  ASSERT_THAT(AppendNow(*session_, StraightBatch(1, 9)), IsOk());
  EXPECT_EQ(
      AddPairNow(*session_, kClosure, {"c", 9, 2, 500})->pair.create_time_ns,
      500);
  EXPECT_EQ(
      AddPairNow(*session_, kRejection, {"b", 9, 3, 500})->pair.create_time_ns,
      501);
  Reload();
  EXPECT_EQ(
      AddPairNow(*session_, kClosure, {"a", 9, 1, 7})->pair.create_time_ns,
      502);
  EXPECT_EQ(
      AddPairNow(*session_, kRejection, {"a", 8, 1, 503})->pair.create_time_ns,
      503);
  const VehicleKey key = memory_.GetVehicle("truck")->key;
  EXPECT_THAT(ToTexts(*memory_.ListPosePairs(key, kClosure, "", 9)),
              ElementsAre("a: 9 at 1, 502 ns", "c: 9 at 2, 500 ns"));
  EXPECT_THAT(ToTexts(*memory_.ListPosePairs(key, kRejection, "", 9)),
              ElementsAre("a: 8 at 1, 503 ns", "b: 9 at 3, 501 ns"));
}

TEST_F(VehicleSessionTest, NeverShowsRejectionThatIsNotDurable) {
  ASSERT_THAT(AppendNow(*session_, StraightBatch(1, 9)), IsOk());
  storage_.Hold();
  const Answer<absl::StatusOr<AddedPair>> rejected;
  session_->AddPosePair(kRejection, {"a", 9, 2, 0}, {}, rejected.Setter());
  storage_.Await(1);
  EXPECT_EQ(ReadNow(*session_)->consistency.rejected, 0);
  storage_.FailOne(DeviceFailure());
  EXPECT_THAT(rejected.Get(),
              IsError(StatusCode::kUnavailable, "STORE_UNAVAILABLE", _));
  EXPECT_EQ(ReadNow(*session_)->consistency.rejected, 0);
  storage_.ReleaseAll();
  EXPECT_EQ(AddPairNow(*session_, kRejection, {"a", 9, 2, 0})->revision, 3u);
  EXPECT_EQ(ReadNow(*session_)->consistency.rejected, 1);
}

TEST_F(VehicleSessionTest, LoadsAnewIfTheStoreHasOneRejectionMore) {
  // Written, though the storage said otherwise, by way of a revision that the
  // session has too: only the count tells.
  ASSERT_THAT(AppendNow(*session_, StraightBatch(1, 9)), IsOk());
  const VehicleKey key = memory_.GetVehicle("truck")->key;
  storage_.Hold();
  const Answer<absl::StatusOr<AddedPair>> rejected;
  session_->AddPosePair(kRejection, {"a", 9, 2, 0}, {}, rejected.Setter());
  storage_.Await(1);
  storage_.FailOne(DeviceFailure());
  EXPECT_THAT(rejected.Get(),
              IsError(StatusCode::kUnavailable, "STORE_UNAVAILABLE", _));
  ASSERT_THAT(
      BlockingWrites(&memory_).AddPair(key, kRejection, {"a", 9, 2, 0}, 2),
      IsOk());
  storage_.ReleaseAll();
  EXPECT_THAT(AppendNow(*session_, StraightBatch(10, 1)),
              IsError(StatusCode::kUnavailable, "STORE_UNAVAILABLE",
                      HasSubstr("has to be loaded anew")));
  EXPECT_TRUE(session_->gone());
}

TEST_F(VehicleSessionTest, TakesAsManyPairsAsItMay) {
  limits_.max_pose_pairs = 2;
  Reload();
  ASSERT_THAT(AppendNow(*session_, StraightBatch(1, 9)), IsOk());
  for (const PairKind kind : {kClosure, kRejection}) {
    const std::uint64_t query = kind == kClosure ? 9 : 8;
    ASSERT_THAT(AddPairNow(*session_, kind, {"a", query, 1, 0}), IsOk());
    ASSERT_THAT(AddPairNow(*session_, kind, {"b", query, 2, 0}), IsOk());
    const absl::Status full =
        AddPairNow(*session_, kind, {"c", query, 3, 0}).status();
    EXPECT_THAT(full,
                IsError(StatusCode::kFailedPrecondition, "POSE_PAIR_LIMIT",
                        HasSubstr("has 2 " + std::string(WordsOf(kind).noun))));
    EXPECT_EQ(MetadataOf(full, "limit"), "2");
    // Those that are there are answered again.
    EXPECT_THAT(AddPairNow(*session_, kind, {"b", query, 2, 0}), IsOk());
    ASSERT_THAT(DeletePairNow(*session_, kind, "a"), IsOk());
    EXPECT_THAT(AddPairNow(*session_, kind, {"c", query, 3, 0}), IsOk());
  }
}

// ---- Damage

}  // namespace
}  // namespace revisit::server
