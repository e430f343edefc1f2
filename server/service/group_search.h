// Gets ready searches in a group, and other calls that look at the histories
// of its members.
#ifndef REVISIT_SERVER_SERVICE_GROUP_SEARCH_H_
#define REVISIT_SERVER_SERVICE_GROUP_SEARCH_H_

#include <functional>
#include <string>
#include <vector>

#include "absl/status/statusor.h"
#include "google/protobuf/repeated_field.h"
#include "revisit/v1/candidate.pb.h"
#include "server/fields/field_violations.h"
#include "server/fleet/group_scope.h"
#include "server/service/call.h"

namespace revisit::server {

// The scope of a search of this vehicle, which looks in what the caller may
// read. Errors: INVALID_ARGUMENT, GROUP_NOT_FOUND if the caller may not know of
// the group, PERMISSION_DENIED (NOT_GRANTED) if the caller may not read it.
absl::StatusOr<ScopeRequest> DecodeScope(const v1::SearchScope& scope,
                                         const std::string& vehicle_id,
                                         const FieldPath& path, Call* call);

// The ids of the vehicles that the field `vehicles` below `path` names.
absl::StatusOr<std::vector<std::string>> DecodeVehicles(
    const google::protobuf::RepeatedPtrField<std::string>& names,
    const FieldPath& path);

// ScopeRequest::may_read of the call's caller.
std::function<bool(const std::string&)> WhatMayBeRead(const Call& call);

}  // namespace revisit::server

#endif  // REVISIT_SERVER_SERVICE_GROUP_SEARCH_H_
