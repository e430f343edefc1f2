#include "client/revisit/status.h"

#include <algorithm>
#include <cstdint>

#include "absl/strings/cord.h"
#include "client/revisit/printable_text.h"
#include "client/revisit/status_from_grpc.h"
#include "google/rpc/error_details.pb.h"
#include "google/rpc/status.pb.h"
#include "grpcpp/support/status.h"

namespace revisit::client {
namespace {

constexpr char kDetailPrefix[] = "type.googleapis.com/google.rpc.";
constexpr char kErrorInfoUrl[] = "type.googleapis.com/google.rpc.ErrorInfo";
constexpr char kBadRequestUrl[] = "type.googleapis.com/google.rpc.BadRequest";
constexpr char kRetryInfoUrl[] = "type.googleapis.com/google.rpc.RetryInfo";

template <typename Message>
std::optional<Message> Payload(const absl::Status& status, const char* url) {
  const auto payload = status.GetPayload(url);
  Message message;
  if (!payload.has_value() || !message.ParseFromString(std::string(*payload))) {
    return std::nullopt;
  }
  return message;
}

// Whatever numbers the message holds, also ones that no duration has.
std::chrono::nanoseconds DelayOf(const google::protobuf::Duration& duration) {
  constexpr std::int64_t kMostSeconds =
      std::chrono::seconds(kLongestRetryDelay).count();
  constexpr std::int32_t kMostNanos = 999'999'999;
  const std::chrono::seconds seconds(
      std::clamp<std::int64_t>(duration.seconds(), 0, kMostSeconds));
  const std::chrono::nanoseconds nanos(
      std::clamp(duration.nanos(), 0, kMostNanos));
  return std::min<std::chrono::nanoseconds>(seconds + nanos,
                                            kLongestRetryDelay);
}

}  // namespace

absl::Status FromGrpc(const grpc::Status& status) {
  if (status.ok()) return absl::OkStatus();
  absl::Status result(static_cast<absl::StatusCode>(status.error_code()),
                      status.error_message());
  google::rpc::Status details;
  if (!details.ParseFromString(status.error_details())) return result;
  for (const auto& detail : details.details()) {
    if (detail.type_url().rfind(kDetailPrefix, 0) != 0) continue;
    result.SetPayload(detail.type_url(), absl::Cord(detail.value()));
  }
  return result;
}

ErrorDetails DetailsOf(const absl::Status& status) {
  ErrorDetails details;
  if (const auto info =
          Payload<google::rpc::ErrorInfo>(status, kErrorInfoUrl)) {
    details.reason = info->reason();
    details.domain = info->domain();
    details.metadata.insert(info->metadata().begin(), info->metadata().end());
  }
  if (const auto bad =
          Payload<google::rpc::BadRequest>(status, kBadRequestUrl)) {
    for (const auto& violation : bad->field_violations()) {
      details.field_violations.push_back(
          {violation.field(), violation.description()});
    }
  }
  if (const auto retry = Payload<google::rpc::RetryInfo>(status, kRetryInfoUrl);
      retry.has_value() && retry->has_retry_delay()) {
    details.retry_delay = DelayOf(retry->retry_delay());
  }
  return details;
}

bool IsCut(const absl::Status& status) {
  return (absl::IsCancelled(status) || absl::IsInternal(status)) &&
         DetailsOf(status).reason.empty();
}

bool WasElsewhere(const absl::Status& status) {
  const std::string reason = DetailsOf(status).reason;
  return reason == "NOT_OWNER" || reason == "EPOCH_FENCED";
}

bool LostToOthers(const absl::Status& status) {
  return DetailsOf(status).reason == "REVISION_MISMATCH";
}

bool ReadsHistories(const absl::Status& status) {
  return DetailsOf(status).reason == "GROUP_NOT_READY";
}

std::string Describe(const absl::Status& status) {
  if (status.ok()) return "OK";
  const ErrorDetails details = DetailsOf(status);
  std::string text = absl::StatusCodeToString(status.code());
  if (!details.reason.empty()) text += " (" + Printable(details.reason) + ")";
  text += ": " + Printable(std::string(status.message()));
  for (const FieldViolation& violation : details.field_violations) {
    const std::string line =
        Printable(violation.field + ": " + violation.description);
    // The server's messages tell the first violation themselves.
    if (text.find(line) == std::string::npos) text += "\n  " + line;
  }
  return text;
}

}  // namespace revisit::client
