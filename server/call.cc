#include "server/call.h"

#include <algorithm>
#include <cstdint>
#include <cstdio>
#include <random>

#include "absl/strings/cord.h"
#include "absl/strings/string_view.h"
#include "google/rpc/error_details.pb.h"
#include "server/status.h"
#include "server/status_grpc.h"

namespace revisit::server {
namespace {

constexpr char kRequestIdKey[] = "x-request-id";
constexpr std::size_t kMaxRequestIdBytes = 128;

std::string NewRequestId() {
  thread_local std::mt19937_64 generator(std::random_device{}());
  char text[17];
  std::snprintf(text, sizeof(text), "%016llx",
                static_cast<unsigned long long>(generator()));
  return text;
}

std::string RequestId(const grpc::CallbackServerContext& context) {
  const auto& metadata = context.client_metadata();
  const auto entry = metadata.find(kRequestIdKey);
  if (entry != metadata.end()) {
    const std::string id(entry->second.data(), entry->second.size());
    const bool printable = std::all_of(
        id.begin(), id.end(), [](char c) { return c >= ' ' && c <= '~'; });
    if (!id.empty() && id.size() <= kMaxRequestIdBytes && printable) return id;
  }
  return NewRequestId();
}

const char* CodeName(grpc::StatusCode code) {
  static constexpr const char* kNames[] = {"OK",
                                           "CANCELLED",
                                           "UNKNOWN",
                                           "INVALID_ARGUMENT",
                                           "DEADLINE_EXCEEDED",
                                           "NOT_FOUND",
                                           "ALREADY_EXISTS",
                                           "PERMISSION_DENIED",
                                           "RESOURCE_EXHAUSTED",
                                           "FAILED_PRECONDITION",
                                           "ABORTED",
                                           "OUT_OF_RANGE",
                                           "UNIMPLEMENTED",
                                           "INTERNAL",
                                           "UNAVAILABLE",
                                           "DATA_LOSS",
                                           "UNAUTHENTICATED"};
  const auto index = static_cast<std::size_t>(code);
  return index < std::size(kNames) ? kNames[index] : "UNKNOWN";
}

// Errors of ours, as opposed to those of callers, are what an operator looks
// for.
LogLevel LevelOf(grpc::StatusCode code) {
  switch (code) {
    case grpc::StatusCode::INTERNAL:
    case grpc::StatusCode::DATA_LOSS:
      return LogLevel::kError;
    case grpc::StatusCode::UNAVAILABLE:
    case grpc::StatusCode::RESOURCE_EXHAUSTED:
      return LogLevel::kWarning;
    default:
      return LogLevel::kInfo;
  }
}

// Every error gets an ErrorInfo, and every ErrorInfo the request id.
absl::Status WithRequestId(const absl::Status& status, const std::string& id) {
  if (status.ok()) return status;
  absl::Status result = status;
  if (ReasonOf(status).empty()) {
    switch (status.code()) {
      case absl::StatusCode::kCancelled:
        result = Error(status.code(), "CANCELLED", "the caller gave up");
        break;
      case absl::StatusCode::kDeadlineExceeded:
        result = Error(status.code(), "DEADLINE_EXCEEDED",
                       "the caller's deadline passed");
        break;
      default:
        result = Error(absl::StatusCode::kInternal, "INTERNAL",
                       "a defect of the server; the request id finds it in the "
                       "log");
    }
  }
  google::rpc::ErrorInfo info;
  info.ParseFromString(std::string(*result.GetPayload(kErrorInfoUrl)));
  (*info.mutable_metadata())["request_id"] = id;
  result.SetPayload(kErrorInfoUrl, absl::Cord(info.SerializeAsString()));
  return result;
}

}  // namespace

absl::Status MalformedMessage() {
  return Error(absl::StatusCode::kInvalidArgument, "STREAM_PROTOCOL",
               "a message of the stream is not a valid protobuf");
}

Call::Call(grpc::CallbackServerContext* context, const char* method,
           const ServiceContext& service)
    : method_(method),
      log_(service.log),
      drain_(service.drain),
      admitted_(service.drain->Enter()),
      start_(std::chrono::steady_clock::now()),
      deadline_(context->deadline()),
      request_id_(RequestId(*context)) {
  context->AddInitialMetadata(kRequestIdKey, request_id_);
}

void Call::Done() { drain_->Leave(); }

absl::Status Call::GivenUpStatus() const {
  if (std::chrono::system_clock::now() < deadline_) {
    return Error(absl::StatusCode::kCancelled, "CANCELLED",
                 "the caller gave up");
  }
  return Error(absl::StatusCode::kDeadlineExceeded, "DEADLINE_EXCEEDED",
               "the caller's deadline passed");
}

grpc::Status Call::End(const absl::Status& status) const {
  const absl::Status named = WithRequestId(status, request_id_);
  const grpc::Status answer = ToGrpcStatus(named);
  const std::chrono::duration<double, std::milli> duration =
      std::chrono::steady_clock::now() - start_;
  log_->Write(LevelOf(answer.error_code()), "call",
              {{"request_id", request_id_},
               {"method", method_},
               {"vehicle", vehicle_},
               {"code", CodeName(answer.error_code())},
               {"reason", ReasonOf(named)},
               {"message", std::string(status.message())},
               {"duration_ms", duration.count()}});
  return answer;
}

}  // namespace revisit::server
