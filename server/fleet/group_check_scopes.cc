#include "server/fleet/group_check_scopes.h"

#include <algorithm>
#include <memory>
#include <string>
#include <utility>

#include "absl/status/status.h"
#include "server/fleet/group_searches.h"

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
  for (const auto& history : group->joined->histories) {
    scope->vehicles.push_back({history->vehicle_id, history->config.uid});
  }
  scope->group = group;
  return scope;
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

}  // namespace revisit::server
