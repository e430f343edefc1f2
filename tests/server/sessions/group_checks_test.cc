// Stored checks that search in the histories of other vehicles.

#include <algorithm>
#include <atomic>
#include <cstddef>
#include <cstdint>
#include <map>
#include <memory>
#include <mutex>
#include <optional>
#include <string>
#include <utility>
#include <vector>

#include "core/drive/drive.h"
#include "core/drive/joined_drives.h"
#include "core/search/search.h"
#include "gmock/gmock.h"
#include "gtest/gtest.h"
#include "server/sessions/check_scopes.h"
#include "server/sessions/stored_checks.h"
#include "tests/server/error_matchers.h"
#include "tests/server/sessions/session_testing.h"
#include "tests/server/sessions/stored_checks_testing.h"
#include "tests/server/waiting.h"

namespace revisit::server {
namespace {

using absl::StatusCode;
using ::testing::_;
using ::testing::IsEmpty;
using ::testing::Not;
using ::testing::SizeIs;

// Answers at once with what it is told to.
class FakeScopes final : public CheckScopes {
 public:
  void Prepare(const Request& request, Then then) override {
    ++asked_;
    absl::StatusOr<CheckScopePtr> answer;
    {
      const std::lock_guard<std::mutex> guard(mutex_);
      last_ = request;
      answer = answer_;
    }
    then(std::move(answer));
  }

  void Answer(absl::StatusOr<CheckScopePtr> answer) {
    const std::lock_guard<std::mutex> guard(mutex_);
    answer_ = std::move(answer);
  }
  int asked() const { return asked_; }
  Request last() const {
    const std::lock_guard<std::mutex> guard(mutex_);
    return last_;
  }

 private:
  mutable std::mutex mutex_;
  absl::StatusOr<CheckScopePtr> answer_ =
      absl::UnavailableError("the group is not ready");
  Request last_;
  std::atomic<int> asked_{0};
};

VehicleConfig GroupConfig() {
  VehicleConfig config = StoringConfig();
  config.check_group = "site";
  // All that is found at all is kept, so that each candidate is looked at.
  config.keep_probability = 1e-300;
  return config;
}

// `truck` is checked in a group with `van`, which has driven the same square.
class GroupChecksTest : public StoredChecksTest {
 protected:
  GroupChecksTest() {
    policy_.scopes = &scopes_;
    // Second searches are allowed by SearchAgain() alone.
    policy_.searches_per_change = 0;
    VehicleConfig config = TestConfig();
    config.uid = "uid-of-van";
    EXPECT_THAT(
        BlockingWrites(&memory_).Create("van", codec_.EncodeVehicle(config)),
        IsOk());
    const auto van = VehicleSession::Load(
        "van", &memory_, &codec_, &executor_, VehicleSession::Limits(),
        SnapshotPolicy(),
        std::make_shared<RetentionMonitor>(RetentionMonitor::Reports()),
        [] { return std::int64_t{77}; }, nullptr, StoredChecksPolicy());
    EXPECT_THAT(AppendNow(*van, SquareBatch(1, 200)), IsOk());
    const Answer<std::shared_ptr<const core::DriveView>> view;
    van->Read([view](const absl::StatusOr<VehicleView>& read) {
      view.Set(read->drive.View(1.0));
    });
    auto scope = std::make_shared<CheckScope>();
    scope->search.drives = std::make_shared<const core::JoinedDrives>(
        std::vector<core::JoinedDrive>{{view.Get()}},
        std::vector<core::FrameLink>());
    scope->vehicles.push_back({"van", "uid-of-van"});
    with_van_ = std::move(scope);
    CloseNow(*van);
  }

  // A stored candidate in the history of `van`.
  struct InVan {
    CandidateId id;
    StoredCandidate candidate;
  };
  std::vector<InVan> AllInVan() {
    std::vector<InVan> found;
    for (const CheckRecord& record : Checks()) {
      const StoredCheck check = *check_codec_.DecodeCheck(record.payload);
      for (const StoredCandidate& candidate : check.candidates) {
        if (candidate.matched_vehicle != "van") continue;
        found.push_back({{record.sequence, candidate.number}, candidate});
      }
    }
    return found;
  }

  // What a search in the scope finds at each pose where a check was due.
  std::map<std::uint64_t, std::string> SearchInScope() {
    const Answer<std::map<std::uint64_t, std::string>> answer;
    session_->Search("test", [=](const absl::StatusOr<VehicleView>& view) {
      std::map<std::uint64_t, std::string> found;
      std::uint64_t after = 0;
      while (const auto due = view->drive.NextCheck(after)) {
        after = due->sequence;
        const auto set = view->search->At(due->node, view->config.drive.search,
                                          with_van_->search, nullptr);
        if (std::none_of(set->candidates.begin(), set->candidates.end(),
                         [&](const core::Candidate& candidate) {
                           return IsWorthKeeping(candidate,
                                                 view->config.keep_probability);
                         })) {
          continue;
        }
        found[due->sequence] =
            check_codec_.EncodeFound(*view, *set, {}, with_van_.get());
      }
      answer.Set(std::move(found));
      return true;
    });
    return answer.Get();
  }

  absl::Status AddPair(PairKind kind, const PosePairRecord& pair,
                       std::optional<CandidateId> named = std::nullopt) {
    const Answer<absl::StatusOr<AddedPair>> added;
    PairAnswer answers;
    answers.candidate = named;
    session_->AddPosePair(kind, pair, answers, added.Setter());
    return added.Get().status();
  }

  FakeScopes scopes_;
  CheckScopePtr with_van_;
};

TEST_F(GroupChecksTest, ChecksFindWhatASearchInTheGroupFinds) {
  scopes_.Answer(with_van_);
  Create(GroupConfig());
  for (std::uint64_t first = 1; first <= 200; first += 20) {
    ASSERT_THAT(AppendNow(*session_, SquareBatch(first, 20)), IsOk());
  }
  ASSERT_TRUE(IsPaid());
  EXPECT_EQ(scopes_.last().group, "site");
  EXPECT_EQ(scopes_.last().vehicle, "truck");
  EXPECT_EQ(scopes_.last().key, Record().key);
  std::map<std::uint64_t, std::string> stored;
  std::size_t candidates = 0;
  for (const CheckRecord& record : Checks()) {
    const StoredCheck check = *check_codec_.DecodeCheck(record.payload);
    stored[record.sequence] = check.found;
    candidates += check.candidates.size();
  }
  EXPECT_EQ(stored, SearchInScope());
  EXPECT_THAT(Events(), SizeIs(candidates));
  const std::vector<InVan> in_van = AllInVan();
  ASSERT_THAT(in_van, Not(IsEmpty()));
  for (const InVan& one : in_van) {
    EXPECT_EQ(one.candidate.matched_uid, "uid-of-van");
    EXPECT_LE(one.candidate.matched_sequence, 200u);
    EXPECT_EQ(one.candidate.state, CandidateState::kOpen);
    EXPECT_EQ(one.candidate.value, 0.0);
  }
}

TEST_F(GroupChecksTest, ChecksWaitWhileTheGroupIsNotReadyAndAppendsDoNot) {
  Create(GroupConfig());
  for (std::uint64_t first = 1; first <= 200; first += 2) {
    ASSERT_THAT(AppendNow(*session_, SquareBatch(first, 2)), IsOk());
  }
  ASSERT_TRUE(Eventually([&] { return session_->has_waiting_searches(); }));
  EXPECT_GT(session_->check_debt(), 0);
  EXPECT_THAT(Checks(), IsEmpty());
  EXPECT_THAT(Events(), IsEmpty());
  // Once for all appends, unless these take seconds.
  EXPECT_LT(scopes_.asked(), 50);
  scopes_.Answer(with_van_);
  session_->SearchAgain();
  ASSERT_TRUE(IsPaid());
  EXPECT_FALSE(session_->has_waiting_searches());
  EXPECT_THAT(AllInVan(), Not(IsEmpty()));
}

TEST_F(GroupChecksTest, WithoutAMembershipTheOwnHistoryAloneIsSearched) {
  scopes_.Answer(CheckScopePtr());
  VehicleConfig config = StoringConfig();
  config.check_group = "site";
  Create(config);
  ASSERT_THAT(AppendNow(*session_, SquareBatch(1, kPoses)), IsOk());
  ASSERT_TRUE(IsPaid());
  ExpectAllStoredAndToldOnce();
  EXPECT_THAT(AllInVan(), IsEmpty());
}

TEST_F(GroupChecksTest, AVehicleWithoutAGroupAsksForNone) {
  scopes_.Answer(with_van_);
  Create(StoringConfig());
  ASSERT_THAT(AppendNow(*session_, SquareBatch(1, kPoses)), IsOk());
  ASSERT_TRUE(IsPaid());
  ExpectAllStoredAndToldOnce();
  EXPECT_EQ(scopes_.asked(), 0);
}

TEST_F(GroupChecksTest, OwnPairsDecideNothingInTheHistoriesOfOthers) {
  scopes_.Answer(with_van_);
  Create(GroupConfig());
  ASSERT_THAT(AppendNow(*session_, SquareBatch(1, kPoses)), IsOk());
  ASSERT_TRUE(IsPaid());
  const std::vector<InVan> before = AllInVan();
  ASSERT_THAT(before, Not(IsEmpty()));
  const InVan& first = before.front();
  const PosePairRecord same_numbers{"link", first.id.check_sequence,
                                    first.candidate.matched_sequence, 5};
  // Nor if they name one.
  for (const PairKind kind :
       {PairKind::kLoopClosure, PairKind::kRejectedCandidate}) {
    EXPECT_THAT(AddPair(kind, same_numbers, first.id),
                IsError(StatusCode::kInvalidArgument, "INVALID_FIELD", _));
  }
  EXPECT_EQ(Record().loop_closure_count, 0);
  ASSERT_THAT(AddPair(PairKind::kLoopClosure, same_numbers), IsOk());
  for (const InVan& one : AllInVan()) {
    EXPECT_EQ(one.candidate.state, CandidateState::kOpen);
  }
  ASSERT_THAT(DeletePairNow(*session_, PairKind::kLoopClosure, "link"), IsOk());
  for (const InVan& one : AllInVan()) {
    EXPECT_EQ(one.candidate.cause, CandidateCause::kCheck);
  }
}

TEST_F(GroupChecksTest, SecondSearchesLookInTheGroupTooAndLeaveWhatIsAway) {
  policy_.searches_per_change = kSearchesPerChange;
  scopes_.Answer(with_van_);
  Create(GroupConfig());
  ASSERT_THAT(AppendNow(*session_, SquareBatch(1, kPoses)), IsOk());
  ASSERT_TRUE(IsPaid());
  const std::vector<InVan> before = AllInVan();
  ASSERT_THAT(before, Not(IsEmpty()));
  const auto search_again = [&](double keep) {
    ASSERT_THAT(UpdateNow(*session_,
                          [keep](const VehicleView& view) {
                            VehicleConfig config = view.config;
                            config.keep_probability = keep;
                            return absl::StatusOr<VehicleConfig>(config);
                          }),
                IsOk());
    ASSERT_TRUE(Eventually([this] {
      session_->SearchAgain();
      ReadNow(*session_).IgnoreError();
      return !session_->has_waiting_searches();
    }));
  };
  const auto states = [this] {
    std::map<std::pair<std::uint64_t, std::uint32_t>, CandidateState> all;
    for (const InVan& one : AllInVan()) {
      all[{one.id.check_sequence, one.id.number}] = one.candidate.state;
    }
    return all;
  };
  const auto open = states();

  // The same answer: nothing is withdrawn, and nothing is told.
  const std::size_t told = Events().size();
  search_again(2e-300);
  EXPECT_EQ(states(), open);
  EXPECT_EQ(Events().size(), told);
  const std::map<std::uint64_t, std::string> anew = SearchInScope();
  for (const CheckRecord& record : Checks()) {
    EXPECT_EQ(check_codec_.DecodeCheck(record.payload)->latest,
              anew.at(record.sequence));
  }

  // Where the other vehicle was not searched, nothing is said of its places.
  scopes_.Answer(CheckScopePtr());
  search_again(3e-300);
  EXPECT_EQ(states(), open);

  // Where it was, they may have become improbable.
  scopes_.Answer(with_van_);
  search_again(1.0);
  for (const auto& [id, state] : states()) {
    EXPECT_EQ(state, CandidateState::kWithdrawn);
  }
}

}  // namespace
}  // namespace revisit::server
