#include "server/records/group_content.h"

#include "absl/strings/str_cat.h"
#include "server/base/status.h"
#include "server/fields/field_violations.h"
#include "server/fields/recording_starts.h"
#include "server/fields/timestamps.h"
#include "server/records/stored_records.pb.h"

namespace revisit::server {
namespace {

// Message: one with a `create_time`. `what`: such as "group".
template <typename Message>
absl::StatusOr<std::int64_t> CreateTimeOf(const Message& message,
                                          const char* what) {
  Violations violations;
  if (!message.has_create_time() ||
      !CheckTimestamp(message.create_time(), FieldPath(), &violations)) {
    return Corrupt(absl::StrCat("a stored ", what, " has no creation time"));
  }
  return ToNanoseconds(message.create_time());
}

absl::StatusOr<stored::GroupLink> ParseLink(const std::string& payload) {
  stored::GroupLink link;
  if (!link.ParseFromString(payload)) {
    return Corrupt("a stored link of a group is not a GroupLink");
  }
  return link;
}

}  // namespace

// ---- Groups

std::string EncodeGroupContent(const GroupContent& content) {
  stored::Group group;
  group.set_display_name(content.display_name);
  SetGroupSettings(content.settings, group.mutable_settings());
  EncodeTime(content.create_time_ns, group.mutable_create_time());
  return group.SerializeAsString();
}

absl::StatusOr<GroupContent> DecodeGroupContent(const std::string& payload) {
  stored::Group group;
  if (!group.ParseFromString(payload)) {
    return Corrupt("a stored group is not a Group");
  }
  GroupContent content;
  content.display_name = group.display_name();
  content.settings = GroupSettingsOf(group.settings());
  const FieldPath path;
  Violations violations;
  CheckGroupSettings(content.settings, path.Field("settings"), &violations);
  if (violations.count() > 0) {
    return Corrupt(absl::StrCat("a stored group does not decode: ",
                                violations.ToStatus().message()));
  }
  const auto create_time = CreateTimeOf(group, "group");
  if (!create_time.ok()) return create_time.status();
  content.create_time_ns = *create_time;
  return content;
}

// ---- Members

std::string EncodeMemberContent(const RecordingStartFields* datum) {
  stored::GroupMember member;
  if (datum != nullptr) SetDatum(*datum, member.mutable_datum());
  return member.SerializeAsString();
}

absl::Status ReadMemberContent(
    const std::string& payload,
    const std::function<void(const RecordingStartFields*)>& read) {
  stored::GroupMember member;
  if (!member.ParseFromString(payload)) {
    return Corrupt("a stored member of a group is not a GroupMember");
  }
  if (member.has_datum()) {
    const RecordingStartFields datum = DatumFieldsOf(member.datum());
    read(&datum);
  } else {
    read(nullptr);
  }
  return absl::OkStatus();
}

absl::StatusOr<std::shared_ptr<const core::RecordingStart>> DecodeMemberDatum(
    const std::string& payload, core::StateSpace space) {
  const FieldPath request;
  const FieldPath path = request.Field("member");
  std::shared_ptr<const core::RecordingStart> start;
  Violations violations;
  const absl::Status readable =
      ReadMemberContent(payload, [&](const RecordingStartFields* datum) {
        if (datum == nullptr) return;
        start = DecodeRecordingStart(*datum, space, TextCheck::kNone, path,
                                     &violations);
      });
  if (!readable.ok()) return readable;
  if (violations.count() > 0) return violations.ToStatus();
  return start;
}

// ---- Links

std::string EncodeLinkContent(const LinkContent& content) {
  stored::GroupLink link;
  link.set_content(EncodePairContent(content.content));
  EncodeTime(content.create_time_ns, link.mutable_create_time());
  return link.SerializeAsString();
}

std::string LinkContentCreatedAt(const std::string& payload,
                                 std::int64_t create_time_ns) {
  stored::GroupLink link;
  static_cast<void>(link.ParseFromString(payload));
  EncodeTime(create_time_ns, link.mutable_create_time());
  return link.SerializeAsString();
}

absl::Status ReadLinkContent(
    const std::string& payload,
    const std::function<void(const LinkContent&)>& read) {
  const auto link = ParseLink(payload);
  if (!link.ok()) return link.status();
  const auto create_time = CreateTimeOf(*link, "link of a group");
  if (!create_time.ok()) return create_time.status();
  return ReadPairContent(link->content(), [&](const PairContent& pair) {
    read({pair, *create_time});
  });
}

bool LinkContentsSayTheSame(const std::string& payload,
                            const std::string& other) {
  const auto link = ParseLink(payload);
  const auto other_link = ParseLink(other);
  return link.ok() && other_link.ok() &&
         PairContentsSayTheSame(link->content(), other_link->content());
}

absl::StatusOr<std::optional<core::LoopMeasurement>> DecodeLinkMeasurement(
    const std::string& payload, core::StateSpace space) {
  const auto link = ParseLink(payload);
  if (!link.ok()) return link.status();
  return DecodePairMeasurement(link->content(), space);
}

}  // namespace revisit::server
