#include "server/service/group_search.h"

#include <memory>
#include <utility>

#include "server/conversion/names.h"
#include "server/security/caller.h"

namespace revisit::server {

absl::StatusOr<ScopeRequest> DecodeScope(const v1::SearchScope& scope,
                                         const std::string& vehicle_id,
                                         const FieldPath& path, Call* call) {
  absl::StatusOr<std::string> group =
      ParseGroupName(scope.group(), path.Field("group"));
  if (!group.ok()) return group.status();
  ScopeRequest request;
  for (int i = 0; i < scope.vehicles_size(); ++i) {
    absl::StatusOr<std::string> id = ParseVehicleName(
        scope.vehicles(i), path.At("vehicles", static_cast<std::size_t>(i)));
    if (!id.ok()) return id.status();
    request.vehicles.push_back(*std::move(id));
  }
  if (absl::Status status =
          call->rights().AlsoNeeds(Verb::kRead, *group, Resource::kGroup);
      !status.ok()) {
    return status;
  }
  request.group = *std::move(group);
  request.asking = vehicle_id;
  request.exclude_own = scope.exclude_own();
  request.allow_partial = scope.allow_partial();
  request.may_read = [caller = call->rights().Now()](const std::string& id) {
    return caller->May(Verb::kRead, id);
  };
  return request;
}

}  // namespace revisit::server
