// The handlers of calls about one vehicle as a whole. They are UnaryHandlers
// (unary_call.h).
#ifndef REVISIT_SERVER_SERVICE_VEHICLE_CALLS_H_
#define REVISIT_SERVER_SERVICE_VEHICLE_CALLS_H_

#include "absl/status/status.h"
#include "revisit/v1/pose_graph_service.pb.h"
#include "server/service/service_context.h"
#include "server/service/unary_call.h"

namespace revisit::server {

absl::Status CreateVehicle(const ServiceContext& service,
                           const UnaryCallPtr& call,
                           const v1::CreateVehicleRequest& request,
                           v1::CreateVehicleResponse* response);

absl::Status GetVehicle(const ServiceContext& service, const UnaryCallPtr& call,
                        const v1::GetVehicleRequest& request,
                        v1::GetVehicleResponse* response);

absl::Status UpdateVehicle(const ServiceContext& service,
                           const UnaryCallPtr& call,
                           const v1::UpdateVehicleRequest& request,
                           v1::UpdateVehicleResponse* response);

absl::Status DeleteVehicle(const ServiceContext& service,
                           const UnaryCallPtr& call,
                           const v1::DeleteVehicleRequest& request,
                           v1::DeleteVehicleResponse* response);

absl::Status AcceptDataLoss(const ServiceContext& service,
                            const UnaryCallPtr& call,
                            const v1::AcceptDataLossRequest& request,
                            v1::AcceptDataLossResponse* response);

}  // namespace revisit::server

#endif  // REVISIT_SERVER_SERVICE_VEHICLE_CALLS_H_
