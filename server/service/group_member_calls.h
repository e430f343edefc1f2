// The handlers of calls about the members of groups. They are UnaryHandlers
// (unary_call.h). Two have other names than their methods, which are those of
// changes in the store (group_records.h).
#ifndef REVISIT_SERVER_SERVICE_GROUP_MEMBER_CALLS_H_
#define REVISIT_SERVER_SERVICE_GROUP_MEMBER_CALLS_H_

#include "absl/status/status.h"
#include "revisit/v1/pose_graph_service.pb.h"
#include "server/service/service_context.h"
#include "server/service/unary_call.h"

namespace revisit::server {

absl::Status AddMemberToGroup(const ServiceContext& service,
                              const UnaryCallPtr& call,
                              const v1::AddGroupMemberRequest& request,
                              v1::AddGroupMemberResponse* response);

absl::Status UpdateGroupMember(const ServiceContext& service,
                               const UnaryCallPtr& call,
                               const v1::UpdateGroupMemberRequest& request,
                               v1::UpdateGroupMemberResponse* response);

absl::Status RemoveMemberFromGroup(const ServiceContext& service,
                                   const UnaryCallPtr& call,
                                   const v1::RemoveGroupMemberRequest& request,
                                   v1::RemoveGroupMemberResponse* response);

absl::Status ListGroupMembers(const ServiceContext& service,
                              const UnaryCallPtr& call,
                              const v1::ListGroupMembersRequest& request,
                              v1::ListGroupMembersResponse* response);

}  // namespace revisit::server

#endif  // REVISIT_SERVER_SERVICE_GROUP_MEMBER_CALLS_H_
