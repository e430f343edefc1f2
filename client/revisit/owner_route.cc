#include "client/revisit/owner_route.h"

#include "absl/strings/escaping.h"
#include "client/revisit/status.h"
#include "grpcpp/client_context.h"

namespace revisit::client {

void RouteToOwner(const absl::Status& last, grpc::ClientContext* context) {
  const ErrorDetails details = DetailsOf(last);
  if (details.reason != "NOT_OWNER") return;
  const auto owner = details.metadata.find("owner");
  if (owner == details.metadata.end() || owner->second.empty()) return;
  context->AddMetadata("x-revisit-owner", absl::Base64Escape(owner->second));
}

}  // namespace revisit::client
