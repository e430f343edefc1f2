// The handler of GetServerInfo, a UnaryHandler (unary_call.h).
#ifndef REVISIT_SERVER_SERVICE_SERVER_INFO_H_
#define REVISIT_SERVER_SERVICE_SERVER_INFO_H_

#include "absl/status/status.h"
#include "revisit/v1/pose_graph_service.pb.h"
#include "server/service/service_context.h"
#include "server/service/unary_call.h"

namespace revisit::server {

absl::Status GetServerInfo(const ServiceContext& service,
                           const UnaryCallPtr& call,
                           const v1::GetServerInfoRequest& request,
                           v1::GetServerInfoResponse* response);

}  // namespace revisit::server

#endif  // REVISIT_SERVER_SERVICE_SERVER_INFO_H_
