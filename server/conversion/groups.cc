#include "server/conversion/groups.h"

#include <xxhash.h>

#include <cstdint>

#include "absl/strings/str_cat.h"
#include "google/protobuf/util/field_mask_util.h"
#include "server/conversion/loop_content.h"
#include "server/conversion/names.h"
#include "server/conversion/vehicle_labels.h"
#include "server/fields/field_violations.h"
#include "server/fields/group_settings.h"
#include "server/fields/recording_starts.h"
#include "server/fields/timestamps.h"
#include "server/groups/link_kind.h"
#include "server/storage/record_check.h"

namespace revisit::server {
namespace {

constexpr FieldPath kRequestPath;

// ---- Groups

absl::Status CheckContent(const GroupContent& content) {
  const FieldPath path = kRequestPath.Field("group");
  Violations violations;
  CheckText(content.display_name, kMaxDisplayNameBytes, TextUse::kName,
            path.Field("display_name"), &violations);
  CheckGroupSettings(content.settings, path.Field("settings"), &violations);
  return violations.ToStatus();
}

// Replaces what one path of a mask names; false if it names nothing.
bool Replace(const std::string& path, const v1::Group& group,
             GroupContent* content) {
  const GroupSettings given = GroupSettingsOf(group.settings());
  if (path == "display_name") {
    content->display_name = group.display_name();
  } else if (path == "settings") {
    content->settings = given;
  } else if (path == "settings.geodetic_origin") {
    content->settings.geodetic_origin = given.geodetic_origin;
  } else if (path == "settings.fix_bias_meters") {
    content->settings.fix_bias_meters = given.fix_bias_meters;
  } else {
    return false;
  }
  return true;
}

v1::Group IdentityOf(const v1::Group& group) {
  v1::Group identity;
  identity.set_name(group.name());
  identity.set_uid(group.uid());
  return identity;
}

// ---- Loop closures

// The pose at `path`, with a violation for each part that is wrong.
NewLink::Pose DecodePose(const v1::MemberPose& pose, const FieldPath& path,
                         Violations* violations) {
  const FieldPath vehicle = path.Field("vehicle");
  const absl::StatusOr<std::string> id =
      ParseVehicleName(pose.vehicle(), vehicle);
  if (!id.ok()) {
    violations->Add("INVALID_RESOURCE_NAME", vehicle,
                    absl::StrCat("got ", Quoted(pose.vehicle()),
                                 "; the form is vehicles/{vehicle}"));
  }
  if (pose.sequence() == 0) {
    violations->Add(kInvalidField, path.Field("sequence"),
                    "required: sequences start at 1");
  }
  return {id.ok() ? *id : std::string(), pose.sequence()};
}

// 128 bits of the poses' names, because an id has no room for two names of
// vehicles.
std::string IdOf(const NewLink::Pose& query, const NewLink::Pose& matched) {
  const std::string poses =
      absl::StrCat(query.vehicle_id, "/", query.sequence, "/",
                   matched.vehicle_id, "/", matched.sequence);
  const XXH128_hash_t hash = XXH3_128bits(poses.data(), poses.size());
  return absl::StrCat(absl::Hex(hash.high64, absl::kZeroPad16),
                      absl::Hex(hash.low64, absl::kZeroPad16));
}

void SetPose(const std::string& vehicle_id, std::uint64_t sequence,
             v1::MemberPose* pose) {
  pose->set_vehicle(VehicleName(vehicle_id));
  pose->set_sequence(sequence);
}

// Reads all of a message but its poses.
PairContent ContentOf(const v1::InterVehicleLoopClosure& closure,
                      const FieldPath& path, Violations* violations) {
  return LoopContentOf(closure, path, violations);
}
PairContent ContentOf(const v1::InterVehicleRejectedCandidate& rejection,
                      const FieldPath& path, Violations* violations) {
  return RejectionContentOf(rejection, path, violations);
}

void SetContent(const PairContent& content,
                v1::InterVehicleLoopClosure* closure) {
  SetLoopContent(content, closure);
}
void SetContent(const PairContent& content,
                v1::InterVehicleRejectedCandidate* rejection) {
  SetRejectionContent(content, rejection);
}

template <typename Message>
absl::StatusOr<NewLink> DecodeNew(PairKind kind, const Message& pair,
                                  const std::string& given_id,
                                  const std::string& decided_by) {
  const FieldPath path = kRequestPath.Field(WordsOf(kind).field);
  Violations violations;
  NewLink link;
  link.kind = kind;
  link.query = DecodePose(pair.query(), path.Field("query"), &violations);
  link.matched = DecodePose(pair.matched(), path.Field("matched"), &violations);
  if (!link.query.vehicle_id.empty() &&
      link.query.vehicle_id == link.matched.vehicle_id) {
    const FieldPath matched = path.Field("matched");
    violations.Add(
        kInvalidField, matched.Field("vehicle"),
        absl::StrCat("it is that of the query; two poses of one "
                     "vehicle are for ",
                     kind == PairKind::kLoopClosure ? "AddLoopClosure"
                                                    : "RejectCandidate"));
  }
  LinkContent content;
  content.content = ContentOf(pair, path, &violations);
  content.content.decided_by = decided_by;
  link.id = given_id.empty() ? IdOf(link.query, link.matched) : given_id;
  const std::string id_field = absl::StrCat(WordsOf(kind).field, "_id");
  const FieldPath id = kRequestPath.Field(id_field.c_str());
  const absl::Status id_status = CheckId(link.id, id);
  if (violations.count() == 0 && !id_status.ok()) return id_status;
  if (!id_status.ok()) {
    violations.Add("INVALID_RESOURCE_NAME", id,
                   absl::StrCat("got ", Quoted(link.id), ", which is no id"));
  }
  if (violations.count() > 0) return violations.ToStatus();
  link.payload = EncodeLinkContent(content);
  return link;
}

template <typename Message>
absl::Status Encode(const std::string& group_id,
                    const std::string& query_vehicle,
                    const std::string& matched_vehicle,
                    const GroupLinkRecord& record, Message* message) {
  if (!record.damage.ok()) return record.damage;
  message->set_name(GroupLinkName(KindOf(record), group_id, LinkIdOf(record)));
  SetPose(query_vehicle, record.query.sequence, message->mutable_query());
  SetPose(matched_vehicle, record.matched.sequence, message->mutable_matched());
  return ReadLinkContent(record.payload, [&](const LinkContent& link) {
    SetContent(link.content, message);
    EncodeTime(link.create_time_ns, message->mutable_create_time());
  });
}

}  // namespace

// ---- Groups

absl::StatusOr<GroupContent> DecodeGroup(const v1::Group& group) {
  GroupContent content;
  content.display_name = group.display_name();
  content.settings = GroupSettingsOf(group.settings());
  if (absl::Status status = CheckContent(content); !status.ok()) return status;
  return content;
}

absl::StatusOr<GroupContent> UpdateGroupContent(
    const GroupContent& current, const v1::Group& group,
    const google::protobuf::FieldMask& update_mask) {
  const FieldPath path = kRequestPath.Field("update_mask");
  Violations violations;
  if (update_mask.paths().empty()) {
    violations.Add(kInvalidField, path,
                   "required: name what changes, such as "
                   "\"settings.fix_bias_meters\" or \"display_name\"");
  }
  GroupContent content = current;
  for (int i = 0; i < update_mask.paths_size(); ++i) {
    if (Replace(update_mask.paths(i), group, &content)) continue;
    violations.Add(kInvalidField, path.At("paths", static_cast<std::size_t>(i)),
                   absl::StrCat("got ", Quoted(update_mask.paths(i)),
                                "; allowed are \"display_name\", \"settings\", "
                                "\"settings.geodetic_origin\" and "
                                "\"settings.fix_bias_meters\""));
  }
  if (violations.count() > 0) return violations.ToStatus();
  if (absl::Status status = CheckContent(content); !status.ok()) return status;
  return content;
}

absl::Status EncodeGroup(const GroupRecord& record, v1::Group* group) {
  // Those of a damaged row may hold bytes that no message can.
  group->set_name(GroupName(Printable(record.id)));
  group->set_uid(Printable(record.version.uid));
  group->set_revision(record.version.revision);
  if (!record.damage.ok()) return record.damage;
  const absl::StatusOr<GroupContent> content =
      DecodeGroupContent(record.payload);
  if (!content.ok()) return content.status();
  group->set_display_name(content->display_name);
  SetGroupSettings(content->settings, group->mutable_settings());
  EncodeTime(content->create_time_ns, group->mutable_create_time());
  return absl::OkStatus();
}

void TrimToSettings(v1::Group* group) {
  v1::Group trimmed = IdentityOf(*group);
  *trimmed.mutable_settings() = group->settings();
  *group = trimmed;
}

void TrimToMask(const google::protobuf::FieldMask& mask, v1::Group* group) {
  const v1::Group identity = IdentityOf(*group);
  google::protobuf::util::FieldMaskUtil::TrimMessage(mask, group);
  group->MergeFrom(identity);
}

// ---- Members

absl::StatusOr<std::string> DecodeMember(const v1::GroupMember& member,
                                         const VehicleConfig& vehicle) {
  if (!member.has_datum()) return EncodeMemberContent(nullptr);
  const FieldPath path = kRequestPath.Field("member");
  const RecordingStartFields datum = DatumFieldsOf(member.datum());
  Violations violations;
  if (vehicle.frame == CoordinateFrame::kGeodetic) {
    violations.Add(
        kInvalidField, path.Field("datum"),
        "allowed only where the vehicle's coordinate frame is LOCAL: "
        "geodetic fixes tell where it is");
  }
  DecodeRecordingStart(datum, vehicle.drive.state_space, TextCheck::kAll, path,
                       &violations);
  if (violations.count() > 0) return violations.ToStatus();
  return EncodeMemberContent(&datum);
}

absl::Status EncodeMember(const std::string& group_id,
                          const GroupMemberRecord& record,
                          v1::GroupMember* member) {
  if (!record.damage.ok()) return record.damage;
  member->set_name(MemberName(group_id, record.vehicle_id));
  member->set_vehicle(VehicleName(record.vehicle_id));
  return ReadMemberContent(record.payload,
                           [&](const RecordingStartFields* datum) {
                             if (datum != nullptr)
                               SetDatum(*datum, member->mutable_datum());
                           });
}

// ---- Loop closures and rejected candidates

absl::StatusOr<NewLink> DecodeLink(
    const v1::AddInterVehicleLoopClosureRequest& request,
    const std::string& decided_by) {
  return DecodeNew(PairKind::kLoopClosure, request.loop_closure(),
                   request.loop_closure_id(), decided_by);
}

absl::StatusOr<NewLink> DecodeLink(
    const v1::RejectInterVehicleCandidateRequest& request,
    const std::string& decided_by) {
  return DecodeNew(PairKind::kRejectedCandidate, request.rejected_candidate(),
                   request.rejected_candidate_id(), decided_by);
}

absl::Status EncodeLink(const std::string& group_id,
                        const std::string& query_vehicle,
                        const std::string& matched_vehicle,
                        const GroupLinkRecord& record,
                        v1::InterVehicleLoopClosure* closure) {
  return Encode(group_id, query_vehicle, matched_vehicle, record, closure);
}

absl::Status EncodeLink(const std::string& group_id,
                        const std::string& query_vehicle,
                        const std::string& matched_vehicle,
                        const GroupLinkRecord& record,
                        v1::InterVehicleRejectedCandidate* rejection) {
  return Encode(group_id, query_vehicle, matched_vehicle, record, rejection);
}

}  // namespace revisit::server
