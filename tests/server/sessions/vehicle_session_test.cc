#include "server/sessions/vehicle_session.h"

#include <algorithm>
#include <chrono>
#include <cstdint>
#include <functional>
#include <memory>
#include <mutex>
#include <random>
#include <string>
#include <thread>
#include <utility>
#include <vector>

#include "core/drive/findings.h"
#include "core/settings.h"
#include "gmock/gmock.h"
#include "gtest/gtest.h"
#include "server/base/status.h"
#include "server/storage/sqlite/sqlite_storage.h"
#include "tests/random.h"
#include "tests/server/error_matchers.h"
#include "tests/server/sessions/session_testing.h"
#include "tests/server/sessions/vehicle_session_testing.h"
#include "tests/server/storage_testing.h"
#include "tests/server/temporary_directory.h"

namespace revisit::server {
namespace {

using absl::StatusCode;
using ::testing::_;
using ::testing::AllOf;
using ::testing::ElementsAre;
using ::testing::HasSubstr;
using ::testing::IsEmpty;

TEST_F(VehicleSessionTest, AnswersNotFoundToAllCallsOfUnknownVehicle) {
  const std::shared_ptr<VehicleSession> unknown = Load("ghost");
  const auto not_found =
      IsError(StatusCode::kNotFound, "VEHICLE_NOT_FOUND", HasSubstr("'ghost'"));
  EXPECT_THAT(ReadNow(*unknown), not_found);
  EXPECT_THAT(CheckAcknowledgedNow(*unknown, 0), not_found);
  EXPECT_THAT(CheckAcknowledgedNow(*unknown, 9), not_found);
  EXPECT_THAT(AcceptDataLossNow(*unknown, 0), not_found);
  const auto change = [](const VehicleView&) {
    ADD_FAILURE();
    return TestConfig();
  };
  EXPECT_THAT(UpdateNow(*unknown, change), not_found);
  EXPECT_THAT(ReviseNow(*unknown,
                        [](const VehicleView&) {
                          ADD_FAILURE();
                          return RevisionPlan();
                        }),
              not_found);
  for (const PairKind kind : {kClosure, kRejection}) {
    EXPECT_THAT(AddPairNow(*unknown, kind, {"a", 2, 1, 0}), not_found);
    EXPECT_THAT(DeletePairNow(*unknown, kind, "a"), not_found);
  }
  EXPECT_THAT(DeleteNow(*unknown), not_found);
  const Appended appended = Append(*unknown, StraightBatch(1, 1));
  EXPECT_THAT(appended.staged.Get(), not_found);
  EXPECT_THAT(appended.durable.Get(), not_found);
  EXPECT_TRUE(unknown->gone());
}

TEST_F(VehicleSessionTest, AcknowledgesAndAppliesBatches) {
  const auto first = AppendNow(*session_, StraightBatch(1, 3));
  ASSERT_THAT(first, IsOk());
  EXPECT_EQ(first->durable_sequence, 3u);
  EXPECT_EQ(first->revision, 2u);
  EXPECT_THAT(first->jumps, IsEmpty());
  const auto second = AppendNow(*session_, StraightBatch(4, 2));
  EXPECT_EQ(second->durable_sequence, 5u);
  EXPECT_EQ(second->revision, 3u);
  const absl::StatusOr<Snapshot> read = ReadNow(*session_);
  EXPECT_EQ(read->durable_sequence, 5u);
  EXPECT_EQ(read->revision, 3u);
  EXPECT_EQ(read->node_count, 5);
  EXPECT_EQ(memory_.GetVehicle("truck")->revision, 3u);
}

// An acknowledgement that got lost is given again when the batch is, but it
// lacked the jumps.
TEST_F(VehicleSessionTest, ReportsJumpsOfResentBatchAgain) {
  const auto jumps = [&](const std::string& batch) {
    const auto ack = AppendNow(*session_, batch);
    EXPECT_THAT(ack, IsOk());
    std::vector<std::pair<std::uint64_t, double>> found;
    for (const core::Jump& jump : ack->jumps) {
      found.emplace_back(jump.sequence, jump.distance_meters);
    }
    return found;
  };
  const auto first = ElementsAre(std::pair(3u, 500.0));
  const auto both = ElementsAre(std::pair(3u, 500.0), std::pair(6u, 1000.0));
  const std::string batch = PlainBatch(1, {0, 1, 501, 502});
  EXPECT_THAT(jumps(batch), first);
  for (int i = 0; i < 2; ++i) {
    EXPECT_THAT(jumps(batch), first);
    EXPECT_THAT(jumps(PlainBatch(3, {501})), first);
    EXPECT_THAT(jumps(PlainBatch(4, {502})), IsEmpty());
    Reload();
  }
  // Partly new.
  EXPECT_THAT(jumps(PlainBatch(2, {1, 501, 502, 503, 1503})), both);
  EXPECT_THAT(jumps(PlainBatch(4, {502, 503, 1503, 1504})),
              ElementsAre(std::pair(6u, 1000.0)));
}

TEST_F(VehicleSessionTest, ShowsNothingBeforeItIsDurable) {
  storage_.Hold();
  const Appended appended = Append(*session_, StraightBatch(1, 3));
  EXPECT_THAT(appended.staged.Get(), IsOk());
  storage_.Await(1);
  const absl::StatusOr<Snapshot> read = ReadNow(*session_);
  EXPECT_EQ(read->durable_sequence, 0u);
  EXPECT_EQ(read->revision, 1u);
  EXPECT_EQ(read->node_count, 0);
  EXPECT_FALSE(appended.durable.IsSet());
  storage_.ReleaseOne();
  EXPECT_EQ(appended.durable.Get()->durable_sequence, 3u);
}

TEST_F(VehicleSessionTest, SendsAppendsToTheStorageWithoutWaitingForEachOther) {
  storage_.Hold();
  std::vector<Appended> appended;
  for (std::uint64_t i = 0; i < 5; ++i) {
    appended.push_back(Append(*session_, StraightBatch(2 * i + 1, 2)));
  }
  storage_.Await(5);
  storage_.ReleaseAll();
  for (std::uint64_t i = 0; i < 5; ++i) {
    EXPECT_EQ(appended[i].durable.Get()->durable_sequence, 2 * i + 2);
    EXPECT_EQ(appended[i].durable.Get()->revision, i + 2);
  }
}

// The results of appends of so many poses each, the results of which come while
// the strand is at work: "answered" and "over", each with the last sequence.
class AppendsTogetherTest : public VehicleSessionTest {
 protected:
  std::vector<std::string> EndsOf(const std::vector<std::uint64_t>& counts) {
    storage_.Hold();
    std::vector<std::string> ends;
    const Answer<bool> all_over;
    std::uint64_t next = 1;
    for (const std::uint64_t count : counts) {
      auto append = std::make_shared<PlainAppend>(StraightBatch(next, count));
      next += count;
      const std::string last = std::to_string(next - 1);
      append->durable = [&ends, last](const auto& result) {
        EXPECT_THAT(result, IsOk());
        ends.push_back("answered " + last);
      };
      append->over = [&ends, last, all_over, &counts] {
        ends.push_back("over " + last);
        if (ends.size() == 2 * counts.size()) all_over.Set(true);
      };
      session_->Append(append->Request(), append);
    }
    storage_.Await(counts.size());
    session_->Read(
        [this](const absl::StatusOr<VehicleView>&) { storage_.ReleaseAll(); });
    all_over.Get();
    return ends;
  }
};

TEST_F(AppendsTogetherTest, ThoseThatLandTogetherAreAnsweredBeforeOneIsOver) {
  EXPECT_THAT(EndsOf({2, 3, 1}),
              ElementsAre("answered 2", "answered 5", "answered 6", "over 2",
                          "over 5", "over 6"));
}

TEST_F(AppendsTogetherTest, LongOnesAreOverBeforeOthersAreAnswered) {
  EXPECT_THAT(EndsOf({1000, 24, 1}),
              ElementsAre("answered 1000", "answered 1024", "over 1000",
                          "over 1024", "answered 1025", "over 1025"));
}

TEST_F(VehicleSessionTest, AcknowledgesSamePosesAgain) {
  ASSERT_THAT(AppendNow(*session_, StraightBatch(1, 3)), IsOk());
  ASSERT_THAT(AppendNow(*session_, StraightBatch(4, 3)), IsOk());
  for (const std::string& batch :
       {StraightBatch(1, 3), StraightBatch(4, 3), StraightBatch(1, 6),
        StraightBatch(3, 2), StraightBatch(2, 1)}) {
    const auto ack = AppendNow(*session_, batch);
    ASSERT_THAT(ack, IsOk());
    EXPECT_EQ(ack->durable_sequence, 6u);
    EXPECT_EQ(ack->revision, 3u);
  }
  EXPECT_EQ(Stored().size(), 2u);
}

TEST_F(VehicleSessionTest, RefusesOtherContentOfStoredPoses) {
  ASSERT_THAT(AppendNow(*session_, StraightBatch(1, 3)), IsOk());
  ASSERT_THAT(AppendNow(*session_, StraightBatch(4, 3)), IsOk());
  const std::vector<std::pair<std::string, std::string>> cases = {
      {PlainBatch(1, {1, 2, 3.0000000000000004}), "3"},
      {PlainBatch(2, {7, 7, 7}), "2"},
      {PlainBatch(5, {5, -0.0}), "6"},
      // Would go on with new ones, but none is stored.
      {PlainBatch(6, {6.5, 7, 8}), "6"},
  };
  for (const auto& [batch, sequence] : cases) {
    const absl::Status status = AppendNow(*session_, batch).status();
    EXPECT_THAT(
        status,
        IsError(StatusCode::kAlreadyExists, "SEQUENCE_CONTENT_MISMATCH",
                AllOf(HasSubstr("'truck'"),
                      HasSubstr("sequence " + sequence + " is stored"))));
    EXPECT_EQ(MetadataOf(status, "sequence"), sequence);
  }
  EXPECT_EQ(ReadNow(*session_)->durable_sequence, 6u);
}

TEST_F(VehicleSessionTest, StoresTheRestOfBatchThatBeginsWithStoredPoses) {
  ASSERT_THAT(AppendNow(*session_, StraightBatch(1, 3)), IsOk());
  const auto ack = AppendNow(*session_, StraightBatch(2, 4));
  ASSERT_THAT(ack, IsOk());
  EXPECT_EQ(ack->durable_sequence, 5u);
  EXPECT_THAT(Stored(),
              ElementsAre("1+3, revision 2, '" + StraightBatch(1, 3) + "'",
                          "4+2, revision 3, '" + StraightBatch(4, 2) + "'"));
  EXPECT_EQ(ReadNow(*session_)->node_count, 5);
}

TEST_F(VehicleSessionTest, JudgesResentPosesOnlyWhenTheFirstHaveLanded) {
  storage_.Hold();
  const Appended first = Append(*session_, StraightBatch(1, 3));
  const Appended again = Append(*session_, StraightBatch(1, 4));
  const Appended other = Append(*session_, PlainBatch(2, {9}));
  const Appended behind = Append(*session_, StraightBatch(5, 1));
  storage_.Await(1);
  ASSERT_THAT(ReadNow(*session_), IsOk());
  EXPECT_EQ(storage_.held(), 1u);
  EXPECT_FALSE(again.staged.IsSet());
  EXPECT_FALSE(behind.staged.IsSet());
  storage_.ReleaseAll();
  EXPECT_EQ(first.durable.Get()->durable_sequence, 3u);
  EXPECT_EQ(again.durable.Get()->durable_sequence, 4u);
  EXPECT_THAT(other.durable.Get(),
              IsError(StatusCode::kAlreadyExists, "SEQUENCE_CONTENT_MISMATCH",
                      HasSubstr("sequence 2")));
  EXPECT_EQ(behind.durable.Get()->durable_sequence, 5u);
}

TEST_F(VehicleSessionTest, ResentPosesTakeThePlaceOfThoseThatWereNotWritten) {
  storage_.Hold();
  const Appended first = Append(*session_, StraightBatch(1, 3));
  const Appended again = Append(*session_, StraightBatch(1, 3));
  storage_.FailOne(DeviceFailure());
  EXPECT_THAT(first.durable.Get(),
              IsError(StatusCode::kUnavailable, "STORE_UNAVAILABLE", _));
  storage_.ReleaseOne();
  EXPECT_EQ(again.durable.Get()->durable_sequence, 3u);
}

TEST_F(VehicleSessionTest, RefusesGapWithExpectedSequence) {
  const auto expect_gap = [&](const std::string& batch,
                              const std::string& expected) {
    const absl::Status status = AppendNow(*session_, batch).status();
    EXPECT_THAT(status, IsError(StatusCode::kFailedPrecondition, "SEQUENCE_GAP",
                                HasSubstr("expected " + expected)));
    EXPECT_EQ(MetadataOf(status, "expected_sequence"), expected);
  };
  expect_gap(StraightBatch(2, 3), "1");
  ASSERT_THAT(AppendNow(*session_, StraightBatch(1, 3)), IsOk());
  expect_gap(StraightBatch(5, 1), "4");
  // Those in flight count as well.
  storage_.Hold();
  const Appended in_flight = Append(*session_, StraightBatch(4, 3));
  const Appended gap = Append(*session_, StraightBatch(8, 1));
  EXPECT_THAT(gap.staged.Get(),
              IsError(StatusCode::kFailedPrecondition, "SEQUENCE_GAP",
                      HasSubstr("from sequence 8, expected 7")));
}

TEST_F(VehicleSessionTest, AnswersRefusedAppendBehindThoseBeforeIt) {
  storage_.Hold();
  const Appended good = Append(*session_, StraightBatch(1, 3));
  const Appended bad = Append(*session_, "nonsense\n");
  EXPECT_THAT(bad.staged.Get(), IsError(StatusCode::kDataLoss, _, _));
  ASSERT_THAT(ReadNow(*session_), IsOk());
  EXPECT_FALSE(bad.durable.IsSet());
  storage_.ReleaseAll();
  EXPECT_THAT(bad.durable.Get(), IsError(StatusCode::kDataLoss, _, _));
  EXPECT_TRUE(good.durable.IsSet());
}

TEST_F(VehicleSessionTest, RefusesSequencesThatDoNotFollowEachOther) {
  EXPECT_THAT(AppendNow(*session_, ""),
              IsError(StatusCode::kInvalidArgument, "BATCH_SIZE", _));
  EXPECT_THAT(AppendNow(*session_, PlainBatch(0, {1})),
              IsError(StatusCode::kInvalidArgument, "INVALID_FIELD",
                      "poses[0].sequence: got 0; allowed is at least 1"));
  EXPECT_THAT(AppendNow(*session_, PlainBatch(1, {1, 2}) + PlainBatch(4, {4})),
              IsError(StatusCode::kInvalidArgument, "INVALID_FIELD",
                      HasSubstr("poses[2].sequence: got 4")));
}

TEST_F(VehicleSessionTest, FailedWriteFailsThoseBehindAndThenGoesOn) {
  ASSERT_THAT(AppendNow(*session_, StraightBatch(1, 2)), IsOk());
  storage_.Hold();
  std::vector<Appended> appended;
  for (std::uint64_t i = 1; i < 5; ++i) {
    appended.push_back(Append(*session_, StraightBatch(2 * i + 1, 2)));
  }
  storage_.ReleaseOne();
  storage_.FailOne(DeviceFailure());
  EXPECT_EQ(appended[0].durable.Get()->durable_sequence, 4u);
  EXPECT_THAT(appended[1].durable.Get(),
              IsError(StatusCode::kUnavailable, "STORE_UNAVAILABLE",
                      HasSubstr("device is broken")));
  // This one cannot be judged before all that were in flight have landed.
  const Appended later = Append(*session_, StraightBatch(11, 2));
  ASSERT_THAT(ReadNow(*session_), IsOk());
  EXPECT_FALSE(later.staged.IsSet());
  storage_.ReleaseAll();
  for (std::size_t i = 2; i < appended.size(); ++i) {
    EXPECT_THAT(appended[i].durable.Get(),
                IsError(StatusCode::kUnavailable, "STORE_UNAVAILABLE",
                        HasSubstr("device is broken")));
  }
  EXPECT_EQ(MetadataOf(later.durable.Get().status(), "expected_sequence"), "5");
  const auto ack = AppendNow(*session_, StraightBatch(5, 2));
  EXPECT_EQ(ack->durable_sequence, 6u);
  // Revisions of what was never stored are used again.
  EXPECT_EQ(ack->revision, 4u);
  EXPECT_FALSE(session_->gone());
}

TEST_F(VehicleSessionTest, LoadsAnewWhenFailedWriteIsFoundStored) {
  storage_.Hold();
  const Appended appended = Append(*session_, StraightBatch(1, 2));
  storage_.PassOnAndFailOne(DeviceFailure());
  EXPECT_THAT(appended.durable.Get(),
              IsError(StatusCode::kUnavailable, "STORE_UNAVAILABLE", _));
  storage_.ReleaseAll();
  EXPECT_THAT(AppendNow(*session_, StraightBatch(1, 2)),
              IsError(StatusCode::kUnavailable, "STORE_UNAVAILABLE",
                      HasSubstr("loaded anew")));
  EXPECT_TRUE(session_->gone());
  session_ = Load("truck");
  EXPECT_EQ(AppendNow(*session_, StraightBatch(1, 2))->durable_sequence, 2u);
}

TEST_F(VehicleSessionTest, AsksTheStoreAgainBeforeWritingAfterFailure) {
  storage_.Hold();
  const Appended appended = Append(*session_, StraightBatch(1, 2));
  storage_.FailOne(DeviceFailure());
  EXPECT_FALSE(appended.durable.Get().ok());
  storage_.ReleaseAll();
  storage_.FailReads(DeviceFailure());
  EXPECT_THAT(AppendNow(*session_, StraightBatch(1, 2)),
              IsError(StatusCode::kUnavailable, "STORE_UNAVAILABLE",
                      "the device is broken"));
  // Reading what is in memory needs no store.
  EXPECT_THAT(ReadNow(*session_), IsOk());
  storage_.FailReads(absl::OkStatus());
  EXPECT_THAT(AppendNow(*session_, StraightBatch(1, 2)), IsOk());
}

TEST_F(VehicleSessionTest, RefusesMoreAppendsThanMayWait) {
  limits_.max_pending_appends = 3;
  Reload();
  ASSERT_THAT(ReadNow(*session_), IsOk());
  storage_.Hold();
  std::vector<Appended> appended;
  for (std::uint64_t i = 1; i <= 3; ++i) {
    appended.push_back(Append(*session_, StraightBatch(i, 1)));
  }
  const Appended full = Append(*session_, StraightBatch(4, 1));
  const auto queue_full = IsError(StatusCode::kResourceExhausted, "QUEUE_FULL",
                                  HasSubstr("3 batches"));
  EXPECT_THAT(full.staged.Get(), queue_full);
  EXPECT_THAT(full.durable.Get(), queue_full);
  storage_.ReleaseOne();
  EXPECT_THAT(appended[0].durable.Get(), IsOk());
  const Appended fits = Append(*session_, StraightBatch(4, 1));
  storage_.ReleaseAll();
  EXPECT_EQ(fits.durable.Get()->durable_sequence, 4u);
}

TEST_F(VehicleSessionTest, ChangeWaitsForAppendsAndHoldsUpThoseBehind) {
  ASSERT_THAT(AppendNow(*session_, StraightBatch(1, 9)), IsOk());
  storage_.Hold();
  const Appended before = Append(*session_, StraightBatch(10, 1));
  const Answer<absl::StatusOr<AddedPair>> closed;
  session_->AddPosePair(kClosure, {"a", 10, 1, 0}, {}, closed.Setter());
  const Appended behind = Append(*session_, StraightBatch(11, 1));
  storage_.Await(1);
  ASSERT_THAT(ReadNow(*session_), IsOk());
  EXPECT_EQ(storage_.held(), 1u);
  storage_.ReleaseOne();
  // The closure names the pose that was in flight when it came.
  storage_.Await(1);
  EXPECT_TRUE(before.durable.IsSet());
  ASSERT_THAT(ReadNow(*session_), IsOk());
  EXPECT_EQ(storage_.held(), 1u);
  EXPECT_FALSE(behind.staged.IsSet());
  storage_.ReleaseAll();
  EXPECT_EQ(closed.Get()->revision, 4u);
  EXPECT_EQ(behind.durable.Get()->revision, 5u);
}

// Appends with checks, and says in which order what was answered.
class CheckedAppend {
 public:
  using Options = absl::StatusOr<core::SearchOptions>(const VehicleConfig&);

  CheckedAppend(VehicleSession& session, const std::string& payload,
                const std::function<Options>& options = nullptr,
                const std::function<bool()>& should_stop = nullptr) {
    const auto append = std::make_shared<PlainAppend>(payload);
    append->wants = true;
    append->options = options;
    append->should_stop = should_stop;
    append->durable = [this](const absl::StatusOr<Acknowledgement>& ack) {
      EXPECT_THAT(ack, IsOk());
      EXPECT_FALSE(over_);
      durable_ = true;
    };
    append->candidates = [this](const VehicleView& view,
                                const absl::StatusOr<core::CandidateSet>& set) {
      EXPECT_TRUE(durable_);
      EXPECT_FALSE(over_);
      revisions_.push_back(view.revision);
      sets_.push_back(set);
    };
    append->over = [this] {
      EXPECT_TRUE(durable_);
      EXPECT_FALSE(over_);
      over_ = true;
    };
    session.Append(append->Request(), append);
    // Answered behind all of the append.
    EXPECT_THAT(AppendNow(session, payload), IsOk());
    EXPECT_TRUE(over_);
  }

  const std::vector<absl::StatusOr<core::CandidateSet>>& sets() const {
    return sets_;
  }
  const std::vector<std::uint64_t>& revisions() const { return revisions_; }

 private:
  bool durable_ = false;
  bool over_ = false;
  std::vector<std::uint64_t> revisions_;
  std::vector<absl::StatusOr<core::CandidateSet>> sets_;
};

TEST_F(VehicleSessionTest, AnswersWithCandidatesOfEveryCheckThatFellDue) {
  // One lap is 80 m; checks from 20 m on, every 5 m.
  const CheckedAppend first(*session_, SquareBatch(1, 80));
  EXPECT_EQ(first.sets().size(), 12u);
  const CheckedAppend second(*session_, SquareBatch(81, 60));
  ASSERT_EQ(second.sets().size(), 12u);
  // Well into the second lap the first is found.
  const core::CandidateSet set = *second.sets().back();
  ASSERT_FALSE(set.candidates.empty());
  EXPECT_EQ(set.candidates[0].matched, *set.query - 80);
  EXPECT_THAT(second.revisions(), ::testing::Each(3u));
}

TEST_F(VehicleSessionTest, ChecksOnlyWhereAsked) {
  const auto append = std::make_shared<PlainAppend>(SquareBatch(1, 80));
  append->candidates = [](const auto&, const auto&) { ADD_FAILURE(); };
  session_->Append(append->Request(), append);
  EXPECT_THAT(AppendNow(*session_, SquareBatch(81, 1)), IsOk());
}

TEST_F(VehicleSessionTest, NothingGetsBetweenAnAcknowledgementAndItsChecks) {
  // What a check answers must not hang on how far the poses behind it are.
  std::mutex mutex;
  std::vector<std::string> events;
  const auto note = [&](const std::string& event) {
    const std::lock_guard<std::mutex> guard(mutex);
    events.push_back(event);
  };
  storage_.Hold();
  std::vector<Answer<bool>> answers(4);
  for (std::uint64_t i = 0; i < answers.size(); ++i) {
    const std::string name = std::to_string(i);
    const auto append =
        std::make_shared<PlainAppend>(SquareBatch(1 + 40 * i, 40));
    append->wants = true;
    append->durable =
        [&, name, answer = answers[i]](
            const absl::StatusOr<Acknowledgement>& acknowledgement) {
          EXPECT_THAT(acknowledgement.status(), IsOk());
          note("ack " + name);
          answer.Set(true);
        };
    append->candidates = [&, name](
                             const VehicleView& view,
                             const absl::StatusOr<core::CandidateSet>& set) {
      EXPECT_THAT(set.status(), IsOk());
      note("check " + name + " at " + std::to_string(view.durable_sequence));
    };
    session_->Append(append->Request(), append);
  }
  const Answer<absl::StatusOr<AddedPair>> pair;
  session_->AddPosePair(PairKind::kLoopClosure, {"a", 60, 1, 1}, {},
                        pair.Setter());
  storage_.ReleaseAll();
  for (const Answer<bool>& answer : answers) answer.Get();
  EXPECT_THAT(pair.Get().status(), IsOk());
  std::string last_ack;
  for (const std::string& event : events) {
    if (event.rfind("ack ", 0) == 0) {
      last_ack = event.substr(4);
      continue;
    }
    EXPECT_EQ(event, "check " + last_ack + " at " +
                         std::to_string(40 * (std::stoi(last_ack) + 1)));
  }
  // The last batch brings checks too, and the pair came after them.
  EXPECT_EQ(events.back(), "check 3 at 160");
}

TEST_F(VehicleSessionTest, SaysWhyCheckIsNotRun) {
  const CheckedAppend appended(*session_, SquareBatch(1, 22),
                               [](const VehicleConfig&) {
                                 return Error(StatusCode::kInvalidArgument,
                                              "INVALID_FIELD", "no filter");
                               });
  EXPECT_THAT(appended.sets(),
              ElementsAre(IsError(StatusCode::kInvalidArgument, "INVALID_FIELD",
                                  "no filter")));
}

TEST_F(VehicleSessionTest, GivesUpChecksButNotTheAppendWhenToldToStop) {
  ASSERT_THAT(AppendNow(*session_, SquareBatch(1, 99)), IsOk());
  const CheckedAppend appended(*session_, SquareBatch(100, 3), nullptr,
                               [] { return true; });
  EXPECT_THAT(appended.sets(),
              ElementsAre(IsError(StatusCode::kCancelled, _, _)));
  EXPECT_EQ(ReadNow(*session_)->durable_sequence, 102u);
}

TEST_F(VehicleSessionTest, ColumnsAreStoredAsMessagesWhereNoneAreKept) {
  const auto columns = [](std::uint64_t first) {
    return "columns\n" + SquareBatch(first, 3);
  };
  ASSERT_THAT(AppendNow(*session_, columns(1)), IsOk());
  memory_.SetKeepsColumns(false);
  ASSERT_THAT(AppendNow(*session_, columns(4)), IsOk());
  const auto rows = ReadAll(memory_, memory_.GetVehicle("truck")->key, 1, 6);
  ASSERT_THAT(rows, IsOk());
  ASSERT_EQ(rows->size(), 2u);
  EXPECT_EQ((*rows)[0].payload, columns(1));
  EXPECT_EQ((*rows)[1].payload, SquareBatch(4, 3));
  // Sent again in either form, they are known.
  for (const std::string& batch :
       {columns(1), columns(4), SquareBatch(1, 6), SquareBatch(4, 3)}) {
    EXPECT_EQ(AppendNow(*session_, batch)->durable_sequence, 6u);
  }
}

TEST_F(VehicleSessionTest, LargeBatchHasSeveralRowsAndIsOneAllTheSame) {
  memory_.SetMostBatchBytes(100);
  const std::string batch = SquareBatch(1, 50);
  storage_.Hold();
  const Appended appended = Append(*session_, batch);
  const Appended behind = Append(*session_, SquareBatch(51, 1));
  storage_.Await(2);
  storage_.ReleaseAll();
  ASSERT_THAT(appended.durable.Get(), IsOk());
  EXPECT_EQ(appended.durable.Get()->durable_sequence, 50u);
  ASSERT_THAT(behind.durable.Get(), IsOk());
  const auto rows = ReadAll(memory_, memory_.GetVehicle("truck")->key, 1, 51);
  ASSERT_THAT(rows, IsOk());
  EXPECT_GT(rows->size(), 10u);
  std::string joined;
  std::uint64_t revision = 1;
  for (const BatchRecord& row : *rows) {
    EXPECT_LE(row.payload.size(), 100u);
    EXPECT_EQ(row.revision, ++revision);
    joined += row.payload;
  }
  EXPECT_EQ(joined, SquareBatch(1, 51));
  const Snapshot before = *ReadNow(*session_);
  EXPECT_EQ(before.revision, revision);
  EXPECT_THAT(before.damage, IsOk());
  // Sent again, it is known; and the vehicle is the same once loaded anew.
  EXPECT_EQ(AppendNow(*session_, batch)->durable_sequence, 51u);
  Reload();
  const Snapshot after = *ReadNow(*session_);
  EXPECT_THAT(after.damage, IsOk());
  EXPECT_EQ(after.revision, before.revision);
  EXPECT_EQ(after.graph, before.graph);
}

TEST_F(VehicleSessionTest, AnswersNotFoundAfterDelete) {
  ASSERT_THAT(AppendNow(*session_, StraightBatch(1, 9)), IsOk());
  ASSERT_THAT(DeleteNow(*session_), IsOk());
  const auto not_found = IsError(StatusCode::kNotFound, "VEHICLE_NOT_FOUND", _);
  EXPECT_THAT(ReadNow(*session_), not_found);
  EXPECT_THAT(AppendNow(*session_, StraightBatch(10, 1)), not_found);
  EXPECT_THAT(DeleteNow(*session_), not_found);
  EXPECT_TRUE(session_->gone());
  EXPECT_FALSE(memory_.GetVehicle("truck").ok());
}

TEST_F(VehicleSessionTest, AnswersWhatWaitsBehindDelete) {
  storage_.Hold();
  const Answer<absl::Status> deleted;
  session_->Delete(deleted.Setter());
  const Appended behind = Append(*session_, StraightBatch(1, 1));
  storage_.ReleaseAll();
  EXPECT_THAT(deleted.Get(), IsOk());
  EXPECT_THAT(behind.durable.Get(),
              IsError(StatusCode::kNotFound, "VEHICLE_NOT_FOUND", _));
}

TEST_F(VehicleSessionTest, FailedDeleteLeavesVehicle) {
  storage_.Hold();
  const Answer<absl::Status> deleted;
  session_->Delete(deleted.Setter());
  storage_.FailOne(DeviceFailure());
  EXPECT_THAT(deleted.Get(),
              IsError(StatusCode::kUnavailable, "STORE_UNAVAILABLE", _));
  storage_.ReleaseAll();
  EXPECT_THAT(AppendNow(*session_, StraightBatch(1, 1)), IsOk());
}

TEST_F(VehicleSessionTest, FirstBatchSetsTheOrigin) {
  VehicleConfig config = TestConfig();
  config.frame = CoordinateFrame::kGeodetic;
  Create(config);
  storage_.Hold();
  // Decoded while the first is in flight, with the origin that it sets.
  const Appended first = Append(*session_, PlainBatch(1, {7, 8, 9}));
  const Appended second = Append(*session_, PlainBatch(4, {10}));
  storage_.Await(2);
  EXPECT_FALSE(ReadNow(*session_)->config.origin.has_value());
  storage_.ReleaseAll();
  ASSERT_THAT(second.durable.Get(), IsOk());
  const Snapshot before = *ReadNow(*session_);
  ASSERT_TRUE(before.config.origin.has_value());
  EXPECT_EQ(before.config.origin->longitude_degrees, 7.0);
  EXPECT_EQ(before.node_count, 4);
  Reload();
  EXPECT_EQ(ReadNow(*session_)->config.origin->longitude_degrees, 7.0);
  EXPECT_EQ(ReadNow(*session_)->graph, before.graph);
}

TEST_F(VehicleSessionTest, OriginGoesWithTheBatchThatWasNotWritten) {
  VehicleConfig config = TestConfig();
  config.frame = CoordinateFrame::kGeodetic;
  Create(config);
  storage_.Hold();
  const Appended first = Append(*session_, PlainBatch(1, {7, 8, 9}));
  storage_.FailOne(DeviceFailure());
  EXPECT_FALSE(first.durable.Get().ok());
  storage_.ReleaseAll();
  ASSERT_THAT(AppendNow(*session_, PlainBatch(1, {5})), IsOk());
  EXPECT_EQ(ReadNow(*session_)->config.origin->longitude_degrees, 5.0);
}

TEST_F(VehicleSessionTest, SaysThatStoredVehicleCannotBeRead) {
  ASSERT_THAT(BlockingWrites(&memory_).Create("broken", "nonsense"), IsOk());
  EXPECT_THAT(ReadNow(*Load("broken"))->damage,
              IsError(StatusCode::kDataLoss, "STORE_CORRUPT", _));
  const VehicleKey key =
      *BlockingWrites(&memory_).Create("bad", codec_.EncodeVehicle({}));
  ASSERT_THAT(
      BlockingWrites(&memory_).Append(key, {1, 2, 2, StraightBatch(1, 3)}),
      IsOk());
  const std::shared_ptr<VehicleSession> bad = Load("bad");
  EXPECT_THAT(ReadNow(*bad)->damage,
              IsError(StatusCode::kDataLoss, "STORE_CORRUPT",
                      AllOf(HasSubstr("'bad'"), HasSubstr("sequence 1"))));
  EXPECT_EQ(ReadNow(*bad)->durable_sequence, 0u);
}

TEST_F(VehicleSessionTest, CloseFinishesWhatWasCalledAndRefusesTheRest) {
  storage_.Hold();
  const Appended before = Append(*session_, StraightBatch(1, 1));
  const Answer<bool> closed;
  session_->Close(std::chrono::steady_clock::now(),
                  [=] { closed.Set(before.durable.IsSet()); });
  const Appended after = Append(*session_, StraightBatch(2, 1));
  storage_.ReleaseAll();
  EXPECT_TRUE(closed.Get());
  EXPECT_THAT(before.durable.Get(), IsOk());
  EXPECT_THAT(after.durable.Get(),
              IsError(StatusCode::kUnavailable, "SERVER_DRAINING", _));
}

TEST_F(VehicleSessionTest, WorkGoesOnWithoutTheSession) {
  storage_.Hold();
  const Appended appended = Append(*session_, StraightBatch(1, 1));
  const Answer<bool> closed;
  session_->Close(std::chrono::steady_clock::now(), [=] { closed.Set(true); });
  session_.reset();
  storage_.ReleaseAll();
  EXPECT_THAT(appended.durable.Get(), IsOk());
  closed.Get();
}

TEST_F(VehicleSessionTest, AnyInterleavingOfClientsStoresEveryPoseOnce) {
  // Clients that all send the same drive, in batches of their own, going back a
  // little now and then.
  std::mt19937_64 random = SeededRandom();
  const TemporaryDirectory directory;
  absl::StatusOr<std::unique_ptr<Storage>> sqlite =
      OpenSqliteStorage(directory.File("store.db"));
  ASSERT_THAT(sqlite, IsOk());
  ASSERT_THAT(BlockingWrites(sqlite->get())
                  .Create("truck", codec_.EncodeVehicle(TestConfig())),
              IsOk());
  const auto session = VehicleSession::Load("truck", sqlite->get(), &codec_,
                                            &executor_, limits_);
  constexpr std::uint64_t kPoses = 400;
  std::vector<std::thread> clients;
  for (int client = 0; client < 3; ++client) {
    clients.emplace_back([&, seed = random()] {
      std::mt19937_64 own(seed);
      std::uint64_t next = 1;
      while (next <= kPoses) {
        // A few batches at once, as a stream sends them.
        std::vector<Appended> sent;
        for (int i = 0; i < 3 && next <= kPoses; ++i) {
          const std::uint64_t count = std::min<std::uint64_t>(
              kPoses + 1 - next,
              static_cast<std::uint64_t>(UniformInt(own, 1, 20)));
          sent.push_back(Append(*session, SquareBatch(next, count)));
          next += count;
        }
        for (const Appended& appended : sent) {
          EXPECT_THAT(appended.durable.Get(), IsOk());
        }
        EXPECT_THAT(ReadNow(*session), IsOk());
        next -= std::min<std::uint64_t>(
            next - 1, static_cast<std::uint64_t>(UniformInt(own, 0, 5)));
        if (next + 3 > kPoses) break;
      }
    });
  }
  for (std::thread& client : clients) client.join();
  ASSERT_THAT(AppendNow(*session, SquareBatch(1, kPoses)), IsOk());
  const Snapshot snapshot = *ReadNow(*session);
  EXPECT_EQ(snapshot.durable_sequence, kPoses);
  CloseNow(*session);
  const auto reloaded = VehicleSession::Load("truck", sqlite->get(), &codec_,
                                             &executor_, limits_);
  EXPECT_EQ(ReadNow(*reloaded)->graph, snapshot.graph);
  CloseNow(*reloaded);
}

}  // namespace
}  // namespace revisit::server
