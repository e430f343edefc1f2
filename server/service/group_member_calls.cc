#include "server/service/group_member_calls.h"

#include <cstdint>
#include <map>
#include <memory>
#include <string>
#include <utility>

#include "absl/status/statusor.h"
#include "absl/strings/str_cat.h"
#include "server/conversion/groups.h"
#include "server/conversion/names.h"
#include "server/conversion/page_token.h"
#include "server/groups/group_edits.h"
#include "server/groups/group_reads.h"
#include "server/groups/stored_vehicle.h"
#include "server/records/proto_record_codec.h"
#include "server/service/readable_page.h"
#include "server/sessions/executor.h"
#include "server/storage/storage.h"

namespace revisit::server {
namespace {

// Names the group and, in it, what `parsed` is the name of.
absl::Status ChooseInGroup(const absl::StatusOr<NameInGroup>& parsed,
                           UnaryCall* call) {
  if (!parsed.ok()) return parsed.status();
  return call->ChooseGroup(parsed->group_id);
}

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

// Fills a page with rows of a group, in the order of their ids. Damaged rows
// are left out; a page of its own, behind all others, says what is wrong with
// them.
//   `visit`: VisitMembers() or VisitLinks() with one of their visitors;
//   `id_of(row)`; `add(row)`: puts one on the page, and says how many bytes it
//   takes, or nothing where the caller may not read it.
template <typename Row, typename IdOf, typename Add, typename Response>
absl::Status FillPage(
    const std::function<absl::Status(const std::function<bool(Row&)>&)>& visit,
    const IdOf& id_of, const Add& add, const AskedPage& asked,
    Response* response) {
  PageFill page{asked.size};
  std::string last;
  bool is_last = true;
  absl::Status damage;
  const absl::Status status = visit([&](Row& row) {
    const std::string id = id_of(row);
    if (row.damage.ok() && id <= asked.after) return true;
    if (row.damage.ok() && page.is_full()) {
      is_last = false;
      return false;
    }
    const absl::StatusOr<std::size_t> bytes = add(row);
    if (!bytes.ok()) {
      damage.Update(bytes.status());
    } else if (*bytes > 0) {
      page.Add(*bytes);
      last = id;
    }
    return true;
  });
  if (!status.ok()) return status;
  if (is_last && damage.ok()) return absl::OkStatus();
  // A page that is full has a last one.
  if (last.empty()) return damage;
  response->set_next_page_token(MakePageToken(asked.list, last));
  return absl::OkStatus();
}

}  // namespace

// ---- Members

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
    call->End(FillPage<GroupMemberRecord>(
        visit,
        [](const GroupMemberRecord& record) { return record.vehicle_id; }, add,
        *asked, response));
  });
  return absl::OkStatus();
}

// ---- Loop closures

absl::Status AddInterVehicleLoopClosure(
    const ServiceContext& service, const UnaryCallPtr& call,
    const v1::AddInterVehicleLoopClosureRequest& request,
    v1::AddInterVehicleLoopClosureResponse* response) {
  const absl::StatusOr<std::string> group =
      ChooseGroup(request.parent(), kRequest.Field("parent"), call.get());
  if (!group.ok()) return group.status();
  absl::StatusOr<NewLink> decoded =
      DecodeLink(request, call->rights().caller().identity);
  if (!decoded.ok()) return decoded.status();
  call->record().NameChanged(decoded->id);
  for (const NewLink::Pose& pose : {decoded->query, decoded->matched}) {
    const absl::Status status =
        call->rights().AlsoNeeds(Verb::kRead, pose.vehicle_id);
    if (!status.ok()) return status;
  }
  const auto wanted = std::make_shared<const NewLink>(*std::move(decoded));
  const auto link = std::make_shared<GroupLinkRecord>();
  service.groups->Change(
      {*group, 0, [call] { return CheckAwaited(*call); }},
      [=, storage = service.storage](const GroupRecord& record) {
        return EditToAddLink(storage, ProtoRecordCodec(), record, *wanted,
                             NowNanoseconds(), GroupLimits(), link.get());
      },
      FinishWith<GroupVersion>(
          call, [=, group_id = *group](const GroupVersion& version) {
            response->set_revision(version.revision);
            return EncodeLink(group_id, wanted->query.vehicle_id,
                              wanted->matched.vehicle_id, *link,
                              response->mutable_loop_closure());
          }));
  return absl::OkStatus();
}

absl::Status ListInterVehicleLoopClosures(
    const ServiceContext& service, const UnaryCallPtr& call,
    const v1::ListInterVehicleLoopClosuresRequest& request,
    v1::ListInterVehicleLoopClosuresResponse* response) {
  const absl::StatusOr<std::string> group =
      ChooseGroup(request.parent(), kRequest.Field("parent"), call.get());
  if (!group.ok()) return group.status();
  const absl::StatusOr<AskedPage> asked = PageOf(
      absl::StrCat("ListInterVehicleLoopClosures ", request.parent()), request);
  if (!asked.ok()) return asked.status();
  service.executor->Post([=, storage = service.storage, group_id = *group] {
    // Those that the caller may read.
    std::map<VehicleKey, std::string> vehicles;
    const absl::Status status = VisitMembers(
        &storage->Groups(), group_id, [&](GroupMemberRecord& member) {
          if (MayRead(*call, member.vehicle_id)) {
            vehicles.emplace(member.vehicle, std::move(member.vehicle_id));
          }
          return true;
        });
    if (!status.ok()) {
      call->End(status);
      return;
    }
    const auto visit =
        [&](const std::function<bool(GroupLinkRecord&)>& visitor) {
          return VisitLinks(&storage->Groups(), group_id, visitor);
        };
    const auto add =
        [&](const GroupLinkRecord& record) -> absl::StatusOr<std::size_t> {
      if (!record.damage.ok()) return record.damage;
      const auto query = vehicles.find(record.query.vehicle);
      const auto matched = vehicles.find(record.matched.vehicle);
      if (query == vehicles.end() || matched == vehicles.end()) {
        return std::size_t{0};
      }
      v1::InterVehicleLoopClosure closure;
      const absl::Status encoded = EncodeLink(
          group_id, query->second, matched->second, record, &closure);
      if (!encoded.ok()) return encoded;
      const std::size_t bytes = closure.ByteSizeLong();
      *response->add_loop_closures() = std::move(closure);
      return bytes;
    };
    call->End(FillPage<GroupLinkRecord>(
        visit, [](const GroupLinkRecord& record) { return record.id; }, add,
        *asked, response));
  });
  return absl::OkStatus();
}

absl::Status DeleteInterVehicleLoopClosure(
    const ServiceContext& service, const UnaryCallPtr& call,
    const v1::DeleteInterVehicleLoopClosureRequest& request,
    v1::DeleteInterVehicleLoopClosureResponse* response) {
  const absl::StatusOr<NameInGroup> name =
      ParseGroupLinkName(request.name(), kRequest.Field("name"));
  if (absl::Status status = ChooseInGroup(name, call.get()); !status.ok()) {
    return status;
  }
  call->record().NameChanged(name->id);
  service.groups->Change(
      {name->group_id, 0, [call] { return CheckAwaited(*call); }},
      [id = name->id](const GroupRecord&) {
        return GroupEdit{{RemoveGroupLink{id}}, true};
      },
      FinishWith<GroupVersion>(call, [=](const GroupVersion& version) {
        response->set_revision(version.revision);
        return absl::OkStatus();
      }));
  return absl::OkStatus();
}

}  // namespace revisit::server
