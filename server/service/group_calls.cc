#include "server/service/group_calls.h"

#include <cstdint>
#include <memory>
#include <string>
#include <utility>

#include "absl/status/statusor.h"
#include "absl/strings/str_cat.h"
#include "server/base/status.h"
#include "server/conversion/groups.h"
#include "server/conversion/names.h"
#include "server/conversion/page_token.h"
#include "server/groups/group_editor.h"
#include "server/records/group_content.h"
#include "server/service/readable_page.h"
#include "server/sessions/executor.h"
#include "server/sessions/vehicle_uid.h"
#include "server/storage/storage.h"

namespace revisit::server {
namespace {

// The group that a request was to create, as its caller may see it; an error
// unless it has these settings.
absl::Status EncodeCreated(const GroupRecord& record,
                           const GroupSettings& settings, bool may_read,
                           v1::Group* group) {
  const absl::Status status = EncodeGroup(record, group);
  const bool is_as_asked =
      status.ok() && GroupSettingsOf(group->settings()) == settings;
  if (!is_as_asked && (status.ok() || !may_read)) {
    return Error(absl::StatusCode::kAlreadyExists, "GROUP_EXISTS",
                 absl::StrCat(GroupName(record.id),
                              " exists with other settings; change them with "
                              "UpdateGroup, or take another id"));
  }
  if (!status.ok()) return status;
  if (!may_read) TrimToSettings(group);
  return absl::OkStatus();
}

// The edit that an update asks for; `changed` is the payload that the group has
// then.
absl::StatusOr<GroupEdit> EditToUpdate(const GroupRecord& group,
                                       const v1::UpdateGroupRequest& request,
                                       std::string* changed) {
  if (!group.damage.ok()) return group.damage;
  const absl::StatusOr<GroupContent> current =
      DecodeGroupContent(group.payload);
  if (!current.ok()) return current.status();
  const absl::StatusOr<GroupContent> content =
      UpdateGroupContent(*current, request.group(), request.update_mask());
  if (!content.ok()) return content.status();
  *changed = EncodeGroupContent(*content);
  return GroupEdit{{SetGroupPayload{*changed}}};
}

}  // namespace

absl::Status CreateGroup(const ServiceContext& service,
                         const UnaryCallPtr& call,
                         const v1::CreateGroupRequest& request,
                         v1::CreateGroupResponse* response) {
  const std::string& id = request.group_id();
  if (absl::Status status = CheckId(id, kRequest.Field("group_id"));
      !status.ok()) {
    return status;
  }
  if (absl::Status status = call->ChooseGroup(id); !status.ok()) return status;
  absl::StatusOr<GroupContent> content = DecodeGroup(request.group());
  if (!content.ok()) return content.status();
  content->create_time_ns = NowNanoseconds();
  GroupRecord group;
  group.id = id;
  group.version.uid = NewUuid();
  group.payload = EncodeGroupContent(*content);
  service.groups->Create(
      std::move(group), [call] { return CheckAwaited(*call); },
      FinishWith<GroupRecord>(
          call, [=, settings = content->settings](const GroupRecord& created) {
            return EncodeCreated(created, settings,
                                 MayRead(*call, created.id, Resource::kGroup),
                                 response->mutable_group());
          }));
  return absl::OkStatus();
}

absl::Status GetGroup(const ServiceContext& service, const UnaryCallPtr& call,
                      const v1::GetGroupRequest& request,
                      v1::GetGroupResponse* response) {
  const absl::StatusOr<std::string> id =
      ChooseGroup(request.name(), kRequest.Field("name"), call.get());
  if (!id.ok()) return id.status();
  service.executor->Post([=, storage = service.storage, id = *id] {
    const auto group = storage->Groups().GetGroup(id);
    call->End(group.ok() ? EncodeGroup(*group, response->mutable_group())
                         : group.status());
  });
  return absl::OkStatus();
}

absl::Status ListGroups(const ServiceContext& service, const UnaryCallPtr& call,
                        const v1::ListGroupsRequest& request,
                        v1::ListGroupsResponse* response) {
  const absl::StatusOr<AskedPage> asked = PageOf("ListGroups", request);
  if (!asked.ok()) return asked.status();
  service.executor->Post([=, storage = service.storage] {
    const absl::StatusOr<std::string> last = FillReadablePage(
        call->rights().caller(), Resource::kGroup, asked->after, asked->size,
        [&](const std::string& place, const std::string& prefix, int limit) {
          return storage->Groups().ListGroups(place, prefix, limit);
        },
        [&](const GroupRecord& record) {
          v1::Group* const group = response->add_groups();
          // One that is damaged is listed too, so that it can be found.
          static_cast<void>(EncodeGroup(record, group));
          return group->ByteSizeLong();
        });
    if (last.ok() && !last->empty()) {
      response->set_next_page_token(MakePageToken(asked->list, *last));
    }
    call->End(last.status());
  });
  return absl::OkStatus();
}

absl::Status UpdateGroup(const ServiceContext& service,
                         const UnaryCallPtr& call,
                         const v1::UpdateGroupRequest& request,
                         v1::UpdateGroupResponse* response) {
  const absl::StatusOr<std::string> id =
      ChooseGroup(request.group().name(), kRequest.Field("group").Field("name"),
                  call.get());
  if (!id.ok()) return id.status();
  const auto payload = std::make_shared<std::string>();
  service.groups->Change(
      {*id, request.expected_revision(),
       [call] { return CheckAwaited(*call); }},
      [call, payload, request = &request](const GroupRecord& group) {
        return EditToUpdate(group, *request, payload.get());
      },
      FinishWith<GroupVersion>(call, [=, id = *id, request = &request](
                                         const GroupVersion& version) {
        v1::Group* const group = response->mutable_group();
        const absl::Status status = EncodeGroup({id, version, *payload}, group);
        if (!MayRead(*call, id, Resource::kGroup))
          TrimToMask(request->update_mask(), group);
        return status;
      }));
  return absl::OkStatus();
}

absl::Status DeleteGroup(const ServiceContext& service,
                         const UnaryCallPtr& call,
                         const v1::DeleteGroupRequest& request,
                         v1::DeleteGroupResponse*) {
  const absl::StatusOr<std::string> id =
      ChooseGroup(request.name(), kRequest.Field("name"), call.get());
  if (!id.ok()) return id.status();
  service.groups->Delete({*id, request.expected_revision(),
                          [call] { return CheckAwaited(*call); }},
                         [call](const absl::StatusOr<GroupVersion>& version) {
                           call->End(version.status());
                         });
  return absl::OkStatus();
}

}  // namespace revisit::server
