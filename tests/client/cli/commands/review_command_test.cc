#include "client/cli/commands/review_command.h"

#include <sstream>
#include <string>
#include <vector>

#include "gmock/gmock.h"
#include "nlohmann/json.hpp"
#include "tests/client/cli/commands/command_test.h"
#include "tests/client/stored_candidates.h"

namespace revisit::client {
namespace {

using ::testing::ElementsAre;
using ::testing::HasSubstr;
using ::testing::IsEmpty;
using ::testing::Not;
using ::testing::SizeIs;

// "90/2" of "vehicles/a/checks/90/candidates/2".
std::string Short(const std::string& name) {
  const std::string marks[] = {"/checks/", "/candidates/"};
  const std::size_t check = name.find(marks[0]) + marks[0].size();
  const std::size_t candidate = name.find(marks[1]);
  return name.substr(check, candidate - check) + "/" +
         name.substr(candidate + marks[1].size());
}

class ReviewCommandTest : public CommandTest {
 protected:
  // By value: 90/2, 150/1, 90/1, 110/1.
  ReviewCommandTest() {
    v1::Check first =
        CheckOf("a", 90, {v1::CANDIDATE_STATE_OPEN, v1::CANDIDATE_STATE_OPEN});
    first.mutable_states(0)->set_value_square_meters(0.5);
    SearchAgain(&first, 2, 0.25, 2.0);
    v1::Check second = CheckOf("a", 110, {v1::CANDIDATE_STATE_OPEN});
    second.mutable_states(0)->set_value_square_meters(0.125);
    v1::Check third = CheckOf(
        "a", 150, {v1::CANDIDATE_STATE_OPEN, v1::CANDIDATE_STATE_CONFIRMED});
    third.mutable_states(0)->set_value_square_meters(1.0);
    third.mutable_states(1)->set_value_square_meters(8.0);
    checks_ = {first, second, third};
    options_.vehicle = "a";
    server_.set_checks(checks_);
  }

  // Returns what was said on the lines of JSON: "show 90/1", "confirmed 90/1".
  std::vector<std::string> Review(const std::string& keys) {
    out_.str("");
    progress_.str("");
    std::istringstream answers(keys);
    status_ = RunReview(client_, options_, answers, Json());
    std::vector<std::string> said;
    std::istringstream text(out_.str());
    for (std::string line; std::getline(text, line);) {
      const auto told = nlohmann::json::parse(line);
      const bool is_decision = told.contains("decision");
      const std::string name =
          is_decision ? told["candidate"] : told["candidate"]["name"];
      said.push_back(
          (is_decision ? told["decision"].get<std::string>() : "show") + " " +
          Short(name));
    }
    return said;
  }

  std::vector<v1::Check> checks_;
  ReviewOptions options_;
  absl::Status status_;
};

TEST_F(ReviewCommandTest, ShowsOpenCandidatesByValueAndDoesWhatAKeySays) {
  EXPECT_THAT(
      Review("c\nr\n\ns\n"),
      ElementsAre("show 90/2", "confirmed 90/2", "show 150/1", "rejected 150/1",
                  "show 90/1", "skipped 90/1", "show 110/1", "skipped 110/1"));
  EXPECT_TRUE(status_.ok()) << status_;
  EXPECT_THAT(server_.Decisions(),
              ElementsAre("confirm vehicles/a/checks/90/candidates/2 90-20",
                          "reject vehicles/a/checks/150/candidates/1 150-10"));
  EXPECT_THAT(progress_.str(),
              HasSubstr("1 confirmed, 1 rejected, 2 skipped\n"));
}

TEST_F(ReviewCommandTest, ValuesAreThoseAfterTheLastDecision) {
  // Confirming the first one makes the next most valuable one worthless.
  server_.ChangeChecks([](std::vector<v1::Check>* checks) {
    if ((*checks)[0].states(1).state() == v1::CANDIDATE_STATE_CONFIRMED) {
      (*checks)[2].mutable_states(0)->set_value_square_meters(0.0);
    }
  });
  EXPECT_THAT(Review("c\nq\n"),
              ElementsAre("show 90/2", "confirmed 90/2", "show 90/1"));
}

TEST_F(ReviewCommandTest, FlagsLeaveCandidatesOut) {
  options_.filter.set_least_value_square_meters(1.0);
  options_.fresh_only = true;
  EXPECT_THAT(Review("s\ns\n"), ElementsAre("show 90/2", "skipped 90/2",
                                            "show 150/1", "skipped 150/1"));
  const v1::ListChecksRequest asked = server_.CheckLists()[0];
  EXPECT_EQ(asked.order(), v1::LIST_CHECKS_ORDER_BY_VALUE);
  EXPECT_TRUE(asked.fresh_only());
  EXPECT_EQ(asked.filter().least_value_square_meters(), 1.0);
  EXPECT_THAT(asked.filter().states(), ElementsAre(v1::CANDIDATE_STATE_OPEN));
}

TEST_F(ReviewCommandTest, UndoTakesTheLastDecisionBackAndShowsItAgain) {
  EXPECT_THAT(Review("c\nr\nu\nu\nu\nq\n"),
              ElementsAre("show 90/2", "confirmed 90/2", "show 150/1",
                          "rejected 150/1", "show 90/1", "undone 150/1",
                          "show 150/1", "undone 90/2", "show 90/2"));
  EXPECT_THAT(server_.Deleted(),
              ElementsAre("vehicles/a/rejectedCandidates/new",
                          "vehicles/a/loopClosures/new"));
  EXPECT_THAT(progress_.str(), HasSubstr("nothing is left to undo\n"));
  EXPECT_THAT(progress_.str(),
              HasSubstr("0 confirmed, 0 rejected, 0 skipped\n"));
}

TEST_F(ReviewCommandTest, LastDecisionIsUndoneAlsoWhereNothingIsLeft) {
  options_.filter.set_least_value_square_meters(1.5);
  EXPECT_THAT(Review("c\nx\nu\n"), ElementsAre("show 90/2", "confirmed 90/2",
                                               "undone 90/2", "show 90/2"));
  EXPECT_THAT(progress_.str(), HasSubstr("no more open candidates\n"));
  EXPECT_THAT(progress_.str(),
              HasSubstr("got \"x\"; allowed is u (undo), q or an empty line"));
}

TEST_F(ReviewCommandTest, OtherKeysAreToldWithWhatIsAllowed) {
  EXPECT_THAT(Review("yes\n c \nq\n"),
              ElementsAre("show 90/2", "confirmed 90/2", "show 150/1"));
  EXPECT_THAT(progress_.str(),
              HasSubstr("got \"yes\"; allowed is c (confirm), r (reject), s or "
                        "an empty line (skip), u (undo), q (quit)\n"));
}

TEST_F(ReviewCommandTest, EndOfTheInputEndsIt) {
  EXPECT_THAT(Review(""), ElementsAre("show 90/2"));
  EXPECT_TRUE(status_.ok());
  EXPECT_THAT(server_.Decisions(), IsEmpty());
}

TEST_F(ReviewCommandTest, NoteGoesWithEachDecision) {
  options_.note = "by eye";
  Review("c\nq\n");
  ASSERT_THAT(server_.AddedClosures(), SizeIs(1));
  EXPECT_EQ(server_.AddedClosures()[0].loop_closure().note(), "by eye");
}

TEST_F(ReviewCommandTest, WhatSomebodyElseDecidedMeanwhileIsLeft) {
  server_.ChangeChecks([reads = 0](std::vector<v1::Check>* checks) mutable {
    // After it was listed, and before it is read for the key.
    if (reads++ == 1) {
      (*checks)[0].mutable_states(1)->set_state(v1::CANDIDATE_STATE_REJECTED);
    }
  });
  EXPECT_THAT(Review("c\nq\n"), ElementsAre("show 90/2", "show 150/1"));
  EXPECT_THAT(server_.Decisions(), IsEmpty());
  EXPECT_THAT(progress_.str(),
              HasSubstr("too late for vehicles/a/checks/90/candidates/2: it is "
                        "open no longer\n"));
}

TEST_F(ReviewCommandTest, DecisionThatComesTooLateIsToldAndLeft) {
  // A page of the list, the candidate read again, and its decision.
  server_.FailUnaryCalls(
      {grpc::Status::OK, grpc::Status::OK,
       MakeStatus(grpc::StatusCode::FAILED_PRECONDITION, "it is a closure",
                  {"POSE_PAIR_CONFLICT"})});
  EXPECT_THAT(Review("r\nq\n"), ElementsAre("show 90/2", "show 150/1"));
  EXPECT_TRUE(status_.ok()) << status_;
  EXPECT_THAT(progress_.str(), HasSubstr("(POSE_PAIR_CONFLICT)"));
  EXPECT_THAT(progress_.str(), HasSubstr("0 rejected"));
}

TEST_F(ReviewCommandTest, ErrorEndsIt) {
  server_.FailUnaryCalls(
      {grpc::Status::OK, grpc::Status::OK,
       MakeStatus(grpc::StatusCode::PERMISSION_DENIED, "not you")});
  Review("c\nq\n");
  EXPECT_EQ(ExitCodeOf(status_), 71);
}

TEST_F(ReviewCommandTest, CandidateThatNoSearchTellsIsLeftOpen) {
  checks_[0].mutable_states(1)->set_rank(0);
  checks_[0].mutable_states(1)->set_latest_rank(0);
  server_.set_checks(checks_);
  EXPECT_THAT(Review("c\nq\n"), ElementsAre("show 90/2", "show 150/1"));
  EXPECT_THAT(server_.Decisions(), IsEmpty());
  EXPECT_THAT(progress_.str(), HasSubstr("no search tells its two poses"));
}

TEST_F(ReviewCommandTest, TextHasWhatWasToldThenAndIsFoundNow) {
  v1::Candidate* const found =
      checks_[0].mutable_latest()->mutable_candidates(0);
  found->mutable_matched()->set_travelled_meters(19.5);
  found->mutable_difference()->set_x_meters(1.25);
  found->mutable_difference()->set_heading_radians(-0.5);
  v1::Covariance* const covariance =
      found->mutable_difference()->mutable_covariance();
  covariance->set_form(v1::COVARIANCE_FORM_PLANAR_6);
  for (const double value : {0.25, 0.0, 0.0, 4.0, 0.0, 0.01}) {
    covariance->add_values(value);
  }
  checks_[0].set_stale(true);
  server_.set_checks(checks_);
  std::istringstream answers("c\nq\n");
  ASSERT_TRUE(RunReview(client_, options_, answers, Text()).ok());
  EXPECT_THAT(
      out_.str(),
      HasSubstr(
          "vehicles/a/checks/90/candidates/2\n"
          "  query       sequence 90, 0.0 m\n"
          "  match       sequence 20, 19.5 m\n"
          "  value       2.000 m2\n"
          "  told then   probability 0.0900, AMBIGUOUS, of revision 7\n"
          "  found now   probability 0.2500, AMBIGUOUS, of revision 9\n"
          "  difference  x 1.25 +- 0.500 m, y 0.00 +- 2.000 m, heading -0.5000 "
          "+- 0.10000 rad\n"
          "  stale: what this rests on has changed, and it waits to be "
          "searched again\n"
          "confirmed vehicles/a/checks/90/candidates/2\n\n"));
  EXPECT_THAT(out_.str(), Not(HasSubstr("contradicted")));
}

TEST_F(ReviewCommandTest, TextTellsWhatOnlyOneOfTheSearchesFound) {
  checks_[0].mutable_states(1)->set_rank(0);
  server_.set_checks(checks_);
  std::istringstream answers("s\ns\ns\n");
  ASSERT_TRUE(RunReview(client_, options_, answers, Text()).ok());
  EXPECT_THAT(out_.str(), HasSubstr("told then   nothing: a later search found "
                                    "it\n  found now   probability 0.2500"));
  EXPECT_THAT(out_.str(),
              HasSubstr("told then   probability 0.9000, ACCEPTED, of revision "
                        "7\n  found now   nothing of it, of revision 9\n"));
}

class ContradictedReviewTest : public ReviewCommandTest {
 protected:
  // The candidate 150-20, whose loop closure is the first one of the server's.
  ContradictedReviewTest() {
    v1::CheckCandidate* const candidate = checks_[2].mutable_states(1);
    candidate->set_state(v1::CANDIDATE_STATE_OPEN);
    candidate->set_cause(v1::CANDIDATE_CAUSE_CONTRADICTION);
    candidate->set_decision("vehicles/a/loopClosures/150-20");
    // It comes first whatever it is worth.
    candidate->set_value_square_meters(0.0);
    server_.set_checks(checks_);
  }
};

TEST_F(ContradictedReviewTest, TextSaysWhatItsKeysDo) {
  std::istringstream answers("q\n");
  ASSERT_TRUE(RunReview(client_, options_, answers, Text()).ok());
  EXPECT_THAT(out_.str(), HasSubstr("checks/150/candidates/2\n"));
  EXPECT_THAT(out_.str(), HasSubstr("contradicted: the loop closure that "
                                    "confirmed it says something else than "
                                    "others that agree; c upholds it, r "
                                    "deletes it\n"));
}

TEST_F(ContradictedReviewTest, ConfirmingUpholdsTheClosure) {
  EXPECT_THAT(Review("c\nu\nq\n"),
              ElementsAre("show 150/2", "upheld 150/2", "show 90/2"));
  ASSERT_THAT(server_.AddedClosures(), SizeIs(1));
  EXPECT_EQ(server_.AddedClosures()[0].loop_closure_id(), "150-20");
  EXPECT_EQ(server_.AddedClosures()[0].candidate(),
            "vehicles/a/checks/150/candidates/2");
  // It was there before, so it is not deleted.
  EXPECT_THAT(server_.Deleted(), IsEmpty());
  EXPECT_THAT(progress_.str(),
              HasSubstr("vehicles/a/loopClosures/150-20 was there before"));
}

TEST_F(ContradictedReviewTest, RejectingDeletesTheClosureAndUndoAddsItAgain) {
  EXPECT_THAT(Review("r\nu\nq\n"),
              ElementsAre("show 150/2", "rejected 150/2", "show 90/2",
                          "undone 150/2", "show 90/2"));
  EXPECT_THAT(server_.Deleted(),
              ElementsAre("vehicles/a/loopClosures/150-20",
                          "vehicles/a/rejectedCandidates/new"));
  ASSERT_THAT(server_.AddedClosures(), SizeIs(1));
  EXPECT_EQ(server_.AddedClosures()[0].loop_closure_id(), "150-20");
  EXPECT_EQ(server_.AddedClosures()[0].loop_closure().query_sequence(), 150u);
}

}  // namespace
}  // namespace revisit::client
