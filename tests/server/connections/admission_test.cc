#include "server/connections/admission.h"

#include <chrono>
#include <cstddef>
#include <cstdint>
#include <map>
#include <random>
#include <set>
#include <string>
#include <thread>
#include <vector>

#include "absl/strings/cord.h"
#include "gmock/gmock.h"
#include "google/rpc/error_details.pb.h"
#include "gtest/gtest.h"
#include "server/base/status.h"
#include "tests/server/error_matchers.h"

namespace revisit::server {
namespace {

using absl::StatusCode;
using ::testing::HasSubstr;

Limits Small() {
  Limits limits;
  limits.max_calls = 2;
  limits.max_calls_per_caller = 1;
  limits.max_calls_per_vehicle = 2;
  limits.max_rebuilt_poses = 1000;
  limits.max_rebuilt_poses_per_caller = 600;
  limits.max_streams = 3;
  limits.max_streams_per_caller = 2;
  limits.max_streams_per_vehicle = 2;
  limits.max_searches = 3;
  limits.max_searches_per_vehicle = 2;
  limits.max_queued_bytes = 1000;
  limits.max_queued_bytes_per_vehicle = 600;
  return limits;
}

std::int64_t NoMemory() { return 0; }

constexpr std::chrono::hours kEver{24};

template <typename Message>
Message DetailOf(const absl::Status& status, const char* url) {
  Message message;
  const auto payload = status.GetPayload(url);

  EXPECT_TRUE(payload && message.ParseFromString(std::string(*payload)));
  return message;
}

double RetrySeconds(const absl::Status& status) {
  const auto delay =
      DetailOf<google::rpc::RetryInfo>(status, kRetryInfoUrl).retry_delay();
  return static_cast<double>(delay.seconds()) + delay.nanos() * 1e-9;
}

TEST(AdmissionTest, RoomIsGivenBackWhenThePermitGoes) {
  Admission admission(Small(), 1, NoMemory);
  std::vector<Permit> permits;
  for (int i = 0; i < 2; ++i) {
    auto permit = admission.Call("");
    ASSERT_TRUE(permit.ok()) << permit.status();
    permits.push_back(*permit);
  }
  const absl::Status refused = admission.Call("").status();
  EXPECT_THAT(refused, IsError(StatusCode::kUnavailable, "OVERLOADED",
                               HasSubstr("limit")));
  permits.pop_back();
  EXPECT_TRUE(admission.Call("").ok());
}

TEST(AdmissionTest, CountsRefusalsByTheSettingThatIsTheLimit) {
  const auto refusals = [](const Admission& admission) {
    std::map<std::string, std::uint64_t> counts;
    const auto read = admission.refusals().Read();
    for (std::size_t i = 0; i < kLimitCount; ++i) {
      if (read[i] != 0) counts[kLimitNames[i]] = read[i];
    }
    return counts;
  };
  Admission admission(Small(), 1, NoMemory);
  std::vector<Permit> permits;
  const auto take = [&](const absl::StatusOr<Permit>& permit) {
    if (permit.ok()) permits.push_back(*permit);
  };
  EXPECT_TRUE(refusals(admission).empty());
  for (int i = 0; i < 5; ++i) {
    take(admission.Call(""));
    take(admission.StreamOf("v"));
    take(admission.CallOf("v"));
    take(admission.Search("v", "", kEver));
    take(admission.Queue("v", 500));
  }
  EXPECT_FALSE(admission.TooManySteps("v").ok());
  for (int i = 0; i < 3; ++i) take(admission.Rebuild("a", 300));
  for (int i = 0; i < 3; ++i) take(admission.Rebuild("b", 300));
  for (int i = 0; i < 3; ++i) take(admission.Stream("a"));
  for (int i = 0; i < 3; ++i) take(admission.Stream("b"));
  const std::map<std::string, std::uint64_t> expected = {
      {"max-calls", 3},
      {"max-calls-per-vehicle", 3},
      {"max-queued-bytes-per-vehicle", 4},
      // The second and third of b.
      {"max-rebuilt-poses", 2},
      {"max-rebuilt-poses-per-caller", 1},
      {"max-search-steps", 1},
      {"max-searches-per-vehicle", 3},
      // The second of b finds none left of all.
      {"max-streams", 2},
      {"max-streams-per-caller", 1},
      {"max-streams-per-vehicle", 3}};
  EXPECT_EQ(refusals(admission), expected);
  for (const Admission::Use& use : admission.uses()) {
    const std::string limit = use.limit;
    EXPECT_EQ(use.taken, limit == "max-calls"           ? 2
                         : limit == "max-queued-bytes"  ? 500
                         : limit == "max-rebuilt-poses" ? 900
                         : limit == "max-searches"      ? 2
                         : limit == "max-streams"       ? 3
                                                        : 0)
        << limit;
    EXPECT_GE(use.most, use.taken) << limit;
  }
}

TEST(AdmissionTest, RefusalSaysWhoseLimitItIsAndWhenToComeAgain) {
  Admission admission(Small(), 1, NoMemory);
  const auto first = admission.StreamOf("v");
  const auto second = admission.StreamOf("v");
  std::set<double> delays;
  for (int i = 0; i < 20; ++i) {
    const absl::Status refused = admission.StreamOf("v").status();
    EXPECT_THAT(refused, IsError(StatusCode::kResourceExhausted, "STREAM_QUOTA",
                                 HasSubstr("limit")));
    EXPECT_THAT(std::string(refused.message()), HasSubstr("vehicles/v"));
    const auto quota =
        DetailOf<google::rpc::QuotaFailure>(refused, kQuotaFailureUrl);
    ASSERT_EQ(quota.violations_size(), 1);
    EXPECT_EQ(quota.violations(0).subject(), "vehicles/v");
    EXPECT_EQ(quota.violations(0).description(), refused.message());
    const auto info = DetailOf<google::rpc::ErrorInfo>(refused, kErrorInfoUrl);
    EXPECT_EQ(info.metadata().at("limit"), "2");
    const double delay = RetrySeconds(refused);
    EXPECT_GE(delay, 1.0);
    EXPECT_LE(delay, 3.0);
    delays.insert(delay);
  }
  EXPECT_GT(delays.size(), 5u);
}

TEST(AdmissionTest, OneCallersStreamsLeaveRoomForAnother) {
  Admission admission(Small(), 1, NoMemory);
  const auto first = admission.Stream("a");
  const auto second = admission.Stream("a");
  EXPECT_THAT(admission.Stream("a").status(),
              IsError(StatusCode::kResourceExhausted, "STREAM_QUOTA",
                      HasSubstr("limit")));
  const auto third = admission.Stream("b");
  EXPECT_TRUE(third.ok());
  EXPECT_THAT(
      admission.Stream("b").status(),
      IsError(StatusCode::kUnavailable, "OVERLOADED", HasSubstr("limit")));
}

TEST(AdmissionTest, OneCallersCallsLeaveRoomForAnother) {
  Limits limits;
  limits.max_calls = 3;
  limits.max_calls_per_caller = 2;
  Admission admission(limits, 1, NoMemory);
  std::vector<Permit> permits;
  for (int i = 0; i < 2; ++i) permits.push_back(*admission.Call("a"));
  const absl::Status refused = admission.Call("a").status();
  EXPECT_THAT(refused, IsError(StatusCode::kResourceExhausted, "QUEUE_FULL",
                               HasSubstr("limit")));
  const auto quota =
      DetailOf<google::rpc::QuotaFailure>(refused, kQuotaFailureUrl);
  ASSERT_EQ(quota.violations_size(), 1);
  EXPECT_EQ(quota.violations(0).subject(), "caller");
  EXPECT_GT(RetrySeconds(refused), 0.0);
  permits.push_back(*admission.Call("b"));
  EXPECT_THAT(
      admission.Call("c").status(),
      IsError(StatusCode::kUnavailable, "OVERLOADED", HasSubstr("limit")));
  // Calls that end, or are given up, leave nothing behind.
  permits.clear();
  for (int i = 0; i < 2; ++i) permits.push_back(*admission.Call("a"));
  EXPECT_FALSE(admission.Call("a").ok());
}

TEST(AdmissionTest, CallsAboutOneVehicleLeaveRoomForAnother) {
  Limits limits;
  limits.max_calls_per_vehicle = 2;
  Admission admission(limits, 1, NoMemory);
  std::vector<Permit> permits;
  for (int i = 0; i < 2; ++i) permits.push_back(*admission.CallOf("v"));
  const absl::Status refused = admission.CallOf("v").status();
  EXPECT_THAT(refused, IsError(StatusCode::kResourceExhausted, "QUEUE_FULL",
                               HasSubstr("vehicles/v")));
  EXPECT_GT(RetrySeconds(refused), 0.0);
  EXPECT_TRUE(admission.CallOf("w").ok());
  permits.pop_back();
  EXPECT_TRUE(admission.CallOf("v").ok());
}

TEST(AdmissionTest, GraphsThatAreMadeAnewAreBoundedByTheirPoses) {
  Admission admission(Small(), 1, NoMemory);
  auto first = admission.Rebuild("a", 500);
  ASSERT_TRUE(first.ok());
  EXPECT_THAT(admission.Rebuild("a", 101).status(),
              IsError(StatusCode::kResourceExhausted, "QUEUE_FULL",
                      HasSubstr("limit")));
  const auto little = admission.Rebuild("a", 100);
  EXPECT_TRUE(little.ok());
  EXPECT_THAT(
      admission.Rebuild("b", 401).status(),
      IsError(StatusCode::kUnavailable, "OVERLOADED", HasSubstr("limit")));
  const auto second = admission.Rebuild("b", 400);
  EXPECT_TRUE(second.ok());
  first = absl::CancelledError();
  EXPECT_TRUE(admission.Rebuild("a", 500).ok());
}

TEST(AdmissionTest, LargeVehicleIsMadeAnewWhileOthersAre) {
  Admission admission(Small(), 1, NoMemory);
  const auto of_another = admission.Rebuild("a", 400);
  ASSERT_TRUE(of_another.ok());
  const auto large = admission.Rebuild("b", 1'000'000);
  EXPECT_TRUE(large.ok()) << large.status();
  EXPECT_FALSE(admission.Rebuild("b", 1).ok());
}

TEST(AdmissionTest, CallersWithoutANameShareNoLimit) {
  Admission admission(Small(), 1, NoMemory);
  const auto first = admission.Stream("");
  const auto second = admission.Stream("");
  EXPECT_TRUE(admission.Stream("").ok());
}

TEST(AdmissionTest, RoomForNothingIsAlwaysThereAndLeavesNothingBehind) {
  Admission admission(Small(), 1, NoMemory);
  auto something = admission.Queue("v", 600);
  auto nothing = admission.Queue("v", 0);
  ASSERT_TRUE(something.ok());
  ASSERT_TRUE(nothing.ok()) << nothing.status();
  // In the order in which a call lets go of them: the vehicle is forgotten with
  // the first.
  something->reset();
  nothing->reset();
  for (int i = 0; i < 2; ++i) {
    const auto again = admission.Queue("v", 600);
    EXPECT_TRUE(again.ok()) << again.status();
  }
  nothing = admission.Queue("w", 0);
  ASSERT_TRUE(nothing.ok());
  const auto of_same_vehicle = admission.Queue("w", 600);
  EXPECT_TRUE(of_same_vehicle.ok());
}

TEST(AdmissionTest, PermitsMayBeGivenBackInAnyOrder) {
  std::mt19937 random(20101018);
  Admission admission(Small(), 1, NoMemory);
  const std::string vehicles[] = {"", "v", "w"};
  std::vector<Permit> permits;
  for (int i = 0; i < 10000; ++i) {
    if (random() % 2 == 0 && !permits.empty()) {
      permits.erase(permits.begin() +
                    static_cast<std::ptrdiff_t>(random() % permits.size()));
      continue;
    }
    const std::int64_t bytes = random() % 4 == 0 ? 0 : random() % 300;
    auto permit = admission.Queue(vehicles[random() % 3], bytes);
    if (permit.ok()) permits.push_back(*permit);
  }
  permits.clear();
  const auto all = admission.Queue("v", 600);
  EXPECT_TRUE(all.ok()) << all.status();
  const auto rest = admission.Queue("w", 400);
  EXPECT_TRUE(rest.ok()) << rest.status();
}

TEST(AdmissionTest, SearchesOfOneVehicleLeaveRoomForAnother) {
  Admission admission(Small(), 1, NoMemory);
  const auto first = admission.Search("v", "", kEver);
  const auto second = admission.Search("v", "", kEver);
  EXPECT_THAT(admission.Search("v", "", kEver).status(),
              IsError(StatusCode::kResourceExhausted, "SEARCH_QUOTA",
                      HasSubstr("limit")));
  const auto third = admission.Search("w", "", kEver);
  EXPECT_TRUE(third.ok());
  EXPECT_THAT(
      admission.Search("x", "", kEver).status(),
      IsError(StatusCode::kUnavailable, "OVERLOADED", HasSubstr("limit")));
}

TEST(AdmissionTest,
     CallerWithinItsShareHasRoomForSearchesHoweverManyOthersHave) {
  Limits limits;
  limits.max_searches = 4;
  Admission admission(limits, 1, NoMemory);
  const auto search = [&](const std::string& caller) {
    return admission.Search("v", caller, kEver);
  };
  std::vector<Permit> greedy;
  for (int i = 0; i < 4; ++i) greedy.push_back(*search("greedy"));
  EXPECT_THAT(
      search("greedy").status(),
      IsError(StatusCode::kUnavailable, "OVERLOADED", HasSubstr("limit")));
  std::vector<Permit> others;
  for (int i = 0; i < 2; ++i) {
    auto permit = search("b");
    ASSERT_TRUE(permit.ok()) << permit.status();
    others.push_back(*permit);
  }
  // Two of four are what each of two callers has.
  for (const char* const caller : {"b", "greedy"}) {
    const absl::Status refused = search(caller).status();
    EXPECT_THAT(refused, IsError(StatusCode::kResourceExhausted, "SEARCH_QUOTA",
                                 HasSubstr("share")));
    EXPECT_EQ(DetailOf<google::rpc::QuotaFailure>(refused, kQuotaFailureUrl)
                  .violations(0)
                  .subject(),
              "caller");
    EXPECT_GT(RetrySeconds(refused), 0.0);
  }
  // However many callers there are, one search is always within the share.
  for (const char* const caller : {"c", "d", "e", "f"}) {
    auto permit = search(caller);
    ASSERT_TRUE(permit.ok()) << permit.status();
    others.push_back(*permit);
    EXPECT_FALSE(search(caller).ok());
  }
  // A caller may have more than its share where nobody else wants it.
  others.clear();
  greedy.pop_back();
  greedy.push_back(*search("greedy"));
  EXPECT_FALSE(search("greedy").ok());
}

TEST(AdmissionTest, SearchWaitsForThoseOfItsOwnCallerOnly) {
  Admission admission(Limits{}, 1, NoMemory);
  std::vector<Permit> permits;
  for (int i = 0; i < 100; ++i) {
    admission.SearchTook("slow", std::chrono::seconds(10));
    admission.SearchTook("quick", std::chrono::milliseconds(10));
  }
  for (int i = 0; i < 10; ++i) {
    permits.push_back(*admission.Search(std::to_string(i), "slow", kEver));
  }
  for (int i = 0; i < 5; ++i) {
    permits.push_back(*admission.Search(std::to_string(i), "quick",
                                        std::chrono::milliseconds(500)));
  }
  // Five of ten milliseconds, while another has half of the threads.
  const auto late =
      IsError(StatusCode::kUnavailable, "OVERLOADED", HasSubstr("deadline"));
  EXPECT_THAT(
      admission.Search("v", "quick", std::chrono::milliseconds(60)).status(),
      late);
  EXPECT_THAT(admission.Search("v", "slow", std::chrono::seconds(100)).status(),
              late);
}

TEST(AdmissionTest, BudgetOfStepsIsEachCallersOwnAndDebtsArePaidFirst) {
  Admission admission(Limits{}, 1, NoMemory);
  constexpr double kRate = 1000.0;
  EXPECT_THAT(admission.CheckSteps("a", kRate), IsOk());
  // More than there is of one second: those of three are missing then.
  admission.UseSteps("a", kRate, 4000);
  const absl::Status refused = admission.CheckSteps("a", kRate);
  EXPECT_THAT(refused, IsError(StatusCode::kResourceExhausted, "SEARCH_QUOTA",
                               HasSubstr("steps of searches a second")));
  EXPECT_GT(RetrySeconds(refused), 2.0);
  EXPECT_LE(RetrySeconds(refused), 3.5);
  EXPECT_THAT(admission.CheckSteps("b", kRate), IsOk());
  const auto counts = admission.refusals().Read();
  for (std::size_t i = 0; i < kLimitCount; ++i) {
    const bool of_steps =
        kLimitNames[i] == std::string("max-search-steps-per-second");
    EXPECT_EQ(counts[i], of_steps ? 1u : 0u) << kLimitNames[i];
  }
}

TEST(AdmissionTest, SearchThatWouldBeLateIsRefusedAtOnce) {
  Admission admission(Limits{}, 2, NoMemory);
  for (int i = 0; i < 100; ++i) {
    admission.SearchTook("", std::chrono::milliseconds(100));
  }
  std::vector<Permit> permits;
  for (int i = 0; i < 10; ++i) {
    auto permit = admission.Search("v" + std::to_string(i), "", kEver);
    ASSERT_TRUE(permit.ok());
    permits.push_back(*permit);
  }
  // Ten on two threads take half a second.
  const absl::Status late =
      admission.Search("v", "", std::chrono::milliseconds(400)).status();
  EXPECT_THAT(late, IsError(StatusCode::kUnavailable, "OVERLOADED",
                            HasSubstr("deadline")));
  EXPECT_GT(RetrySeconds(late), 0.0);
  EXPECT_TRUE(admission.Search("v", "", std::chrono::seconds(1)).ok());
  // Where nobody waits, a short deadline is the caller's own affair.
  permits.clear();
  EXPECT_TRUE(admission.Search("v", "", std::chrono::milliseconds(1)).ok());
}

TEST(AdmissionTest, QueuesAreBoundedInBytes) {
  Admission admission(Small(), 1, NoMemory);
  auto first = admission.Queue("v", 400);
  EXPECT_THAT(admission.Queue("v", 300).status(),
              IsError(StatusCode::kResourceExhausted, "QUEUE_FULL",
                      HasSubstr("limit")));
  const auto second = admission.Queue("w", 500);
  EXPECT_TRUE(second.ok());
  EXPECT_THAT(
      admission.Queue("x", 200).status(),
      IsError(StatusCode::kUnavailable, "OVERLOADED", HasSubstr("limit")));
  first = absl::CancelledError();
  EXPECT_TRUE(admission.Queue("v", 300).ok());
}

TEST(AdmissionTest, BatchLargerThanAQueueComesThroughAlone) {
  Admission admission(Small(), 1, NoMemory);
  const auto large = admission.Queue("v", 5000);
  EXPECT_TRUE(large.ok());
  EXPECT_FALSE(admission.Queue("w", 1).ok());
}

TEST(AdmissionTest, RateOfSearchesIsEachCallersOwn) {
  Limits limits;
  limits.max_search_rate_per_caller = 5.0;
  Admission admission(limits, 1, NoMemory);
  for (int i = 0; i < 5; ++i)
    EXPECT_TRUE(admission.Search("v", "a", kEver).ok());
  const absl::Status refused = admission.Search("v", "a", kEver).status();
  EXPECT_THAT(refused, IsError(StatusCode::kResourceExhausted, "SEARCH_QUOTA",
                               HasSubstr("limit")));
  EXPECT_GT(RetrySeconds(refused), 0.0);
  EXPECT_LE(RetrySeconds(refused), 0.6);
  EXPECT_TRUE(admission.Search("v", "b", kEver).ok());
  // Nobody is limited by a rate of nobody's.
  for (int i = 0; i < 50; ++i)
    EXPECT_TRUE(admission.Search("v", "", kEver).ok());
}

TEST(AdmissionTest, NothingNewIsTakenWhileMemoryIsShort) {
  Limits limits = Small();
  limits.max_memory_bytes = 100;
  std::int64_t used = 100;
  Admission admission(limits, 1, [&] { return used; });
  EXPECT_TRUE(admission.UnderMemoryPressure());
  for (const absl::Status& refused :
       {admission.Call("").status(), admission.Stream("").status(),
        admission.Queue("v", 1).status()}) {
    EXPECT_THAT(refused, IsError(StatusCode::kResourceExhausted,
                                 "MEMORY_PRESSURE", HasSubstr("limit")));
    EXPECT_GE(RetrySeconds(refused), 2.5);
  }
}

TEST(AdmissionTest, RoomIsCountedAcrossThreads) {
  Limits limits;
  limits.max_searches = 8;
  Admission admission(limits, 1, NoMemory);
  std::vector<std::thread> threads;
  for (int i = 0; i < 4; ++i) {
    threads.emplace_back([&admission, i] {
      for (int k = 0; k < 10000; ++k) {
        const auto permit = admission.Search("v" + std::to_string((i + k) % 3),
                                             std::to_string(k % 5), kEver);
      }
    });
  }
  for (std::thread& thread : threads) thread.join();
  std::vector<Permit> permits;
  for (int i = 0; i < 8; ++i) {
    auto permit = admission.Search("v", "", kEver);
    ASSERT_TRUE(permit.ok());
    permits.push_back(*permit);
  }
  EXPECT_FALSE(admission.Search("v", "", kEver).ok());
}

}  // namespace
}  // namespace revisit::server
