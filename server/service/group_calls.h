// The handlers of calls about groups as a whole. They are UnaryHandlers
// (unary_call.h).
#ifndef REVISIT_SERVER_SERVICE_GROUP_CALLS_H_
#define REVISIT_SERVER_SERVICE_GROUP_CALLS_H_

#include "absl/status/status.h"
#include "revisit/v1/pose_graph_service.pb.h"
#include "server/service/service_context.h"
#include "server/service/unary_call.h"

namespace revisit::server {

absl::Status CreateGroup(const ServiceContext& service,
                         const UnaryCallPtr& call,
                         const v1::CreateGroupRequest& request,
                         v1::CreateGroupResponse* response);

absl::Status GetGroup(const ServiceContext& service, const UnaryCallPtr& call,
                      const v1::GetGroupRequest& request,
                      v1::GetGroupResponse* response);

absl::Status ListGroups(const ServiceContext& service, const UnaryCallPtr& call,
                        const v1::ListGroupsRequest& request,
                        v1::ListGroupsResponse* response);

absl::Status UpdateGroup(const ServiceContext& service,
                         const UnaryCallPtr& call,
                         const v1::UpdateGroupRequest& request,
                         v1::UpdateGroupResponse* response);

absl::Status DeleteGroup(const ServiceContext& service,
                         const UnaryCallPtr& call,
                         const v1::DeleteGroupRequest& request,
                         v1::DeleteGroupResponse* response);

}  // namespace revisit::server

#endif  // REVISIT_SERVER_SERVICE_GROUP_CALLS_H_
