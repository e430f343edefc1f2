// Stored checks that search in the histories of other vehicles.

#include <algorithm>
#include <atomic>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <functional>
#include <map>
#include <memory>
#include <mutex>
#include <optional>
#include <string>
#include <utility>
#include <vector>

#include "core/drive/drive.h"
#include "core/drive/joined_drives.h"
#include "core/drive/node_range.h"
#include "core/drive/pose_graph.h"
#include "core/search/search.h"
#include "gmock/gmock.h"
#include "gtest/gtest.h"
#include "server/sessions/check_changes.h"
#include "server/sessions/check_monitor.h"
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
using ::testing::Contains;
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

  void ReadGroup(const Request& request, ThenGroup then) override {
    ++groups_read_;
    absl::StatusOr<CheckGroupPtr> group;
    {
      const std::lock_guard<std::mutex> guard(mutex_);
      if (holds_groups_) {
        held_.push_back(std::move(then));
        return;
      }
      group = request.group == "another" ? another_ : group_;
    }
    then(std::move(group));
  }

  // Each time another version, as a change of the group would be.
  CheckGroupPtr SetGroup(CheckGroup group) {
    const std::lock_guard<std::mutex> guard(mutex_);
    group.version = GroupVersion{"uid-of-site", ++revision_};
    CheckTies ties = *group.ties;
    ties.version = group.version;
    group.ties = std::make_shared<const CheckTies>(std::move(ties));
    group_ = std::make_shared<const CheckGroup>(std::move(group));
    return *group_;
  }
  // Lets the group `another` say this; it is not there unless this was called.
  void SetAnother(CheckGroup group) {
    const std::lock_guard<std::mutex> guard(mutex_);
    group.version = GroupVersion{"uid-of-another", ++revision_};
    another_ = std::make_shared<const CheckGroup>(std::move(group));
  }
  // Until ReleaseGroups() nobody is told what the group says.
  void HoldGroups() {
    const std::lock_guard<std::mutex> guard(mutex_);
    holds_groups_ = true;
  }
  void ReleaseGroups() {
    std::vector<ThenGroup> held;
    absl::StatusOr<CheckGroupPtr> group;
    {
      const std::lock_guard<std::mutex> guard(mutex_);
      holds_groups_ = false;
      held.swap(held_);
      group = group_;
    }
    for (const ThenGroup& then : held) then(group);
  }
  void SetNoGroup() {
    const std::lock_guard<std::mutex> guard(mutex_);
    group_ = std::make_shared<const CheckGroup>();
  }

  void Answer(absl::StatusOr<CheckScopePtr> answer) {
    const std::lock_guard<std::mutex> guard(mutex_);
    answer_ = std::move(answer);
  }
  int asked() const { return asked_; }
  int groups_read() const { return groups_read_; }
  Request last() const {
    const std::lock_guard<std::mutex> guard(mutex_);
    return last_;
  }

 private:
  mutable std::mutex mutex_;
  absl::StatusOr<CheckScopePtr> answer_ =
      absl::UnavailableError("the group is not ready");
  absl::StatusOr<CheckGroupPtr> group_ =
      absl::UnavailableError("the store cannot be reached");
  CheckGroupPtr another_ = std::make_shared<const CheckGroup>();
  bool holds_groups_ = false;
  std::vector<ThenGroup> held_;
  std::uint64_t revision_ = 0;
  Request last_;
  std::atomic<int> asked_{0};
  std::atomic<int> groups_read_{0};
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
    // Second searches are allowed by GoOnWithChecks() alone.
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
    scope->vehicles.push_back({"van", "uid-of-van", 200});
    scope->group_id = "site";
    with_van_ = std::move(scope);
    CloseNow(*van);
  }

  ~GroupChecksTest() override {
    // It asks the scopes until it is closed.
    if (session_ != nullptr) CloseNow(*session_);
    session_.reset();
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

  static CheckGroup WithMembers(std::vector<CheckGroup::Link> links = {}) {
    CheckGroup group;
    group.members = {{"truck", "uid-of-truck"}, {"van", "uid-of-van"}};
    group.links = std::move(links);
    return group;
  }

  // Makes the checks of a lap in the group, and answers what they found.
  std::vector<InVan> FindInVan() {
    scopes_.Answer(with_van_);
    Create(GroupConfig());
    EXPECT_THAT(AppendNow(*session_, SquareBatch(1, 200)), IsOk());
    EXPECT_TRUE(IsPaid());
    std::vector<InVan> found = AllInVan();
    EXPECT_THAT(found, Not(IsEmpty()));
    return found;
  }

  // From now on checks search in this group; empty for none.
  void SearchIn(const std::string& group) {
    EXPECT_THAT(UpdateNow(*session_,
                          [group](const VehicleView& view) {
                            VehicleConfig config = view.config;
                            config.check_group = group;
                            return absl::StatusOr<VehicleConfig>(config);
                          }),
                IsOk());
  }

  // A loop closure at the places of a candidate.
  static CheckGroup::Link LinkAt(const InVan& one) {
    CheckGroup::Link link;
    link.id = "a";
    link.own_sequence = one.id.check_sequence;
    link.other_uid = "uid-of-van";
    link.other_sequence = one.candidate.matched_sequence;
    return link;
  }

  // Whether what the group says comes to hold.
  bool ComesToHold(const std::function<bool(const InVan&)>& holds) {
    return Eventually([&] {
      session_->GoOnWithChecks();
      ReadNow(*session_).IgnoreError();
      const std::vector<InVan> all = AllInVan();
      return std::all_of(all.begin(), all.end(), holds);
    });
  }

  std::size_t CountTold(const CandidateId& id, const std::string& what) {
    const std::string text = "truck " + std::to_string(id.check_sequence) +
                             "/" + std::to_string(id.number) + " " + what;
    const std::vector<std::string> told = EventsOf(id.check_sequence);
    return static_cast<std::size_t>(std::count(told.begin(), told.end(), text));
  }

  FakeScopes scopes_;
  CheckScopePtr with_van_;
};

// Whether the candidate lies at the places of a link, as numbers alone tell:
// poses are a metre apart at least, and nearer ones are not asked about.
bool IsAt(const CheckGroup::Link& link, std::uint64_t check,
          const StoredCandidate& candidate) {
  return check == link.own_sequence &&
         candidate.place_first <= link.other_sequence &&
         link.other_sequence <= candidate.place_last;
}

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
  ASSERT_TRUE(Eventually([&] { return session_->has_waiting_checks(); }));
  EXPECT_GT(session_->check_debt(), 0);
  EXPECT_THAT(Checks(), IsEmpty());
  EXPECT_THAT(Events(), IsEmpty());
  // Once for all appends, unless these take seconds.
  EXPECT_LT(scopes_.asked(), 50);
  scopes_.Answer(with_van_);
  session_->GoOnWithChecks();
  ASSERT_TRUE(IsPaid());
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
    std::map<std::uint64_t, std::uint64_t> bases;
    for (const CheckRecord& record : Checks()) {
      bases[record.sequence] = check_codec_.DecodeCheck(record.payload)->basis;
    }
    ASSERT_THAT(UpdateNow(*session_,
                          [keep](const VehicleView& view) {
                            VehicleConfig config = view.config;
                            config.keep_probability = keep;
                            return absl::StatusOr<VehicleConfig>(config);
                          }),
                IsOk());
    ASSERT_TRUE(Eventually([&] {
      session_->GoOnWithChecks();
      ReadNow(*session_).IgnoreError();
      for (const CheckRecord& record : Checks()) {
        const StoredCheck check = *check_codec_.DecodeCheck(record.payload);
        if (check.stale || check.basis == bases[record.sequence]) return false;
      }
      return true;
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

TEST_F(GroupChecksTest, LinksHaveWhatTheyConcernSearchedAgainAndNothingElse) {
  policy_.searches_per_change = kSearchesPerChange;
  policy_.monitor = std::make_shared<CheckMonitor>();
  const std::vector<InVan> found = FindInVan();
  const auto bases = [this] {
    std::map<std::uint64_t, std::uint64_t> all;
    for (const CheckRecord& record : Checks()) {
      all[record.sequence] = check_codec_.DecodeCheck(record.payload)->basis;
    }
    return all;
  };
  const auto before = bases();
  const std::uint64_t place = found[found.size() / 2].id.check_sequence;
  const std::size_t told = Events().size();
  const auto changed = [&] {
    std::vector<std::uint64_t> sequences;
    for (const auto& [sequence, basis] : bases()) {
      if (basis != before.at(sequence)) sequences.push_back(sequence);
    }
    return sequences;
  };
  // Has the group say that these tie the vehicle, and waits until what was
  // searched otherwise than before are these checks.
  const auto come_to_be_searched =
      [&](const std::vector<CheckTies::Tie>& tied,
          const std::vector<std::uint64_t>& wanted) {
        CheckTies ties;
        ties.ties = tied;
        CheckGroup group = WithMembers();
        group.ties = std::make_shared<const CheckTies>(ties);
        CheckScope scope = *with_van_;
        scope.ties = scopes_.SetGroup(group)->ties;
        scopes_.Answer(std::make_shared<const CheckScope>(std::move(scope)));
        return Eventually([&] {
          session_->GoOnWithChecks();
          ReadNow(*session_).IgnoreError();
          return changed() == wanted;
        });
      };
  const auto tie = [&](const std::string& id) {
    return CheckTies::Tie{place,
                          {id, LinkState::kConfirmed, {1, place}, {2, 1}}};
  };

  std::vector<std::uint64_t> behind;
  for (const auto& [sequence, basis] : before) {
    if (sequence >= place) behind.push_back(sequence);
  }
  ASSERT_LT(behind.size(), before.size());
  ASSERT_TRUE(come_to_be_searched({tie("tie")}, behind));

  // Whoever loads the vehicle waits for what the group says, and then has
  // nothing to search.
  const std::uint64_t searched = policy_.monitor->Read().second_searches;
  EXPECT_GE(searched, behind.size());
  scopes_.HoldGroups();
  Reload();
  // Each read is behind what was begun before it.
  for (int i = 0; i < 20; ++i) {
    session_->GoOnWithChecks();
    ReadNow(*session_).IgnoreError();
  }
  const int reads = scopes_.groups_read();
  scopes_.ReleaseGroups();
  ASSERT_TRUE(Eventually([&] {
    session_->GoOnWithChecks();
    ReadNow(*session_).IgnoreError();
    return scopes_.groups_read() > reads + 2;
  }));
  EXPECT_EQ(policy_.monitor->Read().second_searches, searched);
  EXPECT_EQ(changed(), behind);

  // A rejected candidate is heeded near its place alone.
  ASSERT_TRUE(come_to_be_searched({}, {}));
  const Answer<std::vector<std::uint64_t>> near_place;
  session_->Read([&, near_place](const absl::StatusOr<VehicleView>& view) {
    const core::PoseGraph& graph = view->drive.graph();
    std::vector<std::uint64_t> sequences;
    for (const auto& [sequence, basis] : before) {
      if (std::abs(TravelledAt(graph, sequence) - TravelledAt(graph, place)) <=
          core::kPlaceRadiusMeters) {
        sequences.push_back(sequence);
      }
    }
    near_place.Set(sequences);
  });
  const std::vector<std::uint64_t> near = near_place.Get();
  ASSERT_THAT(near, Contains(place));
  ASSERT_LT(near.size(), behind.size());
  EXPECT_TRUE(come_to_be_searched({tie("~no")}, near));
  // They found what they had found.
  EXPECT_EQ(Events().size(), told);
}

TEST_F(GroupChecksTest, ALinkConfirmsWhatLiesAtItsPlacesUntilItGoes) {
  const InVan first = FindInVan().front();
  EXPECT_LE(first.candidate.place_first, first.candidate.matched_sequence);
  EXPECT_GE(first.candidate.place_last, first.candidate.matched_sequence);
  EXPECT_EQ(first.candidate.group, "site");
  const CheckGroup::Link link{PairKind::kLoopClosure,           "tie",
                              first.id.check_sequence,          "uid-of-van",
                              first.candidate.matched_sequence, "bob"};
  // Another vehicle's, and one elsewhere, say nothing.
  CheckGroup::Link of_other = link;
  of_other.id = "a-other";
  of_other.other_uid = "uid-of-another-van";
  scopes_.SetGroup(WithMembers({of_other, link}));
  const auto is_confirmed = [](const StoredCandidate& candidate) {
    return candidate.state == CandidateState::kConfirmed &&
           candidate.cause == CandidateCause::kLoopClosure &&
           candidate.decision == "tie" && candidate.actor == "bob";
  };
  ASSERT_TRUE(ComesToHold([&](const InVan& one) {
    return !IsAt(link, one.id.check_sequence, one.candidate) ||
           is_confirmed(one.candidate);
  }));
  EXPECT_EQ(CountTold(first.id, "confirmed by tie, said bob"), 1u);
  const std::vector<InVan> all = AllInVan();
  EXPECT_TRUE(std::any_of(all.begin(), all.end(), [](const InVan& one) {
    return one.candidate.state == CandidateState::kOpen;
  }));

  // Nothing is told again: not by a later look, nor another server's.
  const std::size_t told = Events().size();
  for (int i = 0; i < 2; ++i) {
    scopes_.SetGroup(WithMembers({link}));
    Reload();
    ASSERT_TRUE(ComesToHold([](const InVan&) { return true; }));
    ReadNow(*session_).IgnoreError();
  }
  CloseNow(*session_);
  EXPECT_EQ(Events().size(), told);

  session_ = Load();
  scopes_.SetGroup(WithMembers());
  ASSERT_TRUE(ComesToHold([](const InVan& one) {
    return one.candidate.state == CandidateState::kOpen;
  }));
  EXPECT_EQ(CountTold(first.id, "open"), 2u);
  for (const InVan& one : AllInVan()) {
    if (one.id.check_sequence != first.id.check_sequence ||
        one.id.number != first.id.number) {
      continue;
    }
    EXPECT_EQ(one.candidate.cause, CandidateCause::kDeletion);
    EXPECT_EQ(one.candidate.decision, "");
  }
}

TEST_F(GroupChecksTest, ARejectedCandidateRejectsUntilItGoesOrALinkSaysMore) {
  const InVan first = FindInVan().front();
  const CheckGroup::Link rejection{
      PairKind::kRejectedCandidate,     "no",
      first.id.check_sequence,          "uid-of-van",
      first.candidate.matched_sequence, "eve"};
  const auto comes_to = [&](CandidateState state, const std::string& decision) {
    return ComesToHold([&](const InVan& one) {
      return !IsAt(rejection, one.id.check_sequence, one.candidate) ||
             (one.candidate.state == state &&
              one.candidate.decision == decision);
    });
  };
  scopes_.SetGroup(WithMembers({rejection}));
  ASSERT_TRUE(comes_to(CandidateState::kRejected, "no"));
  EXPECT_EQ(CountTold(first.id, "rejected by no, said eve"), 1u);
  CheckGroup::Link link = rejection;
  link.kind = PairKind::kLoopClosure;
  link.id = "tie";
  // What is decided stays so, until the pair that decided goes.
  scopes_.SetGroup(WithMembers({link, rejection}));
  ASSERT_TRUE(comes_to(CandidateState::kRejected, "no"));
  scopes_.SetGroup(WithMembers({link}));
  ASSERT_TRUE(comes_to(CandidateState::kConfirmed, "tie"));
  scopes_.SetGroup(WithMembers());
  ASSERT_TRUE(comes_to(CandidateState::kOpen, ""));
}

TEST_F(GroupChecksTest, ACheckThatIsMadeAfterTheLinkIsDecidedToo) {
  // The places are found by a first vehicle of the same path.
  const std::vector<InVan> found = FindInVan();
  const InVan last = found.back();
  ASSERT_THAT(DeleteNow(*session_), IsOk());
  CloseNow(*session_);
  const CheckGroup::Link link{PairKind::kLoopClosure,          "tie",
                              last.id.check_sequence,          "uid-of-van",
                              last.candidate.matched_sequence, ""};
  scopes_.SetGroup(WithMembers({link}));
  Create(GroupConfig());
  for (std::uint64_t first = 1; first <= 200; first += 20) {
    ASSERT_THAT(AppendNow(*session_, SquareBatch(first, 20)), IsOk());
  }
  ASSERT_TRUE(IsPaid());
  EXPECT_TRUE(Eventually([&] {
    const std::vector<InVan> all = AllInVan();
    return std::any_of(all.begin(), all.end(), [&](const InVan& one) {
      return IsAt(link, one.id.check_sequence, one.candidate) &&
             one.candidate.state == CandidateState::kConfirmed;
    });
  }));
}

TEST_F(GroupChecksTest, WhatIsInVehiclesThatAreNoMembersIsWithdrawn) {
  const std::vector<InVan> found = FindInVan();
  const auto is_withdrawn = [](const InVan& one) {
    return one.candidate.state == CandidateState::kWithdrawn &&
           one.candidate.cause == CandidateCause::kRetention;
  };
  // Another one of that name is another one; of a damaged one nothing is known.
  CheckGroup group = WithMembers();
  group.members["van"] = "";
  scopes_.SetGroup(group);
  ASSERT_TRUE(ComesToHold([](const InVan& one) {
    return one.candidate.state == CandidateState::kOpen;
  }));
  group.members["van"] = "uid-of-another-van";
  scopes_.SetGroup(group);
  ASSERT_TRUE(ComesToHold(is_withdrawn));
  EXPECT_EQ(CountTold(found.front().id, "withdrawn"), 1u);
  Reload();
  scopes_.SetNoGroup();
  ASSERT_TRUE(ComesToHold(is_withdrawn));
  EXPECT_EQ(CountTold(found.front().id, "withdrawn"), 1u);
}

TEST_F(GroupChecksTest, AGroupThatIsGoneLeavesNothingOpen) {
  FindInVan();
  scopes_.SetNoGroup();
  EXPECT_TRUE(ComesToHold([](const InVan& one) {
    return one.candidate.state == CandidateState::kWithdrawn;
  }));
}

TEST_F(GroupChecksTest, AnotherGroupSaysNothingOfWhatWasFound) {
  const std::vector<InVan> found = FindInVan();
  scopes_.SetGroup(WithMembers());
  SearchIn("another");
  scopes_.SetAnother(WithMembers({LinkAt(found.front())}));
  const std::size_t told = Events().size();
  Reload();
  for (int i = 0; i < 3; ++i) {
    session_->GoOnWithChecks();
    ReadNow(*session_).IgnoreError();
  }
  CloseNow(*session_);
  EXPECT_EQ(Events().size(), told);
  session_ = Load();
}

TEST_F(GroupChecksTest, TheGroupInWhichItWasFoundDecidesAboutACandidate) {
  const std::vector<InVan> found = FindInVan();
  const CheckGroup::Link link = LinkAt(found.front());
  const auto has_state = [&](CandidateState state) {
    return [&found, state](const InVan& one) {
      return one.id.check_sequence != found.front().id.check_sequence ||
             one.id.number != found.front().id.number ||
             one.candidate.state == state;
    };
  };
  scopes_.SetGroup(WithMembers());
  for (const char* const searched : {"another", ""}) {
    SearchIn(searched);
    scopes_.SetGroup(WithMembers({link}));
    EXPECT_TRUE(ComesToHold(has_state(CandidateState::kConfirmed))) << searched;
    EXPECT_EQ(AllInVan().front().candidate.decision, "a");
    // Whoever loads the vehicle finds the group by its candidates.
    Reload();
    scopes_.SetGroup(WithMembers());
    EXPECT_TRUE(ComesToHold(has_state(CandidateState::kOpen))) << searched;
  }
  scopes_.SetNoGroup();
  EXPECT_TRUE(ComesToHold(has_state(CandidateState::kWithdrawn)));
}

TEST_F(GroupChecksTest, AGroupWithoutCandidatesIsAskedForNoMoreOnceLeft) {
  scopes_.Answer(CheckScopePtr());
  scopes_.SetGroup(WithMembers());
  Create(GroupConfig());
  ASSERT_THAT(AppendNow(*session_, SquareBatch(1, kPoses)), IsOk());
  ASSERT_TRUE(IsPaid());
  ASSERT_THAT(Events(), Not(IsEmpty()));
  const auto look = [this] {
    session_->GoOnWithChecks();
    ReadNow(*session_).IgnoreError();
  };
  look();
  const int searched = scopes_.groups_read();
  look();
  ASSERT_GT(scopes_.groups_read(), searched);
  SearchIn("");
  look();
  const int left = scopes_.groups_read();
  for (int i = 0; i < 3; ++i) look();
  EXPECT_EQ(scopes_.groups_read(), left);
}

}  // namespace
}  // namespace revisit::server
