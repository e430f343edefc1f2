#include "server/service/group_member_calls.h"

#include <cstdint>
#include <memory>
#include <string>
#include <utility>

#include "absl/status/statusor.h"
#include "absl/strings/str_cat.h"
#include "server/conversion/groups.h"
#include "server/groups/group_edits.h"
#include "server/groups/group_reads.h"
#include "server/groups/stored_vehicle.h"
#include "server/records/proto_record_codec.h"
#include "server/service/group_page.h"
#include "server/sessions/executor.h"
#include "server/storage/storage.h"

namespace revisit::server {
namespace {

// The vehicle that is to join a group, if the caller may have it join.
absl::StatusOr<std::string> ChooseJoining(const std::string& group_id,
                                          const std::string& name,
                                          UnaryCall* call) {
  const FieldPath member = kRequest.Field("member");
  const FieldPath path = member.Field("vehicle");
  absl::StatusOr<std::string> vehicle = ParseVehicleName(name, path);
  if (!vehicle.ok()) return vehicle;
  call->record().NameVehicle(*vehicle);
  if (absl::Status status = call->rights().AlsoNeeds(Verb::kWrite, *vehicle);
      !status.ok()) {
    return status;
  }
  if (!call->rights().caller().AreOfOneTenant(group_id, *vehicle)) {
    return InvalidField(
        kInvalidField, path,
        absl::StrCat("got ", Quoted(name),
                     ", which is of another tenant than the group"));
  }
  return vehicle;
}

// The edit that joins a vehicle to a group; `member` is what there is then.
absl::StatusOr<GroupEdit> EditToJoin(Storage* storage, const GroupRecord& group,
                                     const std::string& vehicle_id,
                                     const v1::GroupMember& asked,
                                     GroupMemberRecord* member) {
  const auto vehicle =
      FindStoredVehicle(storage, ProtoRecordCodec(), vehicle_id);
  if (!vehicle.ok()) return vehicle.status();
  absl::StatusOr<std::string> payload = DecodeMember(asked, vehicle->config);
  if (!payload.ok()) return payload.status();
  *member = {vehicle->key, *std::move(payload), vehicle_id};
  return EditToAddMember(&storage->Groups(), group, *member, GroupLimits());
}

// The member of this vehicle, unless the caller may not know of the vehicle.
absl::StatusOr<GroupMemberRecord> FindKnownMember(
    Storage* storage, const UnaryCall& call, const std::string& group_id,
    const std::string& vehicle_id) {
  if (!call.rights().caller().MaySee(vehicle_id)) {
    return VehicleIsNoMember(group_id, vehicle_id);
  }
  return FindMember(&storage->Groups(), group_id, vehicle_id);
}

// The edit that gives a member another datum.
absl::StatusOr<GroupEdit> EditToReplace(Storage* storage,
                                        const v1::GroupMember& asked,
                                        GroupMemberRecord* member) {
  const auto vehicle =
      FindStoredVehicle(storage, ProtoRecordCodec(), member->vehicle_id);
  if (!vehicle.ok()) return vehicle.status();
  absl::StatusOr<std::string> payload = DecodeMember(asked, vehicle->config);
  if (!payload.ok()) return payload.status();
  member->payload = *std::move(payload);
  // The damage of the row that is replaced.
  member->damage = absl::OkStatus();
  return GroupEdit{{SetGroupMember{*member}}, true};
}

}  // namespace

absl::Status AddMemberToGroup(const ServiceContext& service,
                              const UnaryCallPtr& call,
                              const v1::AddGroupMemberRequest& request,
                              v1::AddGroupMemberResponse* response) {
  const absl::StatusOr<std::string> group =
      ChooseGroup(request.parent(), kRequest.Field("parent"), call.get());
  if (!group.ok()) return group.status();
  const absl::StatusOr<std::string> vehicle =
      ChooseJoining(*group, request.member().vehicle(), call.get());
  if (!vehicle.ok()) return vehicle.status();
  const auto member = std::make_shared<GroupMemberRecord>();
  service.groups->Change(
      {*group, 0, [call] { return CheckAwaited(*call); }},
      [=, storage = service.storage, vehicle_id = *vehicle,
       asked = &request.member()](const GroupRecord& record) {
        return EditToJoin(storage, record, vehicle_id, *asked, member.get());
      },
      FinishWith<GroupVersion>(
          call, [=, group_id = *group](const GroupVersion& version) {
            response->set_revision(version.revision);
            return EncodeMember(group_id, *member, response->mutable_member());
          }));
  return absl::OkStatus();
}

absl::Status UpdateGroupMember(const ServiceContext& service,
                               const UnaryCallPtr& call,
                               const v1::UpdateGroupMemberRequest& request,
                               v1::UpdateGroupMemberResponse* response) {
  const FieldPath field = kRequest.Field("member");
  const absl::StatusOr<NameInGroup> name =
      ParseMemberName(request.member().name(), field.Field("name"));
  if (absl::Status status = ChooseInGroup(name, call.get()); !status.ok()) {
    return status;
  }
  call->record().NameVehicle(name->id);
  const auto member = std::make_shared<GroupMemberRecord>();
  service.groups->Change(
      {name->group_id, request.expected_revision(),
       [call] { return CheckAwaited(*call); }},
      [=, storage = service.storage, vehicle_id = name->id,
       asked = &request.member()](
          const GroupRecord& group) -> absl::StatusOr<GroupEdit> {
        auto found = FindKnownMember(storage, *call, group.id, vehicle_id);
        if (!found.ok()) return found.status();
        *member = *std::move(found);
        return EditToReplace(storage, *asked, member.get());
      },
      FinishWith<GroupVersion>(
          call, [=, group_id = name->group_id](const GroupVersion& version) {
            response->set_revision(version.revision);
            return EncodeMember(group_id, *member, response->mutable_member());
          }));
  return absl::OkStatus();
}

absl::Status RemoveMemberFromGroup(const ServiceContext& service,
                                   const UnaryCallPtr& call,
                                   const v1::RemoveGroupMemberRequest& request,
                                   v1::RemoveGroupMemberResponse* response) {
  const absl::StatusOr<NameInGroup> name =
      ParseMemberName(request.name(), kRequest.Field("name"));
  if (absl::Status status = ChooseInGroup(name, call.get()); !status.ok()) {
    return status;
  }
  call->record().NameVehicle(name->id);
  service.groups->Change(
      {name->group_id, 0, [call] { return CheckAwaited(*call); }},
      [=, storage = service.storage, vehicle_id = name->id](
          const GroupRecord& group) -> absl::StatusOr<GroupEdit> {
        const auto found =
            FindKnownMember(storage, *call, group.id, vehicle_id);
        if (!found.ok()) return found.status();
        return GroupEdit{{RemoveGroupMember{found->vehicle}}, true};
      },
      FinishWith<GroupVersion>(call, [=](const GroupVersion& version) {
        response->set_revision(version.revision);
        return absl::OkStatus();
      }));
  return absl::OkStatus();
}

absl::Status ListGroupMembers(const ServiceContext& service,
                              const UnaryCallPtr& call,
                              const v1::ListGroupMembersRequest& request,
                              v1::ListGroupMembersResponse* response) {
  const absl::StatusOr<std::string> group =
      ChooseGroup(request.parent(), kRequest.Field("parent"), call.get());
  if (!group.ok()) return group.status();
  const absl::StatusOr<AskedPage> asked =
      PageOf(absl::StrCat("ListGroupMembers ", request.parent()), request);
  if (!asked.ok()) return asked.status();
  service.executor->Post([=, storage = service.storage, group_id = *group] {
    const auto visit =
        [&](const std::function<bool(GroupMemberRecord&)>& visitor) {
          return VisitMembers(&storage->Groups(), group_id, visitor);
        };
    const auto add =
        [&](const GroupMemberRecord& record) -> absl::StatusOr<std::size_t> {
      if (!MayRead(*call, record.vehicle_id)) return std::size_t{0};
      v1::GroupMember member;
      const absl::Status status = EncodeMember(group_id, record, &member);
      if (!status.ok()) return status;
      *response->add_members() = std::move(member);
      return response->members(response->members_size() - 1).ByteSizeLong();
    };
    call->End(FillGroupPage<GroupMemberRecord>(
        visit,
        [](const GroupMemberRecord& record) { return record.vehicle_id; }, add,
        *asked, response));
  });
  return absl::OkStatus();
}

}  // namespace revisit::server
