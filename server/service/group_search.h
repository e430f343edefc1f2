// What a search in a group needs before it can be made.
#ifndef REVISIT_SERVER_SERVICE_GROUP_SEARCH_H_
#define REVISIT_SERVER_SERVICE_GROUP_SEARCH_H_

#include <string>

#include "absl/status/statusor.h"
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

}  // namespace revisit::server

#endif  // REVISIT_SERVER_SERVICE_GROUP_SEARCH_H_
