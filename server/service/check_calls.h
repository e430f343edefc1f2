// Methods that read stored checks.
#ifndef REVISIT_SERVER_SERVICE_CHECK_CALLS_H_
#define REVISIT_SERVER_SERVICE_CHECK_CALLS_H_

#include "absl/status/status.h"
#include "revisit/v1/pose_graph_service.pb.h"
#include "server/service/unary_call.h"

namespace revisit::server {

// Both read what is stored, whoever owns the vehicle, so that any server of a
// store answers them.
absl::Status GetCheck(const ServiceContext& service, const UnaryCallPtr& call,
                      const v1::GetCheckRequest& request,
                      v1::GetCheckResponse* response);

absl::Status ListChecks(const ServiceContext& service, const UnaryCallPtr& call,
                        const v1::ListChecksRequest& request,
                        v1::ListChecksResponse* response);

}  // namespace revisit::server

#endif  // REVISIT_SERVER_SERVICE_CHECK_CALLS_H_
