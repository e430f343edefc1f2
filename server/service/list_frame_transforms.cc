#include "server/service/list_frame_transforms.h"

#include <cstddef>
#include <cstdint>
#include <string>
#include <tuple>
#include <utility>
#include <vector>

#include "absl/strings/str_cat.h"
#include "core/drive/frame_relation.h"
#include "core/drive/joined_drives.h"
#include "server/conversion/frames.h"
#include "server/conversion/page_token.h"
#include "server/fleet/group_scope.h"
#include "server/fleet/group_searches.h"
#include "server/service/group_search.h"

namespace revisit::server {
namespace {

constexpr int kMostVehicles = 100;

// Reads the request, which is about a group that the caller may read.
absl::StatusOr<ScopeRequest> DecodeRequest(
    const v1::ListFrameTransformsRequest& request, UnaryCall* call) {
  absl::StatusOr<std::string> group =
      ChooseGroup(request.parent(), kRequest.Field("parent"), call);
  if (!group.ok()) return group.status();
  absl::StatusOr<std::string> asking =
      ParseVehicleName(request.vehicle(), kRequest.Field("vehicle"));
  if (!asking.ok()) return asking.status();
  call->record().NameVehicle(*asking);
  if (request.vehicles_size() > kMostVehicles) {
    return InvalidField(kInvalidField, kRequest.Field("vehicles"),
                        absl::StrCat("got ", request.vehicles_size(),
                                     "; allowed are ", kMostVehicles));
  }
  absl::StatusOr<std::vector<std::string>> vehicles =
      DecodeVehicles(request.vehicles(), kRequest);
  if (!vehicles.ok()) return vehicles.status();
  ScopeRequest scope;
  scope.group = *std::move(group);
  scope.asking = *std::move(asking);
  scope.needs_asking = true;
  scope.vehicles = *std::move(vehicles);
  scope.allow_partial = request.allow_partial();
  scope.may_read = WhatMayBeRead(*call);
  return scope;
}

// Which list a page is one of.
std::string ListOf(const v1::ListFrameTransformsRequest& request) {
  std::string list = absl::StrCat("ListFrameTransforms ", request.parent(), " ",
                                  request.vehicle());
  for (const std::string& vehicle : request.vehicles()) {
    absl::StrAppend(&list, " ", vehicle);
  }
  return list;
}

// Fills a page with the recordings behind this place.
void ListSome(const GroupScope& scope, const VehiclePlace& after, int page_size,
              const std::string& list,
              v1::ListFrameTransformsResponse* response) {
  const JoinedGroup& joined = *scope.joined;
  response->set_group_revision(joined.group->version.revision);
  const std::vector<std::vector<core::FrameRelation>> relations =
      joined.drives->SeenFromLast(*scope.scope.asking);
  VehiclePlace last;
  for (std::size_t d = 0; d < joined.histories.size(); ++d) {
    if (!scope.scope.searched[d]) continue;
    const KnownHistory& history = *joined.histories[d];
    for (std::size_t k = 0; k < relations[d].size(); ++k) {
      const std::uint64_t first = history.view->recordings[k].first_sequence;
      if (std::tie(history.vehicle_id, first) <=
          std::tie(after.vehicle_id, after.sequence)) {
        continue;
      }
      if (response->frame_transforms_size() == page_size) {
        response->set_next_page_token(MakePageToken(list, last));
        return;
      }
      EncodeFrameTransform(history, k, relations[d][k],
                           response->add_frame_transforms());
      last = {history.vehicle_id, first};
    }
  }
}

}  // namespace

absl::Status ListFrameTransforms(const ServiceContext& service,
                                 const UnaryCallPtr& call,
                                 const v1::ListFrameTransformsRequest& request,
                                 v1::ListFrameTransformsResponse* response) {
  absl::StatusOr<ScopeRequest> scope = DecodeRequest(request, call.get());
  if (!scope.ok()) return scope.status();
  const std::string list = ListOf(request);
  const absl::StatusOr<int> page_size =
      PageSize(request.page_size(), 100, 1000);
  if (!page_size.ok()) return page_size.status();
  const absl::StatusOr<VehiclePlace> after =
      ParsePlaceToken(list, request.page_token());
  if (!after.ok()) return after.status();
  service.group_searches->Prepare(
      *std::move(scope),
      FinishWith<GroupScope>(call, [=](const GroupScope& ready) {
        ListSome(ready, *after, *page_size, list, response);
        return absl::OkStatus();
      }));
  return absl::OkStatus();
}

}  // namespace revisit::server
