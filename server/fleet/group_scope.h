// Where a search in a group looks.
#ifndef REVISIT_SERVER_FLEET_GROUP_SCOPE_H_
#define REVISIT_SERVER_FLEET_GROUP_SCOPE_H_

#include <chrono>
#include <functional>
#include <memory>
#include <string>
#include <vector>

#include "core/search/search_scope.h"
#include "server/fleet/joined_group.h"
#include "server/fleet/known_history.h"

namespace revisit::server {

// As SearchScope of the API, with ids for names.
struct ScopeRequest {
  std::string group;
  // The vehicle that is asked about.
  std::string asking;
  std::vector<std::string> vehicles;
  bool exclude_own = false;
  bool allow_partial = false;
  // Whether nothing can be said without the asking vehicle, which then must be
  // a member. Else it may be none, or have a history that is not known: then
  // its frame is tied to none.
  bool needs_asking = false;
  // Members that the caller may not read are no part of the search. May be
  // called on any thread.
  std::function<bool(const std::string& vehicle_id)> may_read;
};

struct AbsentMember {
  std::string vehicle_id;
  Absence absence = Absence::kNotReady;
};

struct GroupScope {
  core::SearchScope scope;
  std::shared_ptr<const JoinedGroup> joined;
  // By drive: when all that was stored then was in it.
  std::vector<std::chrono::steady_clock::time_point> as_of;
  // Those that were to be searched, by id.
  std::vector<AbsentMember> absent;
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_FLEET_GROUP_SCOPE_H_
