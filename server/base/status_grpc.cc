#include "server/base/status_grpc.h"

#include <string>

#include "absl/strings/cord.h"
#include "absl/strings/string_view.h"
#include "google/rpc/status.pb.h"
#include "server/base/status.h"

namespace revisit::server {
namespace {

const char* ReasonOfCode(absl::StatusCode code) {
  switch (code) {
    case absl::StatusCode::kCancelled:
      return "CANCELLED";
    case absl::StatusCode::kDeadlineExceeded:
      return "DEADLINE_EXCEEDED";
    case absl::StatusCode::kInvalidArgument:
      return "INVALID_FIELD";
    case absl::StatusCode::kDataLoss:
      return "STORE_CORRUPT";
    default:
      return "INTERNAL";
  }
}

absl::Status WithReason(const absl::Status& status) {
  if (!ReasonOf(status).empty()) return status;
  absl::StatusCode code = status.code();
  if (code == absl::StatusCode::kUnknown) code = absl::StatusCode::kInternal;
  absl::Status result =
      Error(code, ReasonOfCode(code), std::string(status.message()));
  status.ForEachPayload([&](absl::string_view url, const absl::Cord& payload) {
    if (url != kErrorInfoUrl) result.SetPayload(url, payload);
  });
  return result;
}

}  // namespace

grpc::Status ToGrpcStatus(const absl::Status& status) {
  if (status.ok()) return grpc::Status::OK;
  const absl::Status complete = WithReason(status);
  google::rpc::Status details;
  details.set_code(complete.raw_code());
  details.set_message(std::string(complete.message()));
  // ErrorInfo first: some clients look no further.
  const auto add = [&](absl::string_view url, const absl::Cord& payload) {
    auto* any = details.add_details();
    any->set_type_url(std::string(url));
    any->set_value(std::string(payload));
  };
  add(kErrorInfoUrl, *complete.GetPayload(kErrorInfoUrl));
  for (const char* url : {kBadRequestUrl, kRetryInfoUrl}) {
    const auto payload = complete.GetPayload(url);
    if (payload.has_value()) add(url, *payload);
  }
  complete.ForEachPayload([&](absl::string_view url,
                              const absl::Cord& payload) {
    if (url != kErrorInfoUrl && url != kBadRequestUrl && url != kRetryInfoUrl) {
      add(url, payload);
    }
  });
  return grpc::Status(static_cast<grpc::StatusCode>(complete.raw_code()),
                      details.message(), details.SerializeAsString());
}

}  // namespace revisit::server
