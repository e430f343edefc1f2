#include "server/sessions/search_turns.h"

#include <pthread.h>

#include <algorithm>
#include <chrono>
#include <cstddef>
#include <cstdint>
#include <functional>
#include <limits>
#include <map>
#include <memory>
#include <mutex>
#include <optional>
#include <string>
#include <thread>
#include <utility>
#include <vector>

#include "core/drive/pose_graph.h"
#include "core/settings.h"
#include "gmock/gmock.h"
#include "gtest/gtest.h"
#include "server/sessions/fair_executor.h"
#include "server/sessions/vehicle_session.h"
#include "tests/server/error_matchers.h"
#include "tests/server/memory_storage.h"
#include "tests/server/plain_codec.h"
#include "tests/server/sessions/session_testing.h"
#include "tests/server/storage_testing.h"
#include "tests/server/waiting.h"

namespace revisit::server {
namespace {

using absl::StatusCode;
using ::testing::HasSubstr;

using Found = absl::StatusOr<core::CandidateSet>;

constexpr std::int64_t kNoLimit = std::numeric_limits<std::int64_t>::max();
// Longer than a strand keeps its thread: each turn that takes as long gives the
// thread back.
constexpr std::chrono::milliseconds kLongTurn{1};

std::string ThreadName() {
  char name[16] = "";
  pthread_getname_np(pthread_self(), name, sizeof(name));
  return name;
}

// Vehicles of one drive, whose searches share one thread.
class SearchTurnsTest : public ::testing::Test {
 protected:
  ~SearchTurnsTest() override {
    for (const auto& [id, session] : sessions_) CloseNow(*session);
  }

  VehicleSession& Vehicle(const std::string& id) {
    std::shared_ptr<VehicleSession>& session = sessions_[id];
    if (session == nullptr) {
      EXPECT_THAT(BlockingWrites(&memory_).Create(
                      id, codec_.EncodeVehicle(TestConfig())),
                  IsOk());
      session = Load(id);
      EXPECT_THAT(AppendNow(*session, SquareBatch(1, 400)), IsOk());
    }
    return *session;
  }

  std::shared_ptr<VehicleSession> Load(const std::string& id) {
    return VehicleSession::Load(id, &memory_, &codec_,
                                Lanes(&short_work_, &long_work_, &searches_),
                                VehicleSession::Limits());
  }

  // Searches at the newest node, and notes each turn.
  Answer<Found> Search(const std::string& id, std::int64_t most = kNoLimit,
                       std::function<void()> in_first_turn = nullptr,
                       const std::string& flow = "calls") {
    Answer<Found> answer;
    const auto turns = std::make_shared<SearchTurns>(most);
    auto first =
        std::make_shared<std::function<void()>>(std::move(in_first_turn));
    Vehicle(id).Search(flow, [=](const absl::StatusOr<VehicleView>& view) {
      if (!view.ok()) {
        answer.Set(view.status());
        return true;
      }
      if (*first) std::exchange(*first, nullptr)();
      const std::optional<Found> found =
          turns->Take(*view, view->drive.graph().size() - 1,
                      view->config.drive.search, nullptr);
      std::this_thread::sleep_for(kLongTurn);
      Note(found ? id + " ends" : id);
      if (found) answer.Set(*found);
      return found.has_value();
    });
    return answer;
  }

  void Note(const std::string& event) {
    const std::lock_guard<std::mutex> guard(mutex_);
    events_.push_back(event);
  }

  // How many events there were before this one.
  std::size_t Before(const std::string& event) {
    const std::lock_guard<std::mutex> guard(mutex_);
    const auto found = std::find(events_.begin(), events_.end(), event);
    EXPECT_NE(found, events_.end()) << event;
    return static_cast<std::size_t>(found - events_.begin());
  }

  MemoryStorage memory_;
  PlainCodec codec_;
  Executor short_work_{"short", 1};
  Executor long_work_{"long", 1};
  FairExecutor searches_{"searches", 1};
  std::map<std::string, std::shared_ptr<VehicleSession>> sessions_;
  std::mutex mutex_;
  std::vector<std::string> events_;
};

std::vector<std::pair<core::NodeIndex, double>> Places(const Found& found) {
  std::vector<std::pair<core::NodeIndex, double>> places;
  for (const core::Candidate& candidate : found->candidates) {
    places.emplace_back(candidate.matched, candidate.score);
  }
  return places;
}

TEST_F(SearchTurnsTest, EightSearchesOfTheirMarksLeaveAnotherVehicleItsTurn) {
  ASSERT_THAT(Search("other").Get(), IsOk());
  std::vector<std::string> ids;
  for (int i = 0; i < 8; ++i) ids.push_back("v" + std::to_string(i));
  for (const std::string& id : ids) Vehicle(id);
  events_.clear();
  const Answer<Answer<Found>> other;
  std::vector<Answer<Found>> answers;
  for (const std::string& id : ids) {
    answers.push_back(Search(id, kNoLimit,
                             id == "v0" ? [&] { other.Set(Search("other")); }
                                        : std::function<void()>()));
  }
  EXPECT_THAT(other.Get().Get(), IsOk());
  for (const Answer<Found>& answer : answers) EXPECT_THAT(answer.Get(), IsOk());
  // A turn of each that came before, if all of them came by then.
  EXPECT_LE(Before("other ends"), 8u);
  for (const std::string& id : ids) EXPECT_GT(Before(id + " ends"), 8u * 40u);
}

TEST_F(SearchTurnsTest, AnotherCallersSearchGoesFirstWithinATurn) {
  ASSERT_THAT(Search("other").Get(), IsOk());
  Vehicle("long");
  events_.clear();
  const Answer<Answer<Found>> other;
  const Answer<bool> ended;
  const auto turns = std::make_shared<SearchTurns>();
  auto stop = [&, asked = false]() mutable {
    if (!std::exchange(asked, true)) {
      other.Set(Search(
          "other", kNoLimit, [&] { Note("other begins"); },
          "calls of another"));
    }
    std::this_thread::sleep_for(kLongTurn);
    return false;
  };
  Vehicle("long").Search("calls", [&](const absl::StatusOr<VehicleView>& view) {
    const auto start = SearchTurns::Clock::now();
    core::SearchOptions options = view->config.drive.search;
    options.exhaustive = true;
    options.use_belief = false;
    const std::optional<Found> found = turns->Take(
        *view, view->drive.graph().size() - 1, options, std::ref(stop));
    // The other search and its sleep are no part of this turn.
    EXPECT_LE(turns->last_turn() + kLongTurn,
              SearchTurns::Clock::now() - start);
    EXPECT_GT(turns->last_steps(), 0);
    Note("turn");
    EXPECT_TRUE(found.has_value());
    ended.Set(true);
    return true;
  });
  ended.Get();
  EXPECT_THAT(other.Get().Get(), IsOk());
  // Whether it also ends there, hangs on how long a busy machine takes for it.
  EXPECT_EQ(Before("other begins"), 0u);
}

TEST_F(SearchTurnsTest, ChecksOfAStreamDoNotWaitForSearches) {
  Vehicle("streamed");
  std::vector<std::string> ids;
  for (int i = 0; i < 4; ++i) ids.push_back("v" + std::to_string(i));
  for (const std::string& id : ids) Vehicle(id);
  events_.clear();
  const Answer<bool> over;
  const auto append = std::make_shared<PlainAppend>(SquareBatch(401, 12));
  append->wants = true;
  append->candidates = [&](const VehicleView&, const Found& found) {
    EXPECT_THAT(found, IsOk());
    Note("check");
  };
  append->over = [&] { over.Set(true); };
  const Answer<bool> durable;
  append->durable = [&](const absl::StatusOr<Acknowledgement>&) {
    durable.Set(true);
  };
  const auto append_now = [&] {
    Vehicle("streamed").Append(append->Request(), append);
    durable.Get();
  };
  std::vector<Answer<Found>> answers;
  for (const std::string& id : ids) {
    answers.push_back(Search(
        id, kNoLimit, id == "v0" ? append_now : std::function<void()>()));
  }
  over.Get();
  for (const Answer<Found>& answer : answers) EXPECT_THAT(answer.Get(), IsOk());
  for (const std::string& id : ids) {
    EXPECT_GT(Before(id + " ends"), Before("check"));
  }
}

TEST_F(SearchTurnsTest, ChecksOfAStreamLeaveAnotherVehicleItsTurn) {
  ASSERT_THAT(Search("other").Get(), IsOk());
  Vehicle("streamed");
  events_.clear();
  const Answer<Answer<Found>> other;
  const Answer<bool> over;
  const auto append = std::make_shared<PlainAppend>(SquareBatch(401, 12));
  append->wants = true;
  append->should_stop = [&, asked = false]() mutable {
    if (!std::exchange(asked, true)) other.Set(Search("other"));
    std::this_thread::sleep_for(kLongTurn);
    return false;
  };
  append->candidates = [&](const VehicleView&, const Found& found) {
    EXPECT_THAT(found, IsOk());
    Note("check");
  };
  append->over = [&] { over.Set(true); };
  Vehicle("streamed").Append(append->Request(), append);
  over.Get();
  EXPECT_THAT(other.Get().Get(), IsOk());
  EXPECT_EQ(Before("other ends"), 0u);
  EXPECT_GE(events_.size(), 3u);
}

TEST_F(SearchTurnsTest, AVehicleIsReadBetweenTurnsAndSearchedOneAfterAnother) {
  Vehicle("v");
  const Answer<Answer<Found>> second;
  const Answer<bool> read;
  const Answer<Found> first = Search("v", kNoLimit, [&] {
    Vehicle("v").Read([&](const absl::StatusOr<VehicleView>& view) {
      EXPECT_THAT(view.status(), IsOk());
      Note("read");
      read.Set(true);
    });
    // Has nothing left to learn.
    second.Set(Search("v", kNoLimit, [&] { Note("second begins"); }));
  });
  ASSERT_THAT(first.Get(), IsOk());
  ASSERT_THAT(second.Get().Get(), IsOk());
  read.Get();
  EXPECT_LE(Before("read"), 2u);
  EXPECT_EQ(Before("second begins"), Before("v ends") + 1);
}

TEST_F(SearchTurnsTest, MarksCountAmongTheComparisonsOfTheSearchThatMadeThem) {
  const Found first = Search("v").Get();
  const Found second = Search("v").Get();
  ASSERT_THAT(first, IsOk());
  ASSERT_THAT(second, IsOk());
  EXPECT_EQ(Places(first), Places(second));
  EXPECT_GT(first->comparisons, 10 * second->comparisons);
}

TEST_F(SearchTurnsTest, SearchesThatMayDoLittleComeToTheSameAnswerInTheEnd) {
  const Found at_once = Search("v").Get();
  ASSERT_THAT(at_once, IsOk());
  ASSERT_FALSE(at_once->candidates.empty());
  const Found whole = Search("w").Get();
  for (const std::int64_t share : {1000, 3}) {
    const std::string id = "by-" + std::to_string(share);
    const std::int64_t most = whole->comparisons / share;
    int refused = 0;
    Found found = Search(id, most).Get();
    while (absl::IsResourceExhausted(found.status()) && refused < 100) {
      ++refused;
      found = Search(id, most).Get();
    }
    ASSERT_THAT(found, IsOk());
    EXPECT_EQ(Places(found), Places(at_once));
    if (share == 3) {
      EXPECT_GE(refused, 2);
      EXPECT_LE(refused, 4);
      EXPECT_LE(found->comparisons, most);
    } else {
      EXPECT_GT(refused, 40);
    }
  }
}

TEST_F(SearchTurnsTest, SearchThatWaitsForItsVehicleRunsAmongTheSearches) {
  Vehicle("v");
  CloseNow(*sessions_["v"]);
  for (int i = 0; i < 20; ++i) {
    sessions_["v"] = Load("v");
    const Answer<std::string> thread;
    sessions_["v"]->Search("calls",
                           [&](const absl::StatusOr<VehicleView>& view) {
                             EXPECT_THAT(view.status(), IsOk());
                             thread.Set(ThreadName());
                             return true;
                           });
    EXPECT_EQ(thread.Get(), "searches");
    CloseNow(*sessions_["v"]);
  }
}

TEST_F(SearchTurnsTest, SearchesEndWithTheirVehicle) {
  Vehicle("v");
  const Answer<Answer<Found>> second;
  const Answer<absl::Status> deleted;
  const Answer<Found> first = Search("v", kNoLimit, [&] {
    Vehicle("v").Delete(deleted.Setter());
    second.Set(Search("v"));
  });
  EXPECT_THAT(deleted.Get(), IsOk());
  const auto not_found =
      IsError(StatusCode::kNotFound, "VEHICLE_NOT_FOUND", HasSubstr("'v'"));
  EXPECT_THAT(first.Get(), not_found);
  EXPECT_THAT(second.Get().Get(), not_found);
}

}  // namespace
}  // namespace revisit::server
