#include "server/groups/group_edits.h"

#include <algorithm>
#include <array>
#include <optional>
#include <set>
#include <string>
#include <utility>

#include "absl/strings/str_cat.h"
#include "core/geometry/state_space.h"
#include "server/base/status.h"
#include "server/fields/field_violations.h"
#include "server/groups/group_reads.h"
#include "server/groups/link_kind.h"
#include "server/groups/stored_vehicle.h"
#include "server/records/group_content.h"
#include "server/storage/record_check.h"

namespace revisit::server {
namespace {

absl::Status LimitReached(const std::string& group_id, std::size_t limit,
                          const char* what) {
  return Error(
      absl::StatusCode::kFailedPrecondition, "GROUP_LIMIT",
      absl::StrCat("group '", group_id, "' has ", limit, " ", what,
                   ", which are as many as are allowed: remove some first"),
      {{"limit", absl::StrCat(limit)}});
}

// What there is of a group's links, beside one that is looked for.
struct LinksSeen {
  std::optional<GroupLinkRecord> same_id;
  // One of the same two poses, whichever of them asked, of the other kind.
  std::optional<GroupLinkRecord> conflict;
  std::size_t count = 0;
  // The last time of creation; damaged links have none.
  std::int64_t last_time_ns = 0;
};

bool AreOfOnePair(const GroupLinkRecord& a, const GroupLinkRecord& b) {
  return (a.query == b.query && a.matched == b.matched) ||
         (a.query == b.matched && a.matched == b.query);
}

absl::StatusOr<LinksSeen> LookAtLinks(GroupStorage* groups,
                                      const std::string& group_id,
                                      const GroupLinkRecord& wanted) {
  LinksSeen seen;
  const absl::Status status =
      VisitLinks(groups, group_id, [&](GroupLinkRecord& link) {
        ++seen.count;
        if (link.damage.ok()) {
          static_cast<void>(
              ReadLinkContent(link.payload, [&](const LinkContent& content) {
                seen.last_time_ns =
                    std::max(seen.last_time_ns, content.create_time_ns);
              }));
        }
        const bool is_other_kind = KindOf(link) != KindOf(wanted);
        if (link.id == wanted.id) {
          seen.same_id = std::move(link);
        } else if (link.damage.ok() && is_other_kind &&
                   AreOfOnePair(link, wanted)) {
          seen.conflict = std::move(link);
        }
        return true;
      });
  if (!status.ok()) return status;
  return seen;
}

absl::Status CheckMembers(GroupStorage* groups, const std::string& group_id,
                          const NewLink& link) {
  const std::array<std::string, 2> ends = {link.query.vehicle_id,
                                           link.matched.vehicle_id};
  std::set<std::string> missing(ends.begin(), ends.end());
  const absl::Status status =
      VisitMembers(groups, group_id, [&](const GroupMemberRecord& member) {
        missing.erase(member.vehicle_id);
        return !missing.empty();
      });
  if (!status.ok()) return status;
  for (const std::string& vehicle : ends) {
    if (missing.count(vehicle) > 0) return VehicleIsNoMember(group_id, vehicle);
  }
  return absl::OkStatus();
}

// The two ends of a link.
struct LinkedVehicles {
  StoredVehicle query;
  StoredVehicle matched;
};

absl::StatusOr<LinkedVehicles> FindEnds(Storage* storage,
                                        const RecordCodec& codec,
                                        const NewLink& link) {
  absl::StatusOr<StoredVehicle> query =
      FindStoredVehicle(storage, codec, link.query.vehicle_id);
  if (!query.ok()) return query.status();
  absl::StatusOr<StoredVehicle> matched =
      FindStoredVehicle(storage, codec, link.matched.vehicle_id);
  if (!matched.ok()) return matched.status();
  return LinkedVehicles{*std::move(query), *std::move(matched)};
}

// The two kinds cannot both be of the same two poses.
absl::Status Conflict(const GroupRecord& group, const GroupLinkRecord& link) {
  const PairKind kind = KindOf(link);
  const PairKind wanted = kind == PairKind::kLoopClosure
                              ? PairKind::kRejectedCandidate
                              : PairKind::kLoopClosure;
  return Error(
      absl::StatusCode::kFailedPrecondition, "POSE_PAIR_CONFLICT",
      absl::StrCat("the two poses are the ", WordsOf(kind).noun, " '",
                   LinkIdOf(link), "' of group '", group.id,
                   "' and cannot be a ", WordsOf(wanted).noun,
                   " too; delete that first if it was a mistake"),
      {{"name", absl::StrCat("groups/", group.id, "/", WordsOf(kind).collection,
                             "/", LinkIdOf(link))}});
}

absl::Status CheckStateSpaces(const LinkedVehicles& ends, const NewLink& link) {
  const core::StateSpace space = ends.query.config.drive.state_space;
  if (space == ends.matched.config.drive.state_space) {
    return DecodeLinkMeasurement(link.payload, space).status();
  }
  const FieldPath request;
  const FieldPath pair = request.Field(WordsOf(link.kind).field);
  const FieldPath matched = pair.Field("matched");
  return InvalidField(kInvalidField, matched.Field("vehicle"),
                      "its state space is another one than that of the query's "
                      "vehicle; a link is between vehicles of one");
}

bool SayTheSame(const GroupLinkRecord& link, const GroupLinkRecord& other) {
  return link.query == other.query && link.matched == other.matched &&
         LinkContentsSayTheSame(link.payload, other.payload);
}

// No changes, where the link that is there says what was asked for.
absl::StatusOr<GroupEdit> EditToKeep(const GroupRecord& group,
                                     GroupLinkRecord there,
                                     GroupLinkRecord* link) {
  if (!there.damage.ok()) return there.damage;
  if (!SayTheSame(there, *link)) {
    const PairWords words = WordsOf(KindOf(*link));
    return Error(
        absl::StatusCode::kAlreadyExists, words.exists,
        absl::StrCat(words.noun, " '", LinkIdOf(*link), "' of group '",
                     group.id, "' exists with other poses, or another ",
                     words.content));
  }
  *link = std::move(there);
  return GroupEdit();
}

}  // namespace

absl::StatusOr<GroupEdit> EditToAddMember(GroupStorage* groups,
                                          const GroupRecord& group,
                                          const GroupMemberRecord& member,
                                          const GroupLimits& limits) {
  if (!group.damage.ok()) return group.damage;
  std::size_t count = 0;
  std::optional<GroupMemberRecord> there;
  const absl::Status status =
      VisitMembers(groups, group.id, [&](GroupMemberRecord& other) {
        ++count;
        if (other.vehicle == member.vehicle) there = std::move(other);
        return true;
      });
  if (!status.ok()) return status;
  if (there) {
    if (!there->damage.ok()) return there->damage;
    if (there->payload == member.payload) return GroupEdit();
    return Error(absl::StatusCode::kAlreadyExists, "MEMBER_EXISTS",
                 absl::StrCat("vehicle '", member.vehicle_id,
                              "' is a member of group '", group.id,
                              "' with another datum; change it with "
                              "UpdateGroupMember"));
  }
  if (count >= limits.members) {
    return LimitReached(group.id, limits.members, "members");
  }
  return GroupEdit{{AddGroupMember{member}}};
}

absl::StatusOr<GroupEdit> EditToAddLink(
    Storage* storage, const RecordCodec& codec, const GroupRecord& group,
    const NewLink& wanted, std::int64_t now_ns, const GroupLimits& limits,
    GroupLinkRecord* link) {
  if (!group.damage.ok()) return group.damage;
  const absl::StatusOr<LinkedVehicles> ends = FindEnds(storage, codec, wanted);
  if (!ends.ok()) return ends.status();
  absl::Status status = CheckStateSpaces(*ends, wanted);
  if (!status.ok()) return status;
  status = CheckMembers(&storage->Groups(), group.id, wanted);
  if (!status.ok()) return status;
  const bool is_rejected = wanted.kind == PairKind::kRejectedCandidate;
  *link = {LinkRowId(wanted.kind, wanted.id),
           is_rejected ? LinkState::kRejected : LinkState::kConfirmed,
           {ends->query.key, wanted.query.sequence},
           {ends->matched.key, wanted.matched.sequence},
           wanted.payload};
  absl::StatusOr<LinksSeen> seen =
      LookAtLinks(&storage->Groups(), group.id, *link);
  if (!seen.ok()) return seen.status();
  if (seen->same_id) return EditToKeep(group, *std::move(seen->same_id), link);
  if (seen->conflict) return Conflict(group, *seen->conflict);
  if (seen->count >= limits.links) {
    return LimitReached(group.id, limits.links,
                        "loop closures and rejected candidates");
  }
  status =
      CheckPoseIsStored(storage, codec, ends->query, wanted.query.sequence);
  if (!status.ok()) return status;
  status =
      CheckPoseIsStored(storage, codec, ends->matched, wanted.matched.sequence);
  if (!status.ok()) return status;
  link->payload = LinkContentCreatedAt(
      wanted.payload, std::max(now_ns, seen->last_time_ns + 1));
  return GroupEdit{{AddGroupLink{*link}}};
}

GroupEdit EditToRemoveLink(PairKind kind, const std::string& id) {
  return GroupEdit{{RemoveGroupLink{LinkRowId(kind, id)}}, true};
}

absl::Status RemovalError(PairKind kind, const std::string& id,
                          const absl::Status& error) {
  return ReasonOf(error) == WordsOf(PairKind::kLoopClosure).not_found
             ? NoSuchPair(kind, id)
             : error;
}

}  // namespace revisit::server
