// Where stored checks search beside the vehicle's own history
// (VehicleConfig::check_group): what sessions know of it, and whom they ask.
#ifndef REVISIT_SERVER_SESSIONS_CHECK_SCOPES_H_
#define REVISIT_SERVER_SESSIONS_CHECK_SCOPES_H_

#include <functional>
#include <memory>
#include <string>
#include <vector>

#include "absl/status/statusor.h"
#include "core/search/search_scope.h"
#include "server/storage/records.h"

namespace revisit::server {

// Who makes a scope and who encodes what was found in it know the rest.
struct GroupScope;

// Never changes, so that any number of threads may read it.
struct CheckScope {
  struct Vehicle {
    std::string id;
    std::string uid;
  };
  core::SearchScope search;
  // By their index among the scope's drives.
  std::vector<Vehicle> vehicles;
  // For CheckCodec::EncodeFound().
  std::shared_ptr<const GroupScope> group = nullptr;
};
using CheckScopePtr = std::shared_ptr<const CheckScope>;

// Thread-safe.
class CheckScopes {
 public:
  struct Request {
    // Ids.
    std::string group;
    std::string vehicle;
    VehicleKey key = 0;
  };
  // Null where the vehicle is no member of the group, and where the group is
  // not there or damaged: its own history is all there is to search then.
  // Errors are such that one may ask again, later: UNAVAILABLE
  // (GROUP_NOT_READY) while histories are read from the store; those of the
  // storage.
  using Then = std::function<void(absl::StatusOr<CheckScopePtr>)>;

  virtual ~CheckScopes() = default;
  // Calls `then` once, on any thread. Does not wait. REQUIRES: the vehicle's
  // session is loaded, and held until then.
  virtual void Prepare(const Request& request, Then then) = 0;
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_SESSIONS_CHECK_SCOPES_H_
