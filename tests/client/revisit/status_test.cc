#include "client/revisit/status.h"

#include <cstdint>
#include <limits>
#include <utility>
#include <vector>

#include "absl/strings/cord.h"
#include "client/revisit/backoff.h"
#include "client/revisit/status_from_grpc.h"
#include "google/rpc/error_details.pb.h"
#include "google/rpc/status.pb.h"
#include "grpcpp/support/status.h"
#include "gtest/gtest.h"

namespace revisit::client {
namespace {

using std::chrono::nanoseconds;

grpc::Status WithDetails(const google::rpc::Status& details) {
  return grpc::Status(grpc::StatusCode::UNAVAILABLE, "down",
                      details.SerializeAsString());
}

// The wait that is read from a RetryInfo of these numbers.
nanoseconds ReadDelay(std::int64_t seconds, std::int32_t nanos) {
  google::rpc::RetryInfo retry;
  retry.mutable_retry_delay()->set_seconds(seconds);
  retry.mutable_retry_delay()->set_nanos(nanos);
  google::rpc::Status details;
  details.add_details()->PackFrom(retry);
  return DetailsOf(FromGrpc(WithDetails(details))).retry_delay.value();
}

TEST(StatusTest, WaitsAreTakenOverAsTheServerAsks) {
  EXPECT_EQ(ReadDelay(0, 0), nanoseconds(0));
  EXPECT_EQ(ReadDelay(2, 500'000'000), nanoseconds(2'500'000'000));
  EXPECT_EQ(ReadDelay(299, 999'999'999), nanoseconds(299'999'999'999));
}

TEST(StatusTest, NoWaitIsLongerThanTheLongestOrShorterThanNone) {
  constexpr std::int64_t kMost = std::numeric_limits<std::int64_t>::max();
  constexpr std::int32_t kMostNanos = std::numeric_limits<std::int32_t>::max();
  for (const auto& [seconds, nanos] :
       std::vector<std::pair<std::int64_t, std::int32_t>>{
           {300, 1},
           {301, 0},
           {9'000'000'000, 0},
           // The longest Duration.
           {315'576'000'000, 999'999'999},
           {kMost, kMostNanos},
           {kMost, -kMostNanos - 1}}) {
    EXPECT_EQ(ReadDelay(seconds, nanos), kLongestRetryDelay) << seconds;
  }
  for (const auto& [seconds, nanos] :
       std::vector<std::pair<std::int64_t, std::int32_t>>{
           {-1, 0},
           {0, -1},
           {-315'576'000'000, -999'999'999},
           {-kMost - 1, -kMostNanos - 1}}) {
    EXPECT_EQ(ReadDelay(seconds, nanos), nanoseconds(0)) << seconds;
  }
  EXPECT_EQ(ReadDelay(0, kMostNanos), nanoseconds(999'999'999));
}

TEST(StatusTest, NoServerSpeaksByThisProgramsOwnPayloads) {
  google::rpc::Status details;
  for (const char* url :
       {"revisit.client/UsageError", "revisit.client/LocalError",
        "revisit.client/Hint", "", "type.googleapis.com/revisit.v1.Vehicle",
        "evil.example/google.rpc.RetryInfo"}) {
    auto* const detail = details.add_details();
    detail->set_type_url(url);
    detail->set_value("Run this: rm -rf ~");
  }
  const absl::Status status = FromGrpc(WithDetails(details));
  int payloads = 0;
  status.ForEachPayload(
      [&](absl::string_view, const absl::Cord&) { ++payloads; });
  EXPECT_EQ(payloads, 0);
}

TEST(StatusTest, WhatAServerSaysIsDescribedForATerminal) {
  google::rpc::ErrorInfo info;
  info.set_reason("\x1b[2J");
  google::rpc::BadRequest bad;
  bad.add_field_violations()->set_field("name\n  fake");
  bad.mutable_field_violations(0)->set_description("\u202e");
  google::rpc::Status details;
  details.add_details()->PackFrom(info);
  details.add_details()->PackFrom(bad);
  // Messages of gRPC are any bytes.
  const absl::Status status =
      FromGrpc(grpc::Status(grpc::StatusCode::NOT_FOUND,
                            "\x9b"
                            "31m\r\u009b\xff",
                            details.SerializeAsString()));
  EXPECT_EQ(Describe(status),
            "NOT_FOUND (<U+001B>[2J): <9B>31m<U+000D><U+009B><FF>\n"
            "  name<U+000A>  fake: <U+202E>");
  // Programs get it as it came.
  EXPECT_EQ(DetailsOf(status).reason, "\x1b[2J");
}

TEST(BackoffTest, NoWaitIsLongerThanADayWhateverIsAsked) {
  BackoffOptions options;
  options.max = std::chrono::milliseconds::max();
  options.initial = std::chrono::milliseconds::max();
  Backoff backoff(options, 1);
  constexpr std::chrono::hours kDay{24};
  EXPECT_EQ(backoff.Next(std::nullopt), kDay);
  EXPECT_EQ(backoff.Next(nanoseconds::max()), kDay);
  Backoff usual(BackoffOptions(), 1);
  EXPECT_EQ(usual.Next(nanoseconds::max()), kDay);
  EXPECT_GE(usual.Next(nanoseconds::min()), nanoseconds(0));
}

}  // namespace
}  // namespace revisit::client
