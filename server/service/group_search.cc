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
  absl::StatusOr<std::vector<std::string>> vehicles =
      DecodeVehicles(scope.vehicles(), path);
  if (!vehicles.ok()) return vehicles.status();
  ScopeRequest request;
  request.vehicles = *std::move(vehicles);
  if (absl::Status status =
          call->rights().AlsoNeeds(Verb::kRead, *group, Resource::kGroup);
      !status.ok()) {
    return status;
  }
  request.group = *std::move(group);
  request.asking = vehicle_id;
  request.exclude_own = scope.exclude_own();
  request.allow_partial = scope.allow_partial();
  request.may_read = WhatMayBeRead(*call);
  return request;
}

absl::StatusOr<std::vector<std::string>> DecodeVehicles(
    const google::protobuf::RepeatedPtrField<std::string>& names,
    const FieldPath& path) {
  std::vector<std::string> ids;
  for (int i = 0; i < names.size(); ++i) {
    absl::StatusOr<std::string> id = ParseVehicleName(
        names[i], path.At("vehicles", static_cast<std::size_t>(i)));
    if (!id.ok()) return id.status();
    ids.push_back(*std::move(id));
  }
  return ids;
}

std::function<bool(const std::string&)> WhatMayBeRead(const Call& call) {
  return [caller = call.rights().Now()](const std::string& id) {
    return caller->May(Verb::kRead, id);
  };
}

}  // namespace revisit::server
