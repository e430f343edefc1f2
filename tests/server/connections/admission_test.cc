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
    auto permit = admission.Call();
    ASSERT_TRUE(permit.ok()) << permit.status();
    permits.push_back(*permit);
  }
  const absl::Status refused = admission.Call().status();
  EXPECT_THAT(refused, IsError(StatusCode::kUnavailable, "OVERLOADED",
                               HasSubstr("limit")));
  permits.pop_back();
  EXPECT_TRUE(admission.Call().ok());
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
    take(admission.Call());
    take(admission.StreamOf("v"));
    take(admission.Search("v", "", kEver));
    take(admission.Queue("v", 500));
  }
  for (int i = 0; i < 3; ++i) take(admission.Stream("a"));
  for (int i = 0; i < 3; ++i) take(admission.Stream("b"));
  const std::map<std::string, std::uint64_t> expected = {
      {"max-calls", 3},
      {"max-queued-bytes-per-vehicle", 4},
      {"max-searches-per-vehicle", 3},
      // The second of b finds none left of all.
      {"max-streams", 2},
      {"max-streams-per-caller", 1},
      {"max-streams-per-vehicle", 3}};
  EXPECT_EQ(refusals(admission), expected);
  for (const Admission::Use& use : admission.uses()) {
    const std::string limit = use.limit;
    EXPECT_EQ(use.taken, limit == "max-calls"          ? 2
                         : limit == "max-queued-bytes" ? 500
                         : limit == "max-searches"     ? 2
                         : limit == "max-streams"      ? 3
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

TEST(AdmissionTest, SearchThatWouldBeLateIsRefusedAtOnce) {
  Admission admission(Limits{}, 2, NoMemory);
  for (int i = 0; i < 100; ++i) {
    admission.SearchTook(std::chrono::milliseconds(100));
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
       {admission.Call().status(), admission.Stream("").status(),
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
        const auto permit =
            admission.Search("v" + std::to_string((i + k) % 3), "", kEver);
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
