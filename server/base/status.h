// Errors of the service: absl::Status with google.rpc details as payloads,
// turned into grpc::Status in one place (status_grpc.h).
#ifndef REVISIT_SERVER_BASE_STATUS_H_
#define REVISIT_SERVER_BASE_STATUS_H_

#include <chrono>
#include <string>
#include <utility>
#include <vector>

#include "absl/status/status.h"

namespace revisit::server {

// Type URLs of the payloads, the same as in google.rpc.Status.details. The
// payload bytes are the serialized messages.
inline constexpr char kErrorInfoUrl[] =
    "type.googleapis.com/google.rpc.ErrorInfo";
inline constexpr char kBadRequestUrl[] =
    "type.googleapis.com/google.rpc.BadRequest";
inline constexpr char kRetryInfoUrl[] =
    "type.googleapis.com/google.rpc.RetryInfo";
inline constexpr char kQuotaFailureUrl[] =
    "type.googleapis.com/google.rpc.QuotaFailure";

struct FieldViolation {
  std::string field;        // Such as "poses[3].covariance.values[0]".
  std::string description;  // The value that was got, and the allowed ones.
};

using ErrorMetadata = std::vector<std::pair<std::string, std::string>>;

// A status with ErrorInfo{reason, domain "revisit", metadata}. `reason` is a
// value of revisit.v1.ErrorReason without its prefix. RetryInfo is added to
// UNAVAILABLE and RESOURCE_EXHAUSTED. A message too long for a trailer is cut.
// REQUIRES: code is not OK.
absl::Status Error(absl::StatusCode code, const std::string& reason,
                   const std::string& message,
                   const ErrorMetadata& metadata = {});

// INVALID_ARGUMENT with BadRequest; the message has the first violation and
// says how many more there are. BadRequest holds as many as fit a trailer;
// metadata `violations` counts all. REQUIRES: at least one violation.
absl::Status InvalidFields(const std::string& reason,
                           const std::vector<FieldViolation>& violations);

// Makes an error as Error() does and adds this RetryInfo and a QuotaFailure of
// one violation, which the message describes.
absl::Status QuotaExceeded(absl::StatusCode code, const std::string& reason,
                           const std::string& subject,
                           const std::string& message,
                           std::chrono::milliseconds retry_delay,
                           const ErrorMetadata& metadata = {});

// The status with this RetryInfo in place of its own.
absl::Status WithRetryDelay(std::chrono::milliseconds delay,
                            absl::Status status);

// NOT_FOUND (VEHICLE_NOT_FOUND). The words do not give away whether there is no
// such vehicle or the caller may not know of it.
absl::Status VehicleNotFound(const std::string& id);

// DATA_LOSS (STORE_CORRUPT).
absl::Status Corrupt(const std::string& what,
                     const ErrorMetadata& metadata = {});

// Ends of calls that had no answer yet: CANCELLED and DEADLINE_EXCEEDED,
// with the reasons of the same names.
absl::Status CallerGaveUp();
absl::Status DeadlinePassed();

// The reason of a status that was made here; empty for others.
std::string ReasonOf(const absl::Status& status);

// What a caller is told: the status itself if it was made here or is OK, else
// that the caller ended the call, or a defect of the server (INTERNAL).
absl::Status Named(const absl::Status& status);

}  // namespace revisit::server

#endif  // REVISIT_SERVER_BASE_STATUS_H_
