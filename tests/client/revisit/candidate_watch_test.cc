#include "client/revisit/candidate_watch.h"

#include <chrono>
#include <functional>
#include <future>
#include <memory>
#include <optional>
#include <string>
#include <thread>
#include <utility>
#include <vector>

#include "client/revisit/channel.h"
#include "client/revisit/status.h"
#include "gmock/gmock.h"
#include "grpcpp/channel.h"
#include "gtest/gtest.h"
#include "tests/client/fake_server.h"
#include "tests/client/stored_candidates.h"

namespace revisit::client {
namespace {

using std::chrono::milliseconds;
using std::chrono::seconds;
using ::testing::ElementsAre;
using ::testing::HasSubstr;
using ::testing::SizeIs;

constexpr seconds kPatience{60};

// "uid of a 3" for event 3 of the vehicle a, "vehicles/a deleted 4", and "list
// NAME matched 10" for a candidate of a list.
std::string TextOf(const WatchedEvent& event) {
  const v1::WatchCandidatesResponse& message = event.message;
  if (message.has_vehicle_deleted()) {
    return message.vehicle_deleted().vehicle() + " deleted " +
           std::to_string(message.vehicle_deleted().number());
  }
  const v1::CandidateEvent& told = message.candidate();
  if (event.resynchronised) {
    return "list " + told.candidate().name() + " matched " +
           std::to_string(told.evidence().matched().sequence());
  }
  return told.vehicle_uid() + " " + std::to_string(told.number());
}

class CandidateWatchTest : public ::testing::Test {
 protected:
  CandidateWatchTest() {
    options_.backoff.initial = milliseconds(1);
    options_.backoff.max = milliseconds(5);
    callbacks_.event = [this](const WatchedEvent& event) {
      told_.push_back(TextOf(event));
      absl::Status status = fault_ ? fault_(event) : absl::OkStatus();
      if (status.ok() && told_.size() == enough_) watch_->Cancel();
      return status;
    };
    callbacks_.moved = [this](const std::string& cursor) {
      moved_.push_back(cursor);
      return absl::OkStatus();
    };
    callbacks_.resynchronised = [this](const absl::Status& why) {
      told_.push_back("lost: " + DetailsOf(why).reason);
    };
    callbacks_.disconnected = [this](const absl::Status& why,
                                     std::chrono::nanoseconds) {
      broken_.push_back(why);
      if (broken_.size() == kMostBreaks) watch_->Cancel();
    };
  }

  // Watches until so many lines were told, or it ends by itself.
  absl::Status WatchUntil(std::size_t lines) {
    enough_ = lines;
    watch_ = std::make_unique<CandidateWatch>(
        MakeInsecureChannel(server_.address()), options_, callbacks_);
    auto run = std::async(std::launch::async, [this] { return watch_->Run(); });
    if (run.wait_for(kPatience) != std::future_status::ready) {
      ADD_FAILURE() << "it goes on for ever";
      watch_->Cancel();
    }
    return run.get();
  }

  static constexpr std::size_t kMostBreaks = 20;

  FakeServer server_;
  CandidateWatchOptions options_;
  CandidateWatchCallbacks callbacks_;
  // What event() answers.
  std::function<absl::Status(const WatchedEvent&)> fault_;
  std::unique_ptr<CandidateWatch> watch_;
  std::size_t enough_ = 0;
  std::vector<std::string> told_;
  std::vector<std::string> moved_;
  std::vector<absl::Status> broken_;
};

// Ends the first watches, each with one of these, once it was told an event.
std::function<std::optional<grpc::Status>(const WatchStep&)> BreakAfterEach(
    std::vector<grpc::Status> statuses) {
  return [statuses = std::move(statuses), next = std::size_t{0}](
             const WatchStep& step) mutable -> std::optional<grpc::Status> {
    if (step.told == 0 || next == statuses.size()) return std::nullopt;
    return statuses[next++];
  };
}

TEST_F(CandidateWatchTest, BeginsNowAndTellsEventsWithTheCursorBehindThem) {
  server_.AddEvent(EventOf("a", 1));
  callbacks_.event = [this](const WatchedEvent& event) {
    told_.push_back(event.message.cursor());
    watch_->Cancel();
    return absl::OkStatus();
  };
  // The first beat tells where the watch began; then something happens.
  callbacks_.moved = [this](const std::string& cursor) {
    moved_.push_back(cursor);
    if (moved_.size() == 1) server_.AddEvent(EventOf("a", 2));
    return absl::OkStatus();
  };
  EXPECT_TRUE(absl::IsCancelled(WatchUntil(0)));
  EXPECT_THAT(told_, ElementsAre("at 2"));
  EXPECT_THAT(moved_, ElementsAre("at 1", "at 2"));
  EXPECT_EQ(watch_->cursor(), "at 2");
}

TEST_F(CandidateWatchTest, GoesOnBehindTheLastWorkedOffEventAfterABreak) {
  for (std::uint64_t i = 1; i <= 7; ++i) server_.AddEvent(EventOf("a", i));
  server_.FailWatches(BreakAfterEach(
      {MakeStatus(grpc::StatusCode::UNAVAILABLE, "draining",
                  {"SERVER_DRAINING"}),
       MakeStatus(grpc::StatusCode::RESOURCE_EXHAUSTED, "slow",
                  {"SLOW_CONSUMER"}),
       MakeStatus(grpc::StatusCode::DEADLINE_EXCEEDED, "late"),
       MakeStatus(grpc::StatusCode::INTERNAL, "RST_STREAM"), grpc::Status::OK,
       MakeStatus(grpc::StatusCode::UNAUTHENTICATED, "old",
                  {"TOKEN_EXPIRED"})}));
  options_.cursor = "at 0";
  EXPECT_TRUE(absl::IsCancelled(WatchUntil(7)));
  EXPECT_THAT(
      told_, ElementsAre("uid of a 1", "uid of a 2", "uid of a 3", "uid of a 4",
                         "uid of a 5", "uid of a 6", "uid of a 7"));
  EXPECT_THAT(
      server_.WatchCursors(),
      ElementsAre("at 0", "at 1", "at 2", "at 3", "at 4", "at 5", "at 6"));
  EXPECT_THAT(broken_, SizeIs(6));
}

TEST_F(CandidateWatchTest, OutlivesTheServer) {
  server_.AddEvent(EventOf("a", 1));
  options_.cursor = "at 0";
  bool stopped = false;
  callbacks_.disconnected = [&](const absl::Status&, std::chrono::nanoseconds) {
    if (std::exchange(stopped, true)) return;
    server_.Stop();
    server_.AddEvent(EventOf("a", 2));
    server_.Start();
  };
  server_.FailWatches(
      BreakAfterEach({MakeStatus(grpc::StatusCode::UNAVAILABLE, "draining")}));
  EXPECT_TRUE(absl::IsCancelled(WatchUntil(2)));
  EXPECT_THAT(told_, ElementsAre("uid of a 1", "uid of a 2"));
}

TEST_F(CandidateWatchTest, LeavesAConnectionOnWhichNothingComes) {
  options_.answer_timeout = milliseconds(30);
  callbacks_.disconnected = [this](const absl::Status& why,
                                   std::chrono::nanoseconds) {
    broken_.push_back(why);
    watch_->Cancel();
  };
  EXPECT_TRUE(absl::IsCancelled(WatchUntil(1)));
  ASSERT_THAT(broken_, SizeIs(1));
  EXPECT_EQ(broken_[0].message(), "no answer for 30 ms");
}

TEST_F(CandidateWatchTest, DropsEventsThatWereTold) {
  for (const std::uint64_t number : {1, 2, 2, 1, 3}) {
    server_.AddEvent(EventOf("a", number));
    server_.AddEvent(EventOf("b", number));
  }
  options_.cursor = "at 0";
  EXPECT_TRUE(absl::IsCancelled(WatchUntil(6)));
  EXPECT_THAT(told_, ElementsAre("uid of a 1", "uid of b 1", "uid of a 2",
                                 "uid of b 2", "uid of a 3", "uid of b 3"));
  // The cursor goes on behind those too.
  EXPECT_THAT(moved_, SizeIs(10));
}

TEST_F(CandidateWatchTest, TellsThatAVehicleWasDeletedOnce) {
  v1::WatchCandidatesResponse deleted;
  deleted.mutable_vehicle_deleted()->set_vehicle("vehicles/a");
  deleted.mutable_vehicle_deleted()->set_vehicle_uid("uid of a");
  deleted.mutable_vehicle_deleted()->set_number(2);
  server_.AddEvent(EventOf("a", 1));
  server_.AddEvent(deleted);
  server_.AddEvent(deleted);
  // Another vehicle of the name has a uid, and numbers, of its own.
  v1::WatchCandidatesResponse made_again = EventOf("a", 1);
  made_again.mutable_candidate()->set_vehicle_uid("second");
  server_.AddEvent(made_again);
  options_.cursor = "at 0";
  EXPECT_TRUE(absl::IsCancelled(WatchUntil(3)));
  EXPECT_THAT(told_,
              ElementsAre("uid of a 1", "vehicles/a deleted 2", "second 1"));
}

TEST_F(CandidateWatchTest, CursorStaysBeforeAnEventThatWasNotWorkedOff) {
  for (std::uint64_t i = 1; i <= 3; ++i) server_.AddEvent(EventOf("a", i));
  options_.cursor = "at 0";
  fault_ = [](const WatchedEvent& event) {
    // The watch does not take this for a break of its own.
    return event.message.candidate().number() == 2
               ? absl::UnavailableError("the database is away")
               : absl::OkStatus();
  };
  EXPECT_EQ(WatchUntil(0), absl::UnavailableError("the database is away"));
  EXPECT_EQ(watch_->cursor(), "at 1");
  EXPECT_THAT(moved_, ElementsAre("at 1"));
  EXPECT_THAT(server_.WatchCursors(), SizeIs(1));
  // The next watch is told the event.
  options_.cursor = watch_->cursor();
  fault_ = nullptr;
  told_.clear();
  EXPECT_TRUE(absl::IsCancelled(WatchUntil(2)));
  EXPECT_THAT(told_, ElementsAre("uid of a 2", "uid of a 3"));
}

TEST_F(CandidateWatchTest, EndsWhereTheCursorCannotBeKept) {
  server_.AddEvent(EventOf("a", 1));
  options_.cursor = "at 0";
  callbacks_.moved = [](const std::string&) {
    return absl::ResourceExhaustedError("the disk is full");
  };
  EXPECT_EQ(WatchUntil(0), absl::ResourceExhaustedError("the disk is full"));
}

// Refuses the first watches for this reason.
std::function<std::optional<grpc::Status>(const WatchStep&)> LoseFirst(
    int watches, const std::string& reason) {
  return [watches, reason](
             const WatchStep& step) mutable -> std::optional<grpc::Status> {
    if (step.told > 0 || watches == 0) return std::nullopt;
    --watches;
    return MakeStatus(grpc::StatusCode::OUT_OF_RANGE, "lost", {reason});
  };
}

class LostCursorTest : public CandidateWatchTest {
 protected:
  LostCursorTest() {
    server_.set_checks(
        {CheckOf("a", 100,
                 {v1::CANDIDATE_STATE_CONFIRMED, v1::CANDIDATE_STATE_OPEN}),
         CheckOf("a", 1000, {v1::CANDIDATE_STATE_OPEN}),
         CheckOf("a-b", 50, {v1::CANDIDATE_STATE_REJECTED}),
         CheckOf("b", 20, {v1::CANDIDATE_STATE_OPEN})});
  }
};

class LostReasonTest : public LostCursorTest,
                       public ::testing::WithParamInterface<const char*> {};

TEST_P(LostReasonTest, IsMadeUpForByAListOnce) {
  server_.AddEvent(EventOf("a", 1));
  server_.FailWatches(LoseFirst(1, GetParam()));
  options_.cursor = "of another store";
  options_.filter.add_states(v1::CANDIDATE_STATE_OPEN);
  callbacks_.moved = [this](const std::string& cursor) {
    moved_.push_back(cursor);
    server_.AddEvent(EventOf("a", 2));
    return absl::OkStatus();
  };
  EXPECT_TRUE(absl::IsCancelled(WatchUntil(5)));
  EXPECT_THAT(told_,
              ElementsAre(std::string("lost: ") + GetParam(),
                          "list vehicles/a/checks/100/candidates/2 matched 20",
                          "list vehicles/a/checks/1000/candidates/1 matched 10",
                          "list vehicles/b/checks/20/candidates/1 matched 10",
                          "uid of a 2"));
  // Not before the whole list was worked off.
  EXPECT_THAT(moved_, ElementsAre("at 1", "at 2"));
  EXPECT_THAT(server_.WatchCursors(), ElementsAre("of another store", "at 1"));
  ASSERT_THAT(server_.CheckLists(), SizeIs(2));
  EXPECT_EQ(server_.CheckLists()[0].parent(), "vehicles/-");
  EXPECT_EQ(server_.CheckLists()[0].filter().states(0),
            v1::CANDIDATE_STATE_OPEN);
  EXPECT_THAT(broken_, SizeIs(0));
}

INSTANTIATE_TEST_SUITE_P(Reasons, LostReasonTest,
                         ::testing::Values("CURSOR_TOO_OLD", "CURSOR_UNKNOWN"));

TEST_F(LostCursorTest, ListIsReadOnFromThePageThatFailed) {
  server_.FailWatches(LoseFirst(1, "CURSOR_TOO_OLD"));
  server_.FailUnaryCalls(
      {grpc::Status::OK, MakeStatus(grpc::StatusCode::UNAVAILABLE, "away")});
  options_.cursor = "old";
  EXPECT_TRUE(absl::IsCancelled(WatchUntil(6)));
  EXPECT_THAT(told_,
              ElementsAre("lost: CURSOR_TOO_OLD",
                          "list vehicles/a/checks/100/candidates/1 matched 10",
                          "list vehicles/a/checks/100/candidates/2 matched 20",
                          "list vehicles/a/checks/1000/candidates/1 matched 10",
                          "list vehicles/a-b/checks/50/candidates/1 matched 10",
                          "list vehicles/b/checks/20/candidates/1 matched 10"));
  EXPECT_THAT(broken_, SizeIs(1));
}

TEST_F(LostCursorTest, NumbersThatAreGivenOnceMoreAreTold) {
  server_.set_checks({});
  server_.AddEvent(EventOf("a", 7));
  server_.AddEvent(EventOf("a", 8));
  options_.cursor = "at 0";
  // The store is restored from a backup that was made before the second event.
  server_.FailWatches([restored = false](const WatchStep& step) mutable
                      -> std::optional<grpc::Status> {
    if (step.told == 2) {
      return MakeStatus(grpc::StatusCode::UNAVAILABLE, "ends");
    }
    if (step.cursor != "at 2" || std::exchange(restored, true)) {
      return std::nullopt;
    }
    return MakeStatus(grpc::StatusCode::OUT_OF_RANGE, "lost",
                      {"CURSOR_UNKNOWN"});
  });
  // Behind the cursor of the list comes another event of the number 8.
  callbacks_.moved = [this, added = false](const std::string&) mutable {
    if (!server_.CheckLists().empty() && !std::exchange(added, true)) {
      server_.AddEvent(EventOf("a", 8));
    }
    return absl::OkStatus();
  };
  server_.AddEvent(EventOf("b", 1));
  EXPECT_TRUE(absl::IsCancelled(WatchUntil(4)));
  EXPECT_THAT(told_, ElementsAre("uid of a 7", "uid of a 8",
                                 "lost: CURSOR_UNKNOWN", "uid of a 8"));
}

TEST_F(LostCursorTest, CursorStaysWhereACandidateOfTheListIsNotWorkedOff) {
  server_.FailWatches(LoseFirst(1, "CURSOR_UNKNOWN"));
  options_.cursor = "old";
  fault_ = [this](const WatchedEvent&) {
    return told_.size() == 4 ? absl::DataLossError("no") : absl::OkStatus();
  };
  EXPECT_EQ(WatchUntil(0), absl::DataLossError("no"));
  EXPECT_EQ(watch_->cursor(), "old");
  EXPECT_THAT(moved_, SizeIs(0));
}

TEST_F(LostCursorTest, WaitsWhereTheCursorOfTheListIsLostToo) {
  server_.set_checks({});
  server_.FailWatches(LoseFirst(3, "CURSOR_UNKNOWN"));
  options_.cursor = "old";
  callbacks_.moved = [this](const std::string&) {
    // Another event, so that the first beat behind the list moves the cursor.
    server_.AddEvent(EventOf("a", moved_.size() + 1));
    moved_.push_back("");
    return absl::OkStatus();
  };
  EXPECT_TRUE(absl::IsCancelled(WatchUntil(4)));
  EXPECT_EQ(told_.back(), "uid of a 3");
  // The first list was made at once.
  EXPECT_THAT(broken_, SizeIs(2));
  EXPECT_THAT(server_.CheckLists(), SizeIs(3));
}

TEST_F(LostCursorTest, ListThatDoesNotGoOnEndsTheWatch) {
  server_.FailWatches(LoseFirst(1, "CURSOR_UNKNOWN"));
  server_.EndListsLike(ListEnd::kRepeatsUnderFreshTokens);
  options_.cursor = "old";
  const absl::Status status = WatchUntil(0);
  EXPECT_TRUE(absl::IsInternal(status)) << status;
  EXPECT_THAT(std::string(status.message()), HasSubstr("does not go on"));
}

TEST_F(LostCursorTest, BeginsWithWhatIsOpenWhereNothingElseIsSaid) {
  options_.begin_with_list = true;
  EXPECT_TRUE(absl::IsCancelled(WatchUntil(3)));
  EXPECT_THAT(told_,
              ElementsAre("list vehicles/a/checks/100/candidates/2 matched 20",
                          "list vehicles/a/checks/1000/candidates/1 matched 10",
                          "list vehicles/b/checks/20/candidates/1 matched 10"));
}

TEST_F(LostCursorTest, DoesNotBeginWithAListWhereThereIsACursor) {
  options_.begin_with_list = true;
  options_.cursor = "at 0";
  server_.AddEvent(EventOf("a", 1));
  EXPECT_TRUE(absl::IsCancelled(WatchUntil(1)));
  EXPECT_THAT(told_, ElementsAre("uid of a 1"));
}

TEST_F(CandidateWatchTest, EndsWithAnErrorThatNoAttemptMends) {
  for (const auto& [code, reason] :
       {std::pair(grpc::StatusCode::PERMISSION_DENIED, "NOT_GRANTED"),
        std::pair(grpc::StatusCode::INVALID_ARGUMENT, "INVALID_CURSOR"),
        std::pair(grpc::StatusCode::OUT_OF_RANGE, "LIMIT_EXCEEDED"),
        // Nobody has answered yet, so no token was good before.
        std::pair(grpc::StatusCode::UNAUTHENTICATED, "TOKEN_EXPIRED"),
        std::pair(grpc::StatusCode::UNIMPLEMENTED, "")}) {
    server_.FailWatches([code = code, reason = reason](const WatchStep&) {
      return MakeStatus(code, "no", {reason});
    });
    EXPECT_EQ(WatchUntil(0).code(), static_cast<absl::StatusCode>(code));
  }
  EXPECT_THAT(broken_, SizeIs(0));
}

TEST_F(CandidateWatchTest, IsCancelledWhileItWaits) {
  // For the server, for another attempt, and before it begins.
  options_.backoff.initial = options_.backoff.max = seconds(3600);
  for (const bool broken : {false, true}) {
    server_.FailWatches([broken](const WatchStep&) {
      return broken ? std::optional(
                          MakeStatus(grpc::StatusCode::UNAVAILABLE, "away"))
                    : std::nullopt;
    });
    CandidateWatch watch(MakeInsecureChannel(server_.address()), options_,
                         callbacks_);
    const std::size_t before = server_.WatchCursors().size();
    auto run = std::async(std::launch::async, [&] { return watch.Run(); });
    while (server_.WatchCursors().size() == before) {
      std::this_thread::sleep_for(milliseconds(1));
    }
    watch.Cancel();
    ASSERT_EQ(run.wait_for(kPatience), std::future_status::ready);
    EXPECT_TRUE(absl::IsCancelled(run.get()));
  }
  CandidateWatch watch(MakeInsecureChannel(server_.address()), options_,
                       callbacks_);
  watch.Cancel();
  EXPECT_TRUE(absl::IsCancelled(watch.Run()));
}

TEST_F(CandidateWatchTest, FilterOfAListIsThatOfTheServer) {
  v1::Check check =
      CheckOf("a", 100, {v1::CANDIDATE_STATE_OPEN, v1::CANDIDATE_STATE_OPEN});
  const auto both = [&check](const v1::CandidateFilter& filter) {
    return std::pair(Matches(filter, check, check.states(0)),
                     Matches(filter, check, check.states(1)));
  };
  v1::CandidateFilter filter;
  EXPECT_EQ(both(filter), std::pair(true, true));
  filter.add_vehicles("vehicles/b");
  EXPECT_EQ(both(filter), std::pair(false, false));
  filter.add_vehicles("vehicles/a");
  EXPECT_EQ(both(filter), std::pair(true, true));
  filter.set_least_probability(0.1);
  EXPECT_EQ(both(filter), std::pair(true, false));
  filter.clear_least_probability();
  filter.add_verdicts(v1::VERDICT_AMBIGUOUS);
  EXPECT_EQ(both(filter), std::pair(false, true));
  filter.add_states(v1::CANDIDATE_STATE_CONFIRMED);
  EXPECT_EQ(both(filter), std::pair(false, false));
  // Without a probability, as of COMPOSITE alignments.
  check.mutable_candidates()->mutable_candidates(0)->clear_probability();
  filter.Clear();
  filter.set_least_probability(0.01);
  EXPECT_EQ(both(filter), std::pair(false, true));
  filter.Clear();
  filter.set_least_value_square_meters(2.5);
  EXPECT_EQ(both(filter), std::pair(false, false));
  check.mutable_states(1)->set_value_square_meters(2.5);
  EXPECT_EQ(both(filter), std::pair(false, true));
}

TEST_F(CandidateWatchTest, EvidenceIsThatOfTheLastSearchThatFoundIt) {
  v1::Check check =
      CheckOf("a", 100, {v1::CANDIDATE_STATE_OPEN, v1::CANDIDATE_STATE_OPEN});
  SearchAgain(&check, 2, 0.7, 1.0);
  EXPECT_EQ(EvidenceOf(check, check.states(0))->probability(), 0.9);
  EXPECT_EQ(EvidenceOf(check, check.states(1))->probability(), 0.7);
  EXPECT_NEAR(FirstEvidenceOf(check, check.states(1))->probability(), 0.09,
              1e-12);
  v1::CandidateFilter filter;
  filter.set_least_probability(0.5);
  EXPECT_TRUE(Matches(filter, check, check.states(1)));
  // A candidate that only a search between the first and the last one found.
  check.mutable_states(1)->set_rank(0);
  EXPECT_EQ(FirstEvidenceOf(check, check.states(1)), nullptr);
  check.mutable_states(1)->set_latest_rank(0);
  EXPECT_EQ(EvidenceOf(check, check.states(1)), nullptr);
  EXPECT_FALSE(Matches(filter, check, check.states(1)));
}

TEST_F(LostCursorTest, ListTellsTheRevisionOfTheSearchThatFoundIt) {
  v1::Check check =
      CheckOf("a", 100, {v1::CANDIDATE_STATE_OPEN, v1::CANDIDATE_STATE_OPEN});
  SearchAgain(&check, 2, 0.7, 1.0);
  server_.set_checks({check});
  options_.begin_with_list = true;
  std::vector<std::uint64_t> revisions;
  callbacks_.event = [&](const WatchedEvent& event) {
    revisions.push_back(event.message.candidate().revision());
    return revisions.size() < 2 ? absl::OkStatus()
                                : absl::AbortedError("enough");
  };
  CandidateWatch watch(MakeInsecureChannel(server_.address()), options_,
                       callbacks_);
  EXPECT_TRUE(absl::IsAborted(watch.Run()));
  EXPECT_THAT(revisions, ElementsAre(7, 9));
}

}  // namespace
}  // namespace revisit::client
