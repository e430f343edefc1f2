#include "server/base/status_grpc.h"

#include <string>

#include "absl/strings/cord.h"
#include "absl/strings/string_view.h"
#include "google/rpc/status.pb.h"
#include "server/base/status.h"

namespace revisit::server {

grpc::Status ToGrpcStatus(const absl::Status& status) {
  if (status.ok()) return grpc::Status::OK;
  google::rpc::Status details;
  details.set_code(status.raw_code());
  details.set_message(std::string(status.message()));
  // ErrorInfo first: some clients look no further.
  const auto add = [&](absl::string_view url, const absl::Cord& payload) {
    auto* any = details.add_details();
    any->set_type_url(std::string(url));
    any->set_value(std::string(payload));
  };
  for (const char* url : {kErrorInfoUrl, kBadRequestUrl, kRetryInfoUrl}) {
    const auto payload = status.GetPayload(url);
    if (payload.has_value()) add(url, *payload);
  }
  status.ForEachPayload([&](absl::string_view url, const absl::Cord& payload) {
    if (url != kErrorInfoUrl && url != kBadRequestUrl && url != kRetryInfoUrl) {
      add(url, payload);
    }
  });
  return grpc::Status(static_cast<grpc::StatusCode>(status.raw_code()),
                      details.message(), details.SerializeAsString());
}

}  // namespace revisit::server
