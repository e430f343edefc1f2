#include "server/sessions/second_searches.h"

#include <algorithm>
#include <chrono>
#include <cmath>
#include <cstdint>
#include <map>
#include <memory>
#include <string>
#include <thread>
#include <vector>

#include "core/drive/drive.h"
#include "core/drive/node_range.h"
#include "core/search/search.h"
#include "gmock/gmock.h"
#include "gtest/gtest.h"
#include "server/sessions/check_changes.h"
#include "tests/random.h"
#include "tests/server/error_matchers.h"
#include "tests/server/sessions/session_testing.h"
#include "tests/server/sessions/stored_checks_testing.h"
#include "tests/server/waiting.h"

namespace revisit::server {
namespace {

using ::testing::Contains;
using ::testing::HasSubstr;
using ::testing::IsEmpty;
using ::testing::Not;

class SecondSearchesTest : public StoredChecksTest {
 protected:
  void CreateDriven(std::uint64_t poses = kPoses) {
    Create(StoringConfig());
    ASSERT_THAT(AppendNow(*session_, SquareBatch(1, poses)), IsOk());
    ASSERT_TRUE(IsPaid());
  }

  std::map<std::uint64_t, StoredCheck> Stored() {
    std::map<std::uint64_t, StoredCheck> stored;
    for (const CheckRecord& record : Checks()) {
      stored[record.sequence] = *check_codec_.DecodeCheck(record.payload);
    }
    return stored;
  }

  // Whether all second searches come to be made, however often more are
  // allowed.
  bool IsFresh() {
    return Eventually([this] {
      session_->GoOnWithChecks();
      ReadNow(*session_).IgnoreError();
      if (session_->has_waiting_checks()) return false;
      const auto stored = Stored();
      return std::none_of(stored.begin(), stored.end(),
                          [](const auto& one) { return one.second.stale; });
    });
  }

  absl::Status Keep(double probability) {
    return UpdateNow(*session_,
                     [probability](const VehicleView& view) {
                       VehicleConfig config = view.config;
                       config.keep_probability = probability;
                       return absl::StatusOr<VehicleConfig>(config);
                     })
        .status();
  }

  absl::Status Want(int candidates) {
    return UpdateNow(*session_,
                     [candidates](const VehicleView& view) {
                       VehicleConfig config = view.config;
                       config.drive.search.max_candidates = candidates;
                       return absl::StatusOr<VehicleConfig>(config);
                     })
        .status();
  }

  absl::Status Close(const std::string& id, std::uint64_t query,
                     std::uint64_t matched) {
    return AddPairNow(*session_, PairKind::kLoopClosure,
                      {id, query, matched, 5})
        .status();
  }

  absl::Status Reject(const std::string& id, std::uint64_t query,
                      std::uint64_t matched) {
    return AddPairNow(*session_, PairKind::kRejectedCandidate,
                      {id, query, matched, 5})
        .status();
  }

  // What a search at the pose of a check finds now: as bytes, and the poses of
  // those candidates that are worth keeping, with the distance travelled there.
  struct Anew {
    std::string bytes;
    std::vector<double> kept_at;
  };
  struct Fresh {
    std::map<std::uint64_t, Anew> anew;
    // The distance travelled at each matched pose of the stored checks.
    std::map<std::uint64_t, double> travelled;
  };
  Fresh SearchAllAnew(const std::map<std::uint64_t, StoredCheck>& stored) {
    const Answer<Fresh> answer;
    session_->Search("test", [&](const absl::StatusOr<VehicleView>& view) {
      Fresh fresh;
      const core::PoseGraph& graph = view->drive.graph();
      for (const auto& [sequence, check] : stored) {
        const auto set = view->search->At(*graph.NodeAtOrBefore(sequence),
                                          view->config.drive.search, nullptr);
        Anew& one = fresh.anew[sequence];
        one.bytes = check_codec_.EncodeFound(*view, *set, {}, nullptr);
        for (const core::Candidate& candidate : set->candidates) {
          if (IsWorthKeeping(candidate, view->config.keep_probability)) {
            one.kept_at.push_back(
                graph.node(candidate.matched).travelled_meters);
          }
        }
        for (const StoredCandidate& candidate : check.candidates) {
          fresh.travelled[candidate.matched_sequence] =
              graph.node(*graph.NodeAtOrBefore(candidate.matched_sequence))
                  .travelled_meters;
        }
      }
      answer.Set(std::move(fresh));
      return true;
    });
    return answer.Get();
  }

  // What is stored is what searches find now, and events are dense and say what
  // the rows say.
  void ExpectAsSearchedAnew() {
    const std::map<std::uint64_t, StoredCheck> stored = Stored();
    const Fresh fresh = SearchAllAnew(stored);
    for (const auto& [sequence, check] : stored) {
      const Anew& anew = fresh.anew.at(sequence);
      const bool is_undecided =
          std::any_of(check.candidates.begin(), check.candidates.end(),
                      [](const StoredCandidate& candidate) {
                        return candidate.state == CandidateState::kOpen ||
                               candidate.state == CandidateState::kWithdrawn;
                      });
      if (!is_undecided) continue;
      EXPECT_EQ(check.latest.empty() ? check.found : check.latest, anew.bytes)
          << "check " << sequence;
      const auto is_at = [&](const StoredCandidate& candidate, double place) {
        return std::abs(fresh.travelled.at(candidate.matched_sequence) -
                        place) <= core::kPlaceRadiusMeters;
      };
      for (const StoredCandidate& candidate : check.candidates) {
        const bool is_found =
            std::any_of(anew.kept_at.begin(), anew.kept_at.end(),
                        [&](double place) { return is_at(candidate, place); });
        if (candidate.state == CandidateState::kOpen) {
          EXPECT_TRUE(is_found) << sequence << "/" << candidate.number;
        }
      }
      for (const double place : anew.kept_at) {
        EXPECT_TRUE(std::any_of(check.candidates.begin(),
                                check.candidates.end(),
                                [&](const StoredCandidate& candidate) {
                                  return is_at(candidate, place);
                                }))
            << "check " << sequence << " at " << place << " m";
      }
    }
    std::map<std::string, std::string> told;
    const std::vector<EventRecord> events = Events();
    for (std::size_t i = 0; i < events.size(); ++i) {
      EXPECT_EQ(events[i].number, i + 1);
      const std::string text =
          events[i].payload.substr(0, events[i].payload.find_first_of(":,"));
      const std::size_t state = text.find(' ', text.find('/')) + 1;
      told[text.substr(6, state - 7)] = text.substr(state);
    }
    std::map<std::string, std::string> rows;
    for (const auto& [sequence, check] : stored) {
      for (const StoredCandidate& candidate : check.candidates) {
        constexpr const char* kStates[] = {"open", "confirmed", "rejected",
                                           "withdrawn"};
        std::string state = kStates[static_cast<int>(candidate.state)];
        if (!candidate.decision.empty()) state += " by " + candidate.decision;
        rows[std::to_string(sequence) + "/" +
             std::to_string(candidate.number)] = state;
      }
    }
    EXPECT_EQ(told, rows);
  }
};

TEST_F(SecondSearchesTest, ACheckIsSearchedAgainWhenALoopClosureComesAndGoes) {
  CreateDriven();
  const auto before = Stored();
  ASSERT_THAT(Close("link", 200, 120), IsOk());
  ASSERT_TRUE(IsFresh());
  ExpectAsSearchedAnew();
  int changed = 0;
  for (const auto& [sequence, check] : Stored()) {
    if (check.latest.empty()) continue;
    // What was found before the closure cannot depend on it.
    EXPECT_GE(sequence, 200u);
    changed += check.latest != check.found ? 1 : 0;
  }
  EXPECT_GT(changed, 0);
  ASSERT_THAT(DeletePairNow(*session_, PairKind::kLoopClosure, "link"), IsOk());
  ASSERT_TRUE(IsFresh());
  ExpectAsSearchedAnew();
  for (const auto& [sequence, check] : Stored()) {
    EXPECT_EQ(check.found, before.at(sequence).found);
    if (!check.latest.empty()) {
      EXPECT_EQ(check.latest, check.found);
    }
  }
}

TEST_F(SecondSearchesTest, WithdrawsWhatBecameImprobableAndOpensWhatCameBack) {
  CreateDriven();
  const auto open = [this] {
    std::size_t count = 0;
    for (const auto& [sequence, check] : Stored()) {
      count += CheckChanges::OpenCount(check);
    }
    return count;
  };
  const std::size_t before = open();
  ASSERT_THAT(Want(1), IsOk());
  ASSERT_TRUE(IsFresh());
  const std::size_t fewer = open();
  EXPECT_LT(fewer, before);
  ExpectAsSearchedAnew();
  const std::size_t told = Events().size();
  EXPECT_EQ(told, before + (before - fewer));
  ASSERT_THAT(Want(5), IsOk());
  ASSERT_TRUE(IsFresh());
  EXPECT_EQ(open(), before);
  EXPECT_EQ(Events().size(), told + (before - fewer));
  ExpectAsSearchedAnew();
}

TEST_F(SecondSearchesTest, ALateCandidateGetsANumberOfItsOwn) {
  Create(StoringConfig());
  ASSERT_THAT(Want(1), IsOk());
  ASSERT_THAT(AppendNow(*session_, SquareBatch(1, kPoses)), IsOk());
  ASSERT_TRUE(IsPaid());
  const auto before = Stored();
  ASSERT_THAT(Want(5), IsOk());
  ASSERT_TRUE(IsFresh());
  int late = 0;
  for (const auto& [sequence, check] : Stored()) {
    for (std::size_t i = before.at(sequence).candidates.size();
         i < check.candidates.size(); ++i) {
      const StoredCandidate& candidate = check.candidates[i];
      EXPECT_EQ(candidate.number, i + 1);
      EXPECT_EQ(candidate.rank, 0);
      EXPECT_GT(candidate.latest_rank, 0);
      EXPECT_EQ(candidate.cause, CandidateCause::kSearch);
      ++late;
    }
  }
  EXPECT_GT(late, 0);
  ExpectAsSearchedAnew();
}

TEST_F(SecondSearchesTest, ARejectionConcernsNoCheckFarBeforeIt) {
  CreateDriven();
  const Found found = FirstFound();
  ASSERT_THAT(Reject("no", found.check + 60, 5), IsOk());
  ASSERT_TRUE(IsFresh());
  ExpectAsSearchedAnew();
  int again = 0;
  for (const auto& [sequence, check] : Stored()) {
    if (check.latest.empty()) continue;
    ++again;
    EXPECT_GE(sequence + 12, found.check + 60);
  }
  EXPECT_GT(again, 0);
}

TEST_F(SecondSearchesTest, AChangeAllowsSoManySearchesAndTheRestWaits) {
  policy_.searches_per_change = 2;
  policy_.monitor = std::make_shared<CheckMonitor>();
  CreateDriven();
  ASSERT_TRUE(IsFresh());
  const std::size_t all = Stored().size();
  ASSERT_GT(all, 12u);
  const auto searched = [this] {
    return policy_.monitor->Read().second_searches;
  };
  const std::uint64_t before = searched();
  ASSERT_THAT(Keep(0.1), IsOk());
  ASSERT_TRUE(Eventually([&] { return searched() > before; }));
  // More than there is to do, if it were allowed.
  for (int i = 0; i < 50; ++i) {
    EXPECT_THAT(ReadNow(*session_), IsOk());
    std::this_thread::sleep_for(std::chrono::milliseconds(2));
  }
  // Those of the change, and what was saved up before it.
  const std::uint64_t most = 2 * kMostChangesAllowed;
  EXPECT_LE(searched() - before, most);
  const auto stored = Stored();
  EXPECT_GE(static_cast<std::uint64_t>(std::count_if(
                stored.begin(), stored.end(),
                [](const auto& one) { return one.second.stale; })),
            all - most);
  EXPECT_TRUE(session_->has_waiting_checks());
  ASSERT_TRUE(IsFresh());
  EXPECT_GE(searched() - before, all);
  ExpectAsSearchedAnew();
}

TEST_F(SecondSearchesTest, WhoeverLoadsTheVehicleGoesOn) {
  policy_.searches_per_change = 0;
  CreateDriven();
  ASSERT_THAT(Close("link", 200, 120), IsOk());
  ASSERT_TRUE(Eventually([this] {
    const auto stored = Stored();
    return std::any_of(stored.begin(), stored.end(),
                       [](const auto& one) { return one.second.stale; });
  }));
  policy_.searches_per_change = 1000;
  Reload();
  ASSERT_TRUE(IsFresh());
  ExpectAsSearchedAnew();
}

TEST_F(SecondSearchesTest, IsNotStaleWhereTheVehicleIsAgainWhatItWas) {
  policy_.searches_per_change = 0;
  CreateDriven();
  const auto stale = [this] {
    const auto stored = Stored();
    return std::count_if(stored.begin(), stored.end(),
                         [](const auto& one) { return one.second.stale; });
  };
  ASSERT_THAT(Close("link", 200, 120), IsOk());
  ASSERT_TRUE(Eventually([&] { return stale() > 0; }));
  ASSERT_THAT(DeletePairNow(*session_, PairKind::kLoopClosure, "link"), IsOk());
  EXPECT_TRUE(Eventually([&] { return stale() == 0; }));
  EXPECT_TRUE(Eventually([&] { return !session_->has_waiting_checks(); }));
}

TEST_F(SecondSearchesTest, EndsAtWhatSearchesFindWhateverComesBetween) {
  std::mt19937_64 random = SeededRandom();
  for (int round = 0; round < 4; ++round) {
    policy_.searches_per_change = UniformInt(random, 0, 3) == 0 ? 3 : 64;
    if (session_ == nullptr) {
      Create(StoringConfig());
    } else {
      Reload();
    }
    int id = round * 100;
    std::vector<std::pair<PairKind, std::string>> pairs;
    for (int step = 0; step < 25; ++step) {
      const std::uint64_t durable = Record().durable_sequence;
      switch (UniformInt(random, 0, 6)) {
        case 0:
        case 1:
          ASSERT_THAT(AppendNow(*session_, SquareBatch(durable + 1, 20)),
                      IsOk());
          break;
        case 2:
        case 3: {
          if (durable < 60) break;
          const auto query = static_cast<std::uint64_t>(
              UniformInt(random, 50, static_cast<int>(durable)));
          const auto back =
              static_cast<std::uint64_t>(UniformInt(random, 1, 49));
          const PairKind kind = UniformInt(random, 0, 2) == 0
                                    ? PairKind::kRejectedCandidate
                                    : PairKind::kLoopClosure;
          const std::string name = "p" + std::to_string(++id);
          const auto added =
              AddPairNow(*session_, kind, {name, query, query - back, 5});
          if (added.ok()) pairs.emplace_back(kind, name);
          break;
        }
        case 4:
          if (!pairs.empty()) {
            ASSERT_THAT(DeletePairNow(*session_, pairs.back().first,
                                      pairs.back().second),
                        IsOk());
            pairs.pop_back();
          }
          break;
        case 5:
          ASSERT_THAT(Want(UniformInt(random, 1, 5)), IsOk());
          break;
        case 6:
          if (UniformInt(random, 0, 1) == 0) {
            Reload();
          } else {
            // The fate of the next write of checks is unknown.
            storage_.FailNextChecks(BrokenDevice(),
                                    UniformInt(random, 0, 1) == 0);
          }
          break;
      }
    }
    // The last write may fail later than all of this, and is then made again
    // when a fleet looks for what is owed.
    ASSERT_TRUE(Eventually([this] {
      if (session_->gone()) session_ = Load();
      session_->PayChecks();
      return session_->check_debt() == 0 && !HasDebtInStore();
    }));
    ASSERT_TRUE(IsFresh());
    ExpectAsSearchedAnew();
    if (HasFailure()) return;
  }
}

}  // namespace
}  // namespace revisit::server
