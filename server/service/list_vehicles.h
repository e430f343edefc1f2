// The handler of ListVehicles.
#ifndef REVISIT_SERVER_SERVICE_LIST_VEHICLES_H_
#define REVISIT_SERVER_SERVICE_LIST_VEHICLES_H_

#include "absl/status/status.h"
#include "revisit/v1/pose_graph_service.pb.h"
#include "server/service/unary_call.h"

namespace revisit::server {

// Finishes the call, unless it returns an error. Request and response live as
// long as the call.
absl::Status ListVehicles(const ServiceContext& context,
                          const UnaryCallPtr& call,
                          const v1::ListVehiclesRequest& request,
                          v1::ListVehiclesResponse* response);

}  // namespace revisit::server

#endif  // REVISIT_SERVER_SERVICE_LIST_VEHICLES_H_
