#include "tests/server/memory_groups.h"

#include <algorithm>
#include <tuple>

#include "server/base/status.h"

namespace revisit::server {
namespace {

using absl::StatusCode;

absl::Status NotFound(const std::string& reason) {
  return Error(StatusCode::kNotFound, reason, "not there");
}

absl::Status Exists(const std::string& reason) {
  return Error(StatusCode::kAlreadyExists, reason, "exists already");
}

bool Touches(const GroupLinkRecord& link, VehicleKey vehicle) {
  return link.query.vehicle == vehicle || link.matched.vehicle == vehicle;
}

}  // namespace

bool MemoryGroups::RemoveLinks(
    Group* group, const std::function<bool(const GroupLinkRecord&)>& goes) {
  const std::size_t before = group->links.size();
  for (auto i = group->links.begin(); i != group->links.end();) {
    i = goes(i->second) ? group->links.erase(i) : std::next(i);
  }
  return group->links.size() < before;
}

void MemoryGroups::Leave(VehicleKey vehicle) {
  for (auto& [id, group] : groups_) {
    const GroupMemberRecord* const member = MemberOf(&group, vehicle);
    if (member == nullptr) continue;
    RemoveLinks(&group, [&](const GroupLinkRecord& link) {
      return Touches(link, vehicle);
    });
    group.members.erase(std::string(member->vehicle_id));
    ++group.record.version.revision;
  }
}

void MemoryGroups::Cut(VehicleKey vehicle, std::uint64_t last_sequence) {
  for (auto& [id, group] : groups_) {
    const auto is_lost = [&](const VehiclePose& end) {
      return end.vehicle == vehicle && end.sequence > last_sequence;
    };
    if (RemoveLinks(&group, [&](const GroupLinkRecord& link) {
          return is_lost(link.query) || is_lost(link.matched);
        })) {
      ++group.record.version.revision;
    }
  }
}

GroupMemberRecord* MemoryGroups::MemberOf(Group* group, VehicleKey vehicle) {
  for (auto& [id, member] : group->members) {
    if (member.vehicle == vehicle) return &member;
  }
  return nullptr;
}

absl::StatusOr<MemoryGroups::Group*> MemoryGroups::Find(
    const std::string& id, const std::optional<GroupVersion>& expected) {
  const auto found = groups_.find(id);
  if (found == groups_.end()) return NotFound("GROUP_NOT_FOUND");
  const GroupVersion& version = found->second.record.version;
  if (expected && *expected != version) {
    return Error(StatusCode::kAborted, "REVISION_MISMATCH", "another version",
                 {{"revision", std::to_string(version.revision)}});
  }
  return &found->second;
}

absl::Status MemoryGroups::Apply(const GroupChange& change,
                                 Group* group) const {
  if (const auto* set = std::get_if<SetGroupPayload>(&change)) {
    group->record.payload = set->payload;
  } else if (const auto* add = std::get_if<AddGroupMember>(&change)) {
    GroupMemberRecord member = add->member;
    const auto id = id_of_(member.vehicle);
    if (!id) return NotFound("VEHICLE_NOT_FOUND");
    member.vehicle_id = *id;
    if (!group->members.emplace(*id, member).second) {
      return Exists("MEMBER_EXISTS");
    }
  } else if (const auto* member = std::get_if<SetGroupMember>(&change)) {
    GroupMemberRecord* const stored = MemberOf(group, member->member.vehicle);
    if (stored == nullptr) return NotFound("MEMBER_NOT_FOUND");
    stored->payload = member->member.payload;
  } else if (const auto* leaves = std::get_if<RemoveGroupMember>(&change)) {
    const GroupMemberRecord* const stored = MemberOf(group, leaves->vehicle);
    if (stored == nullptr) return NotFound("MEMBER_NOT_FOUND");
    group->members.erase(std::string(stored->vehicle_id));
    RemoveLinks(group, [&](const GroupLinkRecord& link) {
      return Touches(link, leaves->vehicle);
    });
  } else if (const auto* link = std::get_if<AddGroupLink>(&change)) {
    for (const VehiclePose& end : {link->link.query, link->link.matched}) {
      if (MemberOf(group, end.vehicle) == nullptr) {
        return NotFound("MEMBER_NOT_FOUND");
      }
    }
    if (!group->links.emplace(link->link.id, link->link).second) {
      return Exists("LOOP_CLOSURE_EXISTS");
    }
  } else if (const auto* state = std::get_if<SetGroupLink>(&change)) {
    const auto found = group->links.find(state->id);
    if (found == group->links.end()) return NotFound("LOOP_CLOSURE_NOT_FOUND");
    found->second.state = state->state;
    found->second.payload = state->payload;
  } else if (group->links.erase(std::get<RemoveGroupLink>(change).id) == 0) {
    return NotFound("LOOP_CLOSURE_NOT_FOUND");
  }
  return absl::OkStatus();
}

void MemoryGroups::CreateGroup(GroupRecord group, Done done) {
  absl::StatusOr<std::uint64_t> result = Exists("GROUP_EXISTS");
  group.version.revision = 1;
  {
    const std::lock_guard<std::mutex> guard(mutex_);
    const std::string id = group.id;
    if (groups_.emplace(id, Group{std::move(group), {}, {}}).second) result = 1;
  }
  done(std::move(result));
}

void MemoryGroups::ChangeGroup(std::string id,
                               std::optional<GroupVersion> expected,
                               std::vector<GroupChange> changes, Done done) {
  const auto change = [&]() -> absl::StatusOr<std::uint64_t> {
    const std::lock_guard<std::mutex> guard(mutex_);
    const absl::StatusOr<Group*> group = Find(id, expected);
    if (!group.ok()) return group.status();
    Group changed = **group;
    for (const GroupChange& one : changes) {
      absl::Status status = Apply(one, &changed);
      if (!status.ok()) return status;
    }
    ++changed.record.version.revision;
    **group = std::move(changed);
    return (*group)->record.version.revision;
  };
  done(change());
}

void MemoryGroups::DeleteGroup(std::string id,
                               std::optional<GroupVersion> expected,
                               Done done) {
  const auto remove = [&]() -> absl::StatusOr<std::uint64_t> {
    const std::lock_guard<std::mutex> guard(mutex_);
    const absl::StatusOr<Group*> group = Find(id, expected);
    if (!group.ok()) return group.status();
    const std::uint64_t revision = (*group)->record.version.revision + 1;
    groups_.erase(id);
    return revision;
  };
  done(remove());
}

absl::StatusOr<GroupRecord> MemoryGroups::GetGroup(const std::string& id) {
  const std::lock_guard<std::mutex> guard(mutex_);
  const absl::StatusOr<Group*> group = Find(id, std::nullopt);
  if (!group.ok()) return group.status();
  return (*group)->record;
}

absl::StatusOr<std::vector<GroupRecord>> MemoryGroups::ListGroups(
    const std::string& after_id, const std::string& prefix, int limit) {
  const std::lock_guard<std::mutex> guard(mutex_);
  std::vector<GroupRecord> groups;
  for (auto i = groups_.upper_bound(after_id);
       i != groups_.end() && static_cast<int>(groups.size()) < limit; ++i) {
    if (i->first.compare(0, prefix.size(), prefix) == 0) {
      groups.push_back(i->second.record);
    }
  }
  return groups;
}

absl::StatusOr<std::vector<GroupRecord>> MemoryGroups::ListGroupVersions(
    const std::optional<std::vector<std::string>>& ids) {
  const std::lock_guard<std::mutex> guard(mutex_);
  std::vector<GroupRecord> groups;
  for (const auto& [id, group] : groups_) {
    if (ids && std::count(ids->begin(), ids->end(), id) == 0) continue;
    GroupRecord& record = groups.emplace_back();
    record.id = id;
    record.version = group.record.version;
  }
  return groups;
}

absl::StatusOr<std::vector<GroupMemberRecord>> MemoryGroups::ListMembers(
    const std::string& group_id, const std::string& after_vehicle_id,
    int limit) {
  const std::lock_guard<std::mutex> guard(mutex_);
  const absl::StatusOr<Group*> group = Find(group_id, std::nullopt);
  if (!group.ok()) return group.status();
  std::vector<GroupMemberRecord> members;
  const auto& all = (*group)->members;
  for (auto i = all.upper_bound(after_vehicle_id);
       i != all.end() && static_cast<int>(members.size()) < limit; ++i) {
    members.push_back(i->second);
  }
  return members;
}

absl::StatusOr<std::vector<std::string>> MemoryGroups::ListGroupsOf(
    VehicleKey vehicle) {
  const std::lock_guard<std::mutex> guard(mutex_);
  if (!id_of_(vehicle)) return NotFound("VEHICLE_NOT_FOUND");
  std::vector<std::string> ids;
  for (auto& [id, group] : groups_) {
    if (MemberOf(&group, vehicle) != nullptr) ids.push_back(id);
  }
  return ids;
}

absl::StatusOr<std::vector<GroupLinkRecord>> MemoryGroups::ListLinks(
    const std::string& group_id, const std::string& after_id, int limit) {
  const std::lock_guard<std::mutex> guard(mutex_);
  const absl::StatusOr<Group*> group = Find(group_id, std::nullopt);
  if (!group.ok()) return group.status();
  std::vector<GroupLinkRecord> links;
  const auto& all = (*group)->links;
  for (auto i = all.upper_bound(after_id);
       i != all.end() && static_cast<int>(links.size()) < limit; ++i) {
    links.push_back(i->second);
  }
  return links;
}

absl::StatusOr<std::vector<PlacedLink>> MemoryGroups::ListLinksOf(
    VehicleKey vehicle, const LinkPlace& after, int limit) {
  const std::lock_guard<std::mutex> guard(mutex_);
  if (!id_of_(vehicle)) return NotFound("VEHICLE_NOT_FOUND");
  std::vector<PlacedLink> links;
  for (const auto& [group_id, group] : groups_) {
    for (const auto& [id, link] : group.links) {
      if (static_cast<int>(links.size()) < limit && Touches(link, vehicle) &&
          std::tie(group_id, id) > std::tie(after.group, after.id)) {
        links.push_back({group_id, link});
      }
    }
  }
  return links;
}

}  // namespace revisit::server
