#include "server/base/status.h"

#include <chrono>
#include <string>
#include <vector>

#include "gmock/gmock.h"
#include "google/rpc/error_details.pb.h"
#include "google/rpc/status.pb.h"
#include "gtest/gtest.h"
#include "revisit/v1/error_reason.pb.h"
#include "server/base/status_grpc.h"
#include "tests/server/error_matchers.h"

namespace revisit::server {
namespace {

using absl::StatusCode;
using ::testing::_;
using ::testing::ElementsAre;
using ::testing::Lt;
using ::testing::SizeIs;

google::rpc::Status DetailsOf(const grpc::Status& status) {
  google::rpc::Status details;
  EXPECT_TRUE(details.ParseFromString(status.error_details()));
  EXPECT_EQ(details.code(), status.error_code());
  EXPECT_EQ(details.message(), status.error_message());
  return details;
}

std::vector<std::string> TypesOf(const google::rpc::Status& details) {
  std::vector<std::string> types;
  for (const auto& detail : details.details()) {
    types.push_back(detail.type_url());
  }
  return types;
}

template <typename Message>
Message DetailOf(const google::rpc::Status& details) {
  Message message;
  for (const auto& detail : details.details()) {
    if (detail.UnpackTo(&message)) return message;
  }
  ADD_FAILURE() << "no " << message.GetTypeName();
  return message;
}

TEST(StatusTest, ErrorCarriesReasonDomainAndMetadata) {
  const absl::Status status =
      Error(StatusCode::kFailedPrecondition, "SEQUENCE_GAP", "a gap",
            {{"expected_sequence", "7"}, {"x", "y"}});
  EXPECT_EQ(status.code(), StatusCode::kFailedPrecondition);
  EXPECT_EQ(status.message(), "a gap");
  EXPECT_EQ(ReasonOf(status), "SEQUENCE_GAP");
  const auto info =
      DetailOf<google::rpc::ErrorInfo>(DetailsOf(ToGrpcStatus(status)));
  EXPECT_EQ(info.reason(), "SEQUENCE_GAP");
  EXPECT_EQ(info.domain(), "revisit");
  EXPECT_EQ(info.metadata().at("expected_sequence"), "7");
  EXPECT_EQ(info.metadata().at("x"), "y");
}

TEST(StatusTest, SaysWhenToRetryOnlyWhereThatHelps) {
  for (const StatusCode code :
       {StatusCode::kUnavailable, StatusCode::kResourceExhausted}) {
    const auto retry = DetailOf<google::rpc::RetryInfo>(
        DetailsOf(ToGrpcStatus(Error(code, "QUEUE_FULL", "later"))));
    EXPECT_GT(retry.retry_delay().seconds() * 1000000000 +
                  retry.retry_delay().nanos(),
              0);
  }
  for (const StatusCode code :
       {StatusCode::kInvalidArgument, StatusCode::kDataLoss,
        StatusCode::kInternal, StatusCode::kAborted}) {
    EXPECT_FALSE(Error(code, "X", "no").GetPayload(kRetryInfoUrl).has_value());
  }
}

TEST(StatusTest, TakesAnotherRetryDelay) {
  const auto details = DetailsOf(ToGrpcStatus(
      WithRetryDelay(std::chrono::milliseconds(2250),
                     Error(StatusCode::kUnavailable, "STREAM_AGE", "later"))));
  EXPECT_THAT(TypesOf(details), ElementsAre(kErrorInfoUrl, kRetryInfoUrl));
  const auto retry = DetailOf<google::rpc::RetryInfo>(details);
  EXPECT_EQ(retry.retry_delay().seconds(), 2);
  EXPECT_EQ(retry.retry_delay().nanos(), 250000000);
}

TEST(StatusTest, ListsViolatedFields) {
  const absl::Status status = InvalidFields(
      "NOT_FINITE", {{"poses[3].local.x_meters", "got nan, must be finite"},
                     {"poses[4].local.y_meters", "got inf, must be finite"}});
  EXPECT_THAT(status, IsError(StatusCode::kInvalidArgument, "NOT_FINITE",
                              "poses[3].local.x_meters: got nan, must be "
                              "finite (and 1 more)"));
  const google::rpc::Status details = DetailsOf(ToGrpcStatus(status));
  EXPECT_THAT(TypesOf(details), ElementsAre(kErrorInfoUrl, kBadRequestUrl));
  const auto bad = DetailOf<google::rpc::BadRequest>(details);
  ASSERT_EQ(bad.field_violations_size(), 2);
  EXPECT_EQ(bad.field_violations(0).field(), "poses[3].local.x_meters");
  EXPECT_EQ(bad.field_violations(0).description(), "got nan, must be finite");
  EXPECT_EQ(bad.field_violations(1).field(), "poses[4].local.y_meters");
}

TEST(StatusTest, SingleViolationIsTheMessage) {
  EXPECT_EQ(
      InvalidFields("INVALID_FIELD", {{"a.b", "got 0, at least 1"}}).message(),
      "a.b: got 0, at least 1");
}

TEST(StatusTest, FitsIntoTrailersWhateverIsWrong) {
  std::vector<FieldViolation> violations;
  for (int i = 0; i < 10000; ++i) {
    violations.push_back({"poses[" + std::to_string(i) + "].local.x_meters",
                          std::string(5000, '!')});
  }
  const absl::Status status = InvalidFields("INVALID_FIELD", violations);
  EXPECT_EQ(MetadataOf(status, "violations"), "10000");
  const grpc::Status grpc_status = ToGrpcStatus(status);
  // gRPC's limit for all metadata is 8192; details are sent in base64.
  EXPECT_THAT(grpc_status.error_details().size() * 4 / 3 +
                  grpc_status.error_message().size(),
              Lt(7500u));
  EXPECT_GT(DetailOf<google::rpc::BadRequest>(DetailsOf(grpc_status))
                .field_violations_size(),
            0);
}

TEST(StatusTest, CutsLongMessagesBetweenCharacters) {
  std::string snow;
  for (int i = 0; i < 1000; ++i) snow += "\u2744";
  const std::string cut(
      Error(StatusCode::kInternal, "INTERNAL", snow).message());
  EXPECT_THAT(cut.size(), Lt(1000u));
  ASSERT_EQ(cut.substr(cut.size() - 3), "...");
  EXPECT_EQ((cut.size() - 3) % 3, 0u);
}

TEST(StatusTest, StatusOfOthersHasNoReason) {
  EXPECT_EQ(ReasonOf(absl::OkStatus()), "");
  EXPECT_EQ(ReasonOf(absl::InternalError("x")), "");
  absl::Status damaged = absl::InternalError("x");
  damaged.SetPayload(kErrorInfoUrl, absl::Cord("\xff\xff"));
  EXPECT_EQ(ReasonOf(damaged), "");
  google::rpc::ErrorInfo info;
  info.set_domain("example.com");
  info.set_reason("THEIRS");
  absl::Status foreign = absl::InternalError("x");
  foreign.SetPayload(kErrorInfoUrl, absl::Cord(info.SerializeAsString()));
  EXPECT_EQ(ReasonOf(foreign), "");
}

TEST(StatusTest, OkStaysOk) {
  const grpc::Status status = ToGrpcStatus(absl::OkStatus());
  EXPECT_TRUE(status.ok());
  EXPECT_EQ(status.error_details(), "");
}

TEST(StatusTest, KeepsEveryCode) {
  for (int code = 1; code <= 16; ++code) {
    if (code == static_cast<int>(StatusCode::kUnknown)) continue;
    const grpc::Status status =
        ToGrpcStatus(Error(static_cast<StatusCode>(code), "INTERNAL", "x"));
    EXPECT_EQ(status.error_code(), code);
  }
}

TEST(StatusTest, ErrorWithoutAReasonIsADefectUnlessTheCallerEndedTheCall) {
  const absl::Status cancelled = Named(absl::CancelledError("x"));
  EXPECT_EQ(cancelled.code(), StatusCode::kCancelled);
  EXPECT_EQ(ReasonOf(cancelled), "CANCELLED");
  const absl::Status late = Named(absl::DeadlineExceededError("x"));
  EXPECT_EQ(late.code(), StatusCode::kDeadlineExceeded);
  EXPECT_EQ(ReasonOf(late), "DEADLINE_EXCEEDED");
  for (const absl::Status& other :
       {absl::UnknownError("x"), absl::DataLossError("x"),
        absl::InvalidArgumentError("x"), absl::InternalError("x")}) {
    const absl::Status defect = Named(other);
    EXPECT_EQ(defect.code(), StatusCode::kInternal);
    EXPECT_EQ(ReasonOf(defect), "INTERNAL");
    // What it says may be of no business to callers.
    EXPECT_EQ(defect.message().find('x'), std::string::npos)
        << defect.message();
  }
}

TEST(StatusTest, ErrorWithAReasonKeepsItsName) {
  const absl::Status full = Error(StatusCode::kUnavailable, "QUEUE_FULL", "x");
  EXPECT_EQ(Named(full), full);
  EXPECT_EQ(Named(absl::OkStatus()), absl::OkStatus());
}

TEST(StatusTest, KeepsDetailsOfOthers) {
  absl::Status status = Error(StatusCode::kInternal, "INTERNAL", "x");
  status.SetPayload("type.googleapis.com/example.Other", absl::Cord("bytes"));
  const google::rpc::Status details = DetailsOf(ToGrpcStatus(status));
  EXPECT_THAT(TypesOf(details),
              ElementsAre(kErrorInfoUrl, "type.googleapis.com/example.Other"));
  EXPECT_EQ(details.details(1).value(), "bytes");
}

TEST(StatusTest, ReasonsItGivesAreInTheProto) {
  for (const char* reason : {"INTERNAL", "CANCELLED", "DEADLINE_EXCEEDED"}) {
    v1::ErrorReason value;
    EXPECT_TRUE(
        v1::ErrorReason_Parse("ERROR_REASON_" + std::string(reason), &value))
        << reason;
  }
}

}  // namespace
}  // namespace revisit::server
