#include "server/sessions/vehicle_session.h"

#include <pthread.h>

#include <algorithm>
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
#include "tests/server/held_storage.h"
#include "tests/server/memory_storage.h"
#include "tests/server/plain_codec.h"
#include "tests/server/sessions/session_testing.h"
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

constexpr PairKind kClosure = PairKind::kLoopClosure;
// The uid in TestConfig().
constexpr char kUid[] = "uid-of-test";

constexpr PairKind kRejection = PairKind::kRejectedCandidate;

const absl::Status& DeviceFailure() {
  static const absl::Status* const status = new absl::Status(Error(
      StatusCode::kUnavailable, "STORE_UNAVAILABLE", "the device is broken"));
  return *status;
}

// A vehicle `truck` in a storage that can be held, over one of this test.
class VehicleSessionTest : public ::testing::Test {
 protected:
  VehicleSessionTest() { Create(TestConfig()); }
  ~VehicleSessionTest() override {
    storage_.ReleaseAll();
    if (session_ != nullptr) CloseNow(*session_);
  }

  void Create(const VehicleConfig& config) {
    if (session_ != nullptr) {
      EXPECT_THAT(DeleteNow(*session_), IsOk());
      CloseNow(*session_);
    }
    EXPECT_THAT(
        BlockingWrites(&memory_).Create("truck", codec_.EncodeVehicle(config)),
        IsOk());
    session_ = Load("truck");
  }

  std::shared_ptr<VehicleSession> Load(const std::string& id) {
    return VehicleSession::Load(id, &storage_, &codec_, &executor_, limits_);
  }

  // As after a restart.
  void Reload() {
    CloseNow(*session_);
    session_ = Load("truck");
  }

  std::vector<std::string> Stored() {
    const VehicleRecord record = *memory_.GetVehicle("truck");
    return ToTexts(*ReadAll(memory_, record.key, 1, record.durable_sequence));
  }

  MemoryStorage memory_;
  HeldStorage storage_{&memory_};
  PlainCodec codec_;
  Executor executor_{2};
  VehicleSession::Limits limits_;
  std::shared_ptr<VehicleSession> session_;
};

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
  session_->AddPosePair(kClosure, {"a", 10, 1, 0}, closed.Setter());
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
  session_->AddPosePair(PairKind::kLoopClosure, {"a", 60, 1, 1}, pair.Setter());
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

// Shifts the poses of the stored batch that begins with 4 by 200 m.
absl::StatusOr<RevisionPlan> ShiftSecondBatch(const VehicleView& view) {
  EXPECT_EQ(view.durable_sequence, 9u);
  RevisionPlan plan;
  plan.batches = BatchesOf({{4, 3, 0, PlainBatch(4, {204, 205, 206})}});
  plan.revised_count = 3;
  return plan;
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
  EXPECT_NEAR(off->agreement->squared_mahalanobis, 4.0 / 0.25, 0.1);
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
        kClosure, id, [&](const absl::StatusOr<std::uint64_t>& revision) {
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
  session_->AddPosePair(kRejection, {"a", 9, 2, 0}, rejected.Setter());
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
  session_->AddPosePair(kRejection, {"a", 9, 2, 0}, rejected.Setter());
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
