#include "server/sessions/stored_checks.h"

#include <atomic>
#include <chrono>
#include <cstdint>
#include <iterator>
#include <map>
#include <memory>
#include <optional>
#include <string>
#include <utility>
#include <vector>

#include "core/drive/drive.h"
#include "core/search/search.h"
#include "gmock/gmock.h"
#include "gtest/gtest.h"
#include "server/sessions/fleet.h"
#include "server/sessions/vehicle_session.h"
#include "tests/random.h"
#include "tests/server/error_matchers.h"
#include "tests/server/held_storage.h"
#include "tests/server/memory_storage.h"
#include "tests/server/plain_check_codec.h"
#include "tests/server/plain_codec.h"
#include "tests/server/sessions/session_testing.h"
#include "tests/server/sessions/stored_checks_testing.h"
#include "tests/server/storage_testing.h"
#include "tests/server/waiting.h"

namespace revisit::server {
namespace {

using absl::StatusCode;
using ::testing::_;
using ::testing::ElementsAre;
using ::testing::HasSubstr;
using ::testing::IsEmpty;
using ::testing::SizeIs;
using ::testing::StartsWith;

TEST_F(StoredChecksTest, StoresEachCheckThatIsDueOnceAsASearchFindsIt) {
  Create(StoringConfig());
  for (std::uint64_t first = 1; first <= kPoses; first += 20) {
    ASSERT_THAT(AppendNow(*session_, SquareBatch(first, 20)), IsOk());
  }
  ASSERT_TRUE(IsPaid());
  ExpectAllStoredAndToldOnce();
}

TEST_F(StoredChecksTest, StoresNothingForAVehicleThatDoesNotAskForIt) {
  Create(TestConfig());
  ASSERT_THAT(AppendNow(*session_, SquareBatch(1, kPoses)), IsOk());
  Reload();
  EXPECT_THAT(ReadNow(*session_), IsOk());
  EXPECT_EQ(session_->check_debt(), 0);
  EXPECT_EQ(Record().checks, ChecksHead());
  EXPECT_THAT(Checks(), IsEmpty());
}

TEST_F(StoredChecksTest, MakesTheChecksOfEarlierPosesOnceTheyAreAskedFor) {
  Create(TestConfig());
  ASSERT_THAT(AppendNow(*session_, SquareBatch(1, kPoses)), IsOk());
  const auto set = [this](ChecksKept kept) {
    return UpdateNow(*session_, [kept](const VehicleView& view) {
      VehicleConfig config = view.config;
      config.checks = kept;
      return absl::StatusOr<VehicleConfig>(config);
    });
  };
  ASSERT_THAT(set(ChecksKept::kStored), IsOk());
  ASSERT_TRUE(IsPaid());
  ExpectAllStoredAndToldOnce();
  const std::size_t before = Checks().size();

  ASSERT_THAT(set(ChecksKept::kOnRequest), IsOk());
  EXPECT_TRUE(Eventually([this] { return !Record().checks.stores; }));
  ASSERT_THAT(AppendNow(*session_, SquareBatch(kPoses + 1, 100)), IsOk());
  EXPECT_THAT(Checks(), SizeIs(before));
  EXPECT_THAT(*memory_.ListUnchecked(0, 9), IsEmpty());

  // What came meanwhile is owed too, and nothing is made twice.
  ASSERT_THAT(set(ChecksKept::kStored), IsOk());
  ASSERT_TRUE(IsPaid());
  ExpectAllStoredAndToldOnce();
}

TEST_F(StoredChecksTest, AcknowledgesPosesWhileChecksWaitForTheStore) {
  Create(StoringConfig());
  ASSERT_THAT(AppendNow(*session_, SquareBatch(1, 200)), IsOk());
  ASSERT_TRUE(IsPaid());
  storage_.Hold();
  const Appended a = Append(*session_, SquareBatch(201, 100));
  storage_.Await(1);
  storage_.ReleaseOne();
  ASSERT_THAT(a.durable.Get(), IsOk());
  // The checks of these poses.
  storage_.Await(1);
  const Appended b = Append(*session_, SquareBatch(301, 100));
  storage_.Await(2);
  EXPECT_THAT(ReadNow(*session_), IsOk());
  storage_.ReleaseAll();
  ASSERT_THAT(b.durable.Get(), IsOk());
  ASSERT_TRUE(IsPaid());
  ExpectAllStoredAndToldOnce();
}

TEST_F(StoredChecksTest, WritesTogetherWhatOneTurnMakes) {
  policy_.turn = std::chrono::hours(1);
  Create(StoringConfig());
  ASSERT_THAT(AppendNow(*session_, SquareBatch(1, kPoses)), IsOk());
  ASSERT_TRUE(IsPaid());
  ExpectAllStoredAndToldOnce();
  EXPECT_LT(2 * storage_.check_writes(), Checks().size());
}

TEST_F(StoredChecksTest, GoesOnWhereItEndedHoweverOftenItIsCutOff) {
  std::mt19937_64 random = SeededRandom();
  Create(StoringConfig());
  std::uint64_t next = 1;
  while (next <= kPoses) {
    const auto count = static_cast<std::uint64_t>(UniformInt(random, 1, 60));
    ASSERT_THAT(AppendNow(*session_, SquareBatch(next, count)), IsOk());
    next += count;
    if (UniformInt(random, 0, 1) == 0) Reload();
  }
  ASSERT_TRUE(IsPaid());
  ExpectAllStoredAndToldOnce();
}

TEST_F(StoredChecksTest, TellsNothingTwiceAfterWritesOfUnknownFate) {
  std::mt19937_64 random = SeededRandom();
  Create(StoringConfig());
  ASSERT_THAT(AppendNow(*session_, SquareBatch(1, 150)), IsOk());
  ASSERT_TRUE(IsPaid());
  std::uint64_t next = 151;
  for (int round = 0; round < 12; ++round) {
    storage_.Hold();
    const Appended append = Append(*session_, SquareBatch(next, 30));
    next += 30;
    storage_.Await(1);
    storage_.ReleaseOne();
    ASSERT_THAT(append.durable.Get(), IsOk());
    storage_.Await(1);
    // The checks are written, or not, and nobody hears of it.
    if (UniformInt(random, 0, 1) == 0) {
      storage_.PassOnAndFailOne(BrokenDevice());
    } else {
      storage_.FailOne(BrokenDevice());
    }
    storage_.ReleaseAll();
    session_->PayChecks();
    ASSERT_TRUE(IsPaid());
  }
  ExpectAllStoredAndToldOnce();
}

TEST_F(StoredChecksTest, ALoopClosureConfirmsWhatLiesAtItsPlacesUntilItGoes) {
  policy_.searches_per_change = 0;
  Create(StoringConfig());
  ASSERT_THAT(AppendNow(*session_, SquareBatch(1, kPoses)), IsOk());
  ASSERT_TRUE(IsPaid());
  const Found found = FirstFound();
  const std::size_t before = Events().size();
  const Answer<absl::StatusOr<AddedPair>> added;
  PairAnswer answers;
  answers.actor = "bob";
  session_->AddPosePair(PairKind::kLoopClosure,
                        {"link", found.check + 2, found.matched + 2, 5},
                        answers, added.Setter());
  ASSERT_THAT(added.Get(), IsOk());
  const std::string id = "truck " + std::to_string(found.check) + "/1 ";
  EXPECT_THAT(EventsOf(found.check),
              ::testing::Contains(id + "confirmed by link, said bob"));
  // Checks every 5 m: one more lies within 10 m of the first place at least.
  EXPECT_GE(Events().size(), before + 2);
  const StoredCheck check = *check_codec_.DecodeCheck(Checks().front().payload);
  EXPECT_EQ(check.candidates.front().decision, "link");
  EXPECT_EQ(Checks().front().open_count, check.candidates.size() - 1);
  // Again: nothing is told twice.
  const std::size_t told = Events().size();
  ASSERT_THAT(AddPairNow(*session_, PairKind::kLoopClosure,
                         {"link", found.check + 2, found.matched + 2, 5}),
              IsOk());
  EXPECT_EQ(Events().size(), told);

  PairDeletion deletion;
  deletion.deleted_by = "eve";
  ASSERT_THAT(
      DeletePairNow(*session_, PairKind::kLoopClosure, "link", deletion),
      IsOk());
  EXPECT_THAT(EventsOf(found.check),
              ::testing::Contains(id + "open, said eve"));
  EXPECT_EQ(Events().size(), told + (told - before));
  Reload();
  ASSERT_TRUE(IsPaid());
  const std::vector<EventRecord> events = Events();
  for (std::size_t i = 0; i < events.size(); ++i) {
    EXPECT_EQ(events[i].number, i + 1);
  }
}

TEST_F(StoredChecksTest, ARejectionAnswersTheCandidateThatItNames) {
  Create(StoringConfig());
  ASSERT_THAT(AppendNow(*session_, SquareBatch(1, kPoses)), IsOk());
  ASSERT_TRUE(IsPaid());
  const Found found = FirstFound();
  const auto reject = [&](const char* id, std::uint64_t query,
                          const CandidateId& candidate) {
    const Answer<absl::StatusOr<AddedPair>> added;
    PairAnswer answers;
    answers.candidate = candidate;
    session_->AddPosePair(PairKind::kRejectedCandidate, {id, query, 1, 5},
                          answers, added.Setter());
    return added.Get().status();
  };
  const std::size_t before = Events().size();
  // One that is not there: nothing is stored.
  for (const CandidateId& missing :
       {CandidateId{found.check, 99}, CandidateId{found.check + 1, 1}}) {
    EXPECT_THAT(reject("no", kPoses, missing),
                IsError(StatusCode::kNotFound, "CHECK_NOT_FOUND", _));
  }
  EXPECT_EQ(Events().size(), before);
  EXPECT_EQ(Record().rejected_candidate_count, 0);
  // However far away its poses are.
  ASSERT_THAT(reject("no", kPoses, {found.check, 1}), IsOk());
  EXPECT_THAT(EventsOf(found.check).back(), HasSubstr("/1 rejected by no"));
}

TEST_F(StoredChecksTest, ACheckThatIsMadeAfterTheDecisionIsDecidedAtOnce) {
  Create(TestConfig());
  ASSERT_THAT(AppendNow(*session_, SquareBatch(1, 200)), IsOk());
  ASSERT_THAT(
      AddPairNow(*session_, PairKind::kLoopClosure, {"link", 180, 100, 5}),
      IsOk());
  ASSERT_THAT(UpdateNow(*session_,
                        [](const VehicleView& view) {
                          VehicleConfig config = view.config;
                          config.checks = ChecksKept::kStored;
                          return absl::StatusOr<VehicleConfig>(config);
                        }),
              IsOk());
  ASSERT_TRUE(IsPaid());
  bool is_decided = false;
  for (const EventRecord& event : Events()) {
    is_decided = is_decided ||
                 event.payload.find("confirmed by link") != std::string::npos;
  }
  EXPECT_TRUE(is_decided);
}

TEST_F(StoredChecksTest, WithdrawsWhatIsKeptNoLonger) {
  policy_.searches_per_change = 0;
  policy_.tidy_period = {};
  Create(StoringConfig());
  ASSERT_THAT(AppendNow(*session_, SquareBatch(1, kPoses)), IsOk());
  ASSERT_TRUE(IsPaid());
  const std::vector<CheckRecord> before = Checks();
  const std::size_t told = Events().size();
  std::size_t others = 0;
  for (const EventRecord& event : Events()) {
    const std::string first =
        "truck " + std::to_string(before.front().sequence) + "/";
    if (event.payload.rfind(first, 0) != 0) ++others;
  }
  // Those of the first check are all decided on.
  for (std::size_t i = 1; i <= told - others; ++i) {
    const Answer<absl::StatusOr<AddedPair>> added;
    PairAnswer answers;
    answers.candidate =
        CandidateId{before.front().sequence, static_cast<std::uint32_t>(i)};
    session_->AddPosePair(PairKind::kRejectedCandidate,
                          {std::to_string(i), kPoses, i, 5}, answers,
                          added.Setter());
    ASSERT_THAT(added.Get(), IsOk());
  }
  const std::size_t decided = Events().size();
  const auto pass = [this](std::chrono::hours time) {
    now_ns_ += std::chrono::nanoseconds(time).count();
    session_->PayChecks();
  };
  pass(std::chrono::hours(29 * 24));
  EXPECT_THAT(ReadNow(*session_), IsOk());
  EXPECT_THAT(Checks(), SizeIs(before.size()));
  pass(std::chrono::hours(2 * 24));
  // The decided ones go in silence, and some that were decided beside them.
  EXPECT_TRUE(Eventually([&] {
    const auto now = Checks();
    return now.empty() || now.front().sequence != before.front().sequence;
  }));
  EXPECT_EQ(Events().size(), decided);
  std::size_t open = 0;
  for (const CheckRecord& check : Checks()) open += check.open_count;
  pass(std::chrono::hours(60 * 24));
  EXPECT_TRUE(Eventually([&] { return Checks().empty(); }));
  const std::vector<EventRecord> events = Events();
  EXPECT_EQ(events.size(), decided + open);
  EXPECT_THAT(events.back().payload, HasSubstr(" withdrawn"));
  EXPECT_EQ(Record().checks.last_event, events.size());
  // Nothing is made again.
  Reload();
  ASSERT_TRUE(IsPaid());
  EXPECT_EQ(Events().size(), events.size());
}

TEST_F(StoredChecksTest, KeepsTheNewestChecksWhereThereAreTooMany) {
  policy_.tidy_period = {};
  policy_.most_checks = 7;
  Create(StoringConfig());
  ASSERT_THAT(AppendNow(*session_, SquareBatch(1, kPoses)), IsOk());
  ASSERT_TRUE(IsPaid());
  session_->PayChecks();
  EXPECT_TRUE(Eventually([&] { return Checks().size() <= 7; }));
  const std::map<std::uint64_t, std::string> anew = SearchAnew();
  auto newest = anew.rbegin();
  std::advance(newest, 6);
  EXPECT_EQ(Checks().front().sequence, newest->first);
  EXPECT_THAT(Checks(), SizeIs(7));
}

TEST_F(StoredChecksTest, TellsThatAVehicleIsDeleted) {
  Create(StoringConfig());
  ASSERT_THAT(AppendNow(*session_, SquareBatch(1, kPoses)), IsOk());
  ASSERT_TRUE(IsPaid());
  const std::size_t before = Events().size();
  ASSERT_THAT(DeleteNow(*session_), IsOk());
  const std::vector<EventRecord> events = Events();
  ASSERT_THAT(events, SizeIs(before + 1));
  EXPECT_EQ(events.back().payload, "truck is deleted");
  EXPECT_EQ(events.back().number, before + 1);
  EXPECT_EQ(events.back().time_ns, 77);
  EXPECT_EQ(events.front().payload, "");
}

TEST_F(StoredChecksTest, TellsTheStoreThatNothingIsOwedWhenTheVehicleGoes) {
  Create(StoringConfig());
  ASSERT_THAT(AppendNow(*session_, SquareBatch(1, 203)), IsOk());
  ASSERT_TRUE(IsPaid());
  // No check is due at these.
  ASSERT_THAT(AppendNow(*session_, SquareBatch(204, 1)), IsOk());
  CloseNow(*session_);
  EXPECT_EQ(Record().checks.checked_sequence, 204u);
  EXPECT_THAT(*memory_.ListUnchecked(0, 9), IsEmpty());
  session_ = Load();
}

TEST_F(StoredChecksTest, AFleetPaysForVehiclesThatNobodyAsksFor) {
  Create(StoringConfig());
  ASSERT_TRUE(Eventually([this] { return Record().checks.stores; }));
  storage_.Hold();
  const Appended append = Append(*session_, SquareBatch(1, kPoses));
  storage_.Await(1);
  storage_.ReleaseOne();
  ASSERT_THAT(append.durable.Get(), IsOk());
  // As if the server were killed before any check was written.
  storage_.Await(1);
  EXPECT_EQ(Record().checks.checked_sequence, 0u);
  storage_.FailOne(BrokenDevice());
  storage_.ReleaseAll();
  CloseNow(*session_);
  session_ = nullptr;

  Fleet::Options options;
  options.checks.codec = &check_codec_;
  options.clock = [] { return std::int64_t{77}; };
  {
    Fleet fleet(&storage_, &codec_, Lanes(&executor_), options);
    EXPECT_TRUE(Eventually([&] {
      fleet.PayChecks();
      return memory_.ListUnchecked(0, 9)->empty();
    }));
    EXPECT_THAT(Checks(), ::testing::Not(IsEmpty()));
    // It is let go again once it has heard that all is stored: a look while it
    // is at work counts as its last use.
    fleet.PayChecks();
    auto later = std::chrono::steady_clock::now();
    EXPECT_TRUE(Eventually([&] {
      fleet.UnloadIdle(later += std::chrono::hours(1));
      return fleet.loaded() == 0;
    }));
  }
  session_ = Load();
  ASSERT_TRUE(IsPaid());
  ExpectAllStoredAndToldOnce();
}

}  // namespace
}  // namespace revisit::server
