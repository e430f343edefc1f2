#include "server/fleet/group_check_scopes.h"

#include <algorithm>
#include <map>
#include <memory>
#include <optional>
#include <string>
#include <utility>

#include "absl/status/status.h"
#include "server/fleet/group_searches.h"
#include "server/groups/link_kind.h"
#include "server/records/group_content.h"

namespace revisit::server {
namespace {

// Whether the vehicle is a member as far as the store tells: one that was
// deleted and made again is none, and a damaged row makes none.
bool IsMember(const StoredGroup& group, const CheckScopes::Request& vehicle) {
  return std::any_of(group.members.begin(), group.members.end(),
                     [&](const GroupMemberRecord& member) {
                       return member.damage.ok() &&
                              member.vehicle == vehicle.key;
                     });
}

CheckTiesPtr TiesOf(const StoredGroup& group, VehicleKey vehicle) {
  auto ties = std::make_shared<CheckTies>();
  ties->version = group.version;
  for (const GroupMemberRecord& member : group.members) {
    if (member.vehicle == vehicle) ties->member = member.payload;
  }
  const auto add = [&](const GroupLinkRecord& link) {
    if (link.query.vehicle == vehicle) {
      ties->ties.push_back({link.query.sequence, link});
    } else if (link.matched.vehicle == vehicle) {
      ties->ties.push_back({link.matched.sequence, link});
    }
  };
  for (const StoredLink& stored : group.links) add(stored.record);
  for (const GroupLinkRecord& rejected : group.rejected) add(rejected);
  return ties;
}

absl::StatusOr<CheckScopePtr> ScopeOf(const CheckScopes::Request& request,
                                      absl::StatusOr<GroupScope> ready) {
  // Nothing that waiting would change.
  if (absl::IsNotFound(ready.status()) || absl::IsDataLoss(ready.status())) {
    return CheckScopePtr();
  }
  if (!ready.ok()) return ready.status();
  if (!ready->scope.asking) {
    if (!IsMember(*ready->joined->group, request)) return CheckScopePtr();
    // Its history, which was not in memory a moment ago, is not joined yet.
    return absl::UnavailableError("the vehicle's own history is not joined");
  }
  const auto group = std::make_shared<const GroupScope>(*std::move(ready));
  auto scope = std::make_shared<CheckScope>();
  scope->search = group->scope;
  scope->group_id = request.group;
  scope->ties = TiesOf(*group->joined->group, request.key);
  for (const auto& history : group->joined->histories) {
    scope->vehicles.push_back(
        {history->vehicle_id, history->config.uid, history->last_sequence});
  }
  scope->group = group;
  return scope;
}

// Nothing where it does not link the vehicle, or its content is damaged.
std::optional<CheckGroup::Link> LinkOf(
    const CheckScopes::Request& request, const GroupLinkRecord& record,
    const std::map<VehicleKey, std::string>& uids) {
  const bool asks = record.query.vehicle == request.key;
  if (!asks && record.matched.vehicle != request.key) return std::nullopt;
  const VehiclePose& own = asks ? record.query : record.matched;
  const VehiclePose& other = asks ? record.matched : record.query;
  const auto uid = uids.find(other.vehicle);
  if (uid == uids.end()) return std::nullopt;
  CheckGroup::Link link{KindOf(record), LinkIdOf(record), own.sequence,
                        uid->second,    other.sequence,   ""};
  const absl::Status read =
      ReadLinkContent(record.payload, [&](const LinkContent& content) {
        link.decided_by = std::string(content.content.decided_by);
      });
  if (!read.ok()) return std::nullopt;
  return link;
}

absl::StatusOr<CheckGroupPtr> GroupOf(
    const CheckScopes::Request& request,
    const absl::StatusOr<GroupSearches::NamedGroup>& named) {
  auto group = std::make_shared<CheckGroup>();
  if (absl::IsNotFound(named.status())) return group;
  if (!named.ok()) return named.status();
  group->version = named->group->version;
  group->ties = TiesOf(*named->group, request.key);
  for (const GroupMemberRecord& member : named->group->members) {
    const auto uid = named->uids.find(member.vehicle);
    group->members[member.vehicle_id] =
        uid == named->uids.end() ? std::string() : uid->second;
  }
  for (const StoredLink& stored : named->group->links) {
    auto link = LinkOf(request, stored.record, named->uids);
    if (link) group->links.push_back(*std::move(link));
  }
  for (const GroupLinkRecord& rejected : named->group->rejected) {
    auto link = LinkOf(request, rejected, named->uids);
    if (link) group->links.push_back(*std::move(link));
  }
  return group;
}

}  // namespace

void GroupCheckScopes::Use(GroupSearches* searches) {
  const MutexLock lock(&mutex_);
  searches_ = searches;
}

void GroupCheckScopes::Prepare(const Request& request, Then then) {
  {
    const MutexLock lock(&mutex_);
    if (searches_ != nullptr) {
      ScopeRequest scope;
      scope.group = request.group;
      scope.asking = request.vehicle;
      scope.may_read = [](const std::string&) { return true; };
      // It calls back from another thread, so that the lock may be held.
      searches_->Prepare(
          std::move(scope),
          [request, then = std::move(then)](absl::StatusOr<GroupScope> ready) {
            then(ScopeOf(request, std::move(ready)));
          });
      return;
    }
  }
  then(absl::UnavailableError("no searches in groups are made"));
}

void GroupCheckScopes::ReadGroup(const Request& request, ThenGroup then) {
  {
    const MutexLock lock(&mutex_);
    if (searches_ != nullptr) {
      searches_->ReadGroup(
          request.group,
          [request, then = std::move(then)](
              const absl::StatusOr<GroupSearches::NamedGroup>& named) {
            then(GroupOf(request, named));
          });
      return;
    }
  }
  then(absl::UnavailableError("no searches in groups are made"));
}

}  // namespace revisit::server
