#include "server/base/status.h"

#include <cstddef>

#include "absl/strings/cord.h"
#include "absl/strings/str_cat.h"
#include "absl/strings/string_view.h"
#include "google/protobuf/message_lite.h"
#include "google/rpc/error_details.pb.h"

namespace revisit::server {
namespace {

constexpr char kDomain[] = "revisit";

// A status travels in HTTP/2 trailers, which gRPC peers limit to 8 KiB; the
// details are sent in base64 and hold the message once more.
constexpr std::size_t kMaxMessageBytes = 800;
constexpr std::size_t kMaxViolationBytes = 3000;

// The longest prefix of at most `limit` bytes that ends between characters.
std::string Shortened(const std::string& text, std::size_t limit) {
  if (text.size() <= limit) return text;
  const std::string mark = "...";
  std::size_t end = limit - mark.size();
  while (end > 0 && (static_cast<unsigned char>(text[end]) & 0xC0) == 0x80) {
    --end;
  }
  return text.substr(0, end) + mark;
}

void SetPayload(const char* url, const google::protobuf::MessageLite& message,
                absl::Status* status) {
  status->SetPayload(url, absl::Cord(message.SerializeAsString()));
}

void SetErrorInfo(const std::string& reason, const ErrorMetadata& metadata,
                  absl::Status* status) {
  google::rpc::ErrorInfo info;
  info.set_reason(reason);
  info.set_domain(kDomain);
  for (const auto& [key, value] : metadata) {
    (*info.mutable_metadata())[key] = value;
  }
  SetPayload(kErrorInfoUrl, info, status);
}

void SetRetryInfo(std::int64_t delay_milliseconds, absl::Status* status) {
  google::rpc::RetryInfo retry;
  retry.mutable_retry_delay()->set_seconds(delay_milliseconds / 1000);
  retry.mutable_retry_delay()->set_nanos(
      static_cast<std::int32_t>(delay_milliseconds % 1000 * 1000000));
  SetPayload(kRetryInfoUrl, retry, status);
}

}  // namespace

absl::Status Error(absl::StatusCode code, const std::string& reason,
                   const std::string& message, const ErrorMetadata& metadata) {
  absl::Status status(code, Shortened(message, kMaxMessageBytes));
  SetErrorInfo(reason, metadata, &status);
  // A queue empties sooner than a store or a server comes back.
  if (code == absl::StatusCode::kUnavailable) SetRetryInfo(1000, &status);
  if (code == absl::StatusCode::kResourceExhausted) SetRetryInfo(100, &status);
  return status;
}

absl::Status InvalidFields(const std::string& reason,
                           const std::vector<FieldViolation>& violations) {
  google::rpc::BadRequest bad_request;
  std::size_t bytes = 0;
  for (const FieldViolation& violation : violations) {
    const std::string description =
        Shortened(violation.description, kMaxMessageBytes);
    bytes += violation.field.size() + description.size();
    if (bytes > kMaxViolationBytes && bad_request.field_violations_size() > 0) {
      break;
    }
    auto* added = bad_request.add_field_violations();
    added->set_field(violation.field);
    added->set_description(description);
  }
  const FieldViolation& first = violations.front();
  std::string message = absl::StrCat(first.field, ": ", first.description);
  if (violations.size() > 1) {
    message = absl::StrCat(Shortened(message, kMaxMessageBytes - 50), " (and ",
                           violations.size() - 1, " more)");
  }
  absl::Status status =
      Error(absl::StatusCode::kInvalidArgument, reason, message,
            {{"violations", absl::StrCat(violations.size())}});
  SetPayload(kBadRequestUrl, bad_request, &status);
  return status;
}

absl::Status QuotaExceeded(absl::StatusCode code, const std::string& reason,
                           const std::string& subject,
                           const std::string& message,
                           std::chrono::milliseconds retry_delay,
                           const ErrorMetadata& metadata) {
  absl::Status status = Error(code, reason, message, metadata);
  google::rpc::QuotaFailure quota;
  auto* violation = quota.add_violations();
  violation->set_subject(subject);
  violation->set_description(std::string(status.message()));
  SetPayload(kQuotaFailureUrl, quota, &status);
  SetRetryInfo(retry_delay.count(), &status);
  return status;
}

absl::Status WithRetryDelay(std::chrono::milliseconds delay,
                            absl::Status status) {
  SetRetryInfo(delay.count(), &status);
  return status;
}

absl::Status VehicleNotFound(const std::string& id) {
  return Error(absl::StatusCode::kNotFound, "VEHICLE_NOT_FOUND",
               absl::StrCat("no such vehicle: '", id, "'"));
}

absl::Status Corrupt(const std::string& what, const ErrorMetadata& metadata) {
  return Error(absl::StatusCode::kDataLoss, "STORE_CORRUPT", what, metadata);
}

absl::Status CallerGaveUp() {
  return Error(absl::StatusCode::kCancelled, "CANCELLED", "the caller gave up");
}

absl::Status DeadlinePassed() {
  return Error(absl::StatusCode::kDeadlineExceeded, "DEADLINE_EXCEEDED",
               "the caller's deadline passed");
}

std::string ReasonOf(const absl::Status& status) {
  const auto payload = status.GetPayload(kErrorInfoUrl);
  if (!payload.has_value()) return "";
  google::rpc::ErrorInfo info;
  if (!info.ParseFromString(std::string(*payload))) return "";
  return info.domain() == kDomain ? info.reason() : "";
}

absl::Status Named(const absl::Status& status) {
  if (status.ok() || !ReasonOf(status).empty()) return status;
  switch (status.code()) {
    case absl::StatusCode::kCancelled:
      return CallerGaveUp();
    case absl::StatusCode::kDeadlineExceeded:
      return DeadlinePassed();
    default:
      return Error(
          absl::StatusCode::kInternal, "INTERNAL",
          "a defect of the server; the request id finds it in the log");
  }
}

}  // namespace revisit::server
