// Matchers of errors for tests.
#ifndef REVISIT_TESTS_SERVER_ERROR_MATCHERS_H_
#define REVISIT_TESTS_SERVER_ERROR_MATCHERS_H_

#include <string>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "gmock/gmock.h"
#include "google/rpc/error_details.pb.h"
#include "server/base/status.h"

namespace revisit::server {

inline absl::Status StatusOf(const absl::Status& status) { return status; }
template <typename T>
absl::Status StatusOf(const absl::StatusOr<T>& result) {
  return result.status();
}

// Value of one key of ErrorInfo.metadata; empty if there is none.
inline std::string MetadataOf(const absl::Status& status,
                              const std::string& key) {
  google::rpc::ErrorInfo info;
  const auto payload = status.GetPayload(kErrorInfoUrl);
  if (!payload || !info.ParseFromString(std::string(*payload))) return "";
  const auto found = info.metadata().find(key);
  return found == info.metadata().end() ? "" : found->second;
}

MATCHER(IsOk, "is OK") {
  *result_listener << StatusOf(arg).ToString();
  return StatusOf(arg).ok();
}

// A status or StatusOr with this code and reason, and a message that matches.
MATCHER_P3(IsError, code, reason, message, "") {
  const absl::Status status = StatusOf(arg);
  *result_listener << status.ToString() << " with reason '" << ReasonOf(status)
                   << "'";
  return status.code() == code &&
         ::testing::Matches(reason)(ReasonOf(status)) &&
         ::testing::Matches(message)(std::string(status.message()));
}

}  // namespace revisit::server

#endif  // REVISIT_TESTS_SERVER_ERROR_MATCHERS_H_
