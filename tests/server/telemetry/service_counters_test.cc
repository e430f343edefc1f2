#include "server/telemetry/service_counters.h"

#include <thread>
#include <vector>

#include "absl/status/status.h"
#include "absl/strings/string_view.h"
#include "gmock/gmock.h"
#include "gtest/gtest.h"
#include "server/base/status.h"

namespace revisit::server {
namespace {

using std::chrono::milliseconds;
using ::testing::Contains;
using ::testing::ElementsAre;
using ::testing::IsEmpty;
using ::testing::Pair;

constexpr int kOk = 0;
constexpr int kNotFound = 5;

const ServiceCounters::Method& MethodOf(const ServiceCounters::Counts& counts,
                                        absl::string_view name) {
  for (const ServiceCounters::Method& method : counts.methods) {
    if (name == method.rule->method) return method;
  }
  ADD_FAILURE() << name;
  return counts.methods.front();
}

core::CandidateSet SetOf(const std::vector<core::Verdict>& verdicts) {
  core::CandidateSet set;
  for (const core::Verdict verdict : verdicts) {
    core::Candidate candidate;
    candidate.verdict = verdict;
    set.candidates.push_back(candidate);
  }
  set.nodes_considered = 5000;
  return set;
}

TEST(ServiceCountersTest, CountsCallsByMethodAndCode) {
  ServiceCounters counters;
  const MethodRule* const get = FindMethodRule("GetVehicle");
  const MethodRule* const stream = FindMethodRule("StreamPoses");
  for (int i = 0; i < 3; ++i) {
    counters.Began(get);
    counters.Ended(get, i == 0 ? kNotFound : kOk,
                   i == 0 ? "VEHICLE_NOT_FOUND" : "", milliseconds(20));
    counters.Left(get);
  }
  counters.Began(stream);
  const ServiceCounters::Counts counts = counters.Read();
  const auto& gets = MethodOf(counts, "GetVehicle");
  EXPECT_EQ(gets.open, 0);
  EXPECT_EQ(gets.ended[kOk], 2u);
  EXPECT_EQ(gets.ended[kNotFound], 1u);
  EXPECT_NEAR(gets.seconds.sum, 0.06, 1e-12);
  EXPECT_THAT(counts.errors, Contains(Pair("VEHICLE_NOT_FOUND", 1u)));
  EXPECT_THAT(counts.errors, Contains(Pair("OVERLOADED", 0u)));
  const auto& streams = MethodOf(counts, "StreamPoses");
  EXPECT_EQ(streams.open, 1);
  EXPECT_THAT(streams.seconds.counts, IsEmpty());
}

TEST(ServiceCountersTest, ACodeOrReasonThatItDoesNotKnowHasAPlaceToo) {
  ServiceCounters counters;
  const MethodRule* const get = FindMethodRule("GetVehicle");
  counters.Ended(get, 99, "NO_SUCH_REASON", milliseconds(1));
  counters.Ended(get, -1, "", milliseconds(1));
  counters.Began(nullptr);
  counters.Ended(nullptr, kOk, "", milliseconds(1));
  counters.Left(nullptr);
  const ServiceCounters::Counts counts = counters.Read();
  EXPECT_EQ(MethodOf(counts, "GetVehicle").ended[2], 2u);
  EXPECT_STREQ(CodeName(99), "UNKNOWN");
  EXPECT_THAT(counts.errors, Contains(Pair("UNSPECIFIED", 2u)));
}

TEST(ServiceCountersTest, TellsNewPosesFromRepeatedAndRefusedOnes) {
  ServiceCounters counters;
  counters.Acknowledged(10, 10, milliseconds(5));
  counters.Acknowledged(10, 4, milliseconds(5));
  counters.Acknowledged(10, 0, milliseconds(5));
  counters.Refused(
      7, Error(absl::StatusCode::kFailedPrecondition, "SEQUENCE_GAP", "a gap"));
  counters.Refused(2, absl::InternalError("without a reason"));
  counters.Refused(0, absl::InternalError("no poses"));
  const ServiceCounters::Counts counts = counters.Read();
  EXPECT_EQ(counts.poses_accepted, 14u);
  EXPECT_EQ(counts.poses_repeated, 16u);
  EXPECT_THAT(counts.poses_refused, Contains(Pair("SEQUENCE_GAP", 7u)));
  EXPECT_THAT(counts.poses_refused, Contains(Pair("INTERNAL", 2u)));
  EXPECT_NEAR(counts.ack_seconds.sum, 0.015, 1e-12);
}

TEST(ServiceCountersTest, TheOutcomeOfASearchIsItsBestVerdictOrWhyItHasNone) {
  using core::Verdict;
  EXPECT_STREQ(OutcomeOf(SetOf({Verdict::kAmbiguous, Verdict::kAccepted})),
               "accepted");
  EXPECT_STREQ(
      OutcomeOf(SetOf({Verdict::kRejectedByGate, Verdict::kAmbiguous})),
      "rejected_by_gate");
  core::CandidateSet none = SetOf({});
  none.empty_reason = core::EmptyReason::kNoHistory;
  EXPECT_STREQ(OutcomeOf(none), "no_history");
  none.empty_reason = core::EmptyReason::kTooMuchWork;
  EXPECT_STREQ(OutcomeOf(none), "too_much_work");
  EXPECT_STREQ(OutcomeOf(absl::CancelledError("stopped")), "stopped");
  EXPECT_STREQ(OutcomeOf(absl::InternalError("failed")), "failed");
}

TEST(ServiceCountersTest, CountsSearchesAndTheirCandidates) {
  using core::Verdict;
  ServiceCounters counters;
  counters.Searched(SetOf({Verdict::kAccepted, Verdict::kAmbiguous}),
                    milliseconds(30));
  counters.Searched(absl::CancelledError("stopped"), milliseconds(70));
  const ServiceCounters::Counts counts = counters.Read();
  EXPECT_THAT(counts.searches, Contains(Pair("accepted", 1u)));
  EXPECT_THAT(counts.searches, Contains(Pair("stopped", 1u)));
  EXPECT_THAT(counts.searches, Contains(Pair("failed", 0u)));
  EXPECT_THAT(counts.candidates, Contains(Pair("accepted", 1u)));
  EXPECT_THAT(counts.candidates, Contains(Pair("ambiguous", 1u)));
  // A search that was stopped has no say in how long searches take.
  EXPECT_NEAR(counts.search_seconds.sum, 0.03, 1e-12);
  EXPECT_DOUBLE_EQ(counts.search_nodes.sum, 5000.0);
}

TEST(ServiceCountersTest, CountsDecisionsByKind) {
  ServiceCounters counters;
  counters.Decided(Decision::kCandidateRejected);
  counters.Decided(Decision::kDataLossAccepted);
  counters.Decided(Decision::kDataLossAccepted);
  EXPECT_THAT(
      counters.Read().decisions,
      ElementsAre(Pair("loop_closure_added", 0u),
                  Pair("loop_closure_deleted", 0u),
                  Pair("candidate_rejected", 1u), Pair("rejection_deleted", 0u),
                  Pair("poses_revised", 0u), Pair("data_loss_accepted", 2u)));
}

TEST(ServiceCountersTest, LosesNothingThatSeveralThreadsCount) {
  ServiceCounters counters;
  const MethodRule* const get = FindMethodRule("GetVehicle");
  constexpr int kEach = 5000;
  std::vector<std::thread> threads;
  for (int i = 0; i < 4; ++i) {
    threads.emplace_back([&] {
      for (int j = 0; j < kEach; ++j) {
        counters.Began(get);
        counters.Ended(get, kOk, "", milliseconds(1));
        counters.Left(get);
        counters.Acknowledged(3, 2, milliseconds(1));
      }
    });
  }
  for (std::thread& thread : threads) thread.join();
  const ServiceCounters::Counts counts = counters.Read();
  EXPECT_EQ(MethodOf(counts, "GetVehicle").ended[kOk], 4u * kEach);
  EXPECT_EQ(MethodOf(counts, "GetVehicle").open, 0);
  EXPECT_EQ(counts.poses_accepted, 8u * kEach);
  EXPECT_EQ(counts.poses_repeated, 4u * kEach);
}

}  // namespace
}  // namespace revisit::server
