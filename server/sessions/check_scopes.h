// Where stored checks search beside the vehicle's own history
// (VehicleConfig::check_group), and what is decided there: what sessions know
// of groups, and whom they ask.
#ifndef REVISIT_SERVER_SESSIONS_CHECK_SCOPES_H_
#define REVISIT_SERVER_SESSIONS_CHECK_SCOPES_H_

#include <cstdint>
#include <functional>
#include <map>
#include <memory>
#include <optional>
#include <string>
#include <vector>

#include "absl/status/statusor.h"
#include "core/search/search_scope.h"
#include "server/storage/group_records.h"
#include "server/storage/records.h"

namespace revisit::server {

// Who makes a scope and who encodes what was found in it know the rest.
struct GroupScope;

// The part of a group on which the answers of a vehicle's checks depend by the
// vehicle's own doing. Never changes.
struct CheckTies {
  // A loop closure between the vehicle and another one, or a rejected
  // candidate.
  struct Tie {
    std::uint64_t own_sequence = 0;
    GroupLinkRecord link;
  };
  // Nothing where there is no such group.
  std::optional<GroupVersion> version;
  // The vehicle's row as a member; empty where it is none.
  std::string member;
  std::vector<Tie> ties;
};
using CheckTiesPtr = std::shared_ptr<const CheckTies>;

// Never changes, so that any number of threads may read it.
struct CheckScope {
  struct Vehicle {
    std::string id;
    std::string uid;
    // The highest sequence in the scope.
    std::uint64_t last_sequence = 0;
  };
  core::SearchScope search;
  // By their index among the scope's drives.
  std::vector<Vehicle> vehicles;
  std::string group_id;
  // The ties in the group that is searched; never null.
  CheckTiesPtr ties = std::make_shared<const CheckTies>();
  // For CheckCodec::EncodeFound().
  std::shared_ptr<const GroupScope> group = nullptr;
};
using CheckScopePtr = std::shared_ptr<const CheckScope>;

// A group as far as it decides on a vehicle's places in the histories of
// others. Never changes.
struct CheckGroup {
  // A loop closure between the vehicle and another one, or a rejected
  // candidate.
  struct Link {
    PairKind kind = PairKind::kLoopClosure;
    std::string id;
    std::uint64_t own_sequence = 0;
    std::string other_uid;
    std::uint64_t other_sequence = 0;
    // Caller::identity; empty where nobody was asked who calls.
    std::string decided_by;
  };
  // Nothing where there is no such group.
  std::optional<GroupVersion> version;
  // The uids of the members by their ids; empty where a vehicle is damaged.
  std::map<std::string, std::string> members;
  // The loop closures in the order in which they were added, then the rejected
  // candidates.
  std::vector<Link> links;
  // Never null.
  CheckTiesPtr ties = std::make_shared<const CheckTies>();
};
using CheckGroupPtr = std::shared_ptr<const CheckGroup>;

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

  // Calls `then` once, on any thread, with the group as it is stored, at most
  // some seconds old. Does not wait. Errors are those of the storage.
  using ThenGroup = std::function<void(absl::StatusOr<CheckGroupPtr>)>;
  virtual void ReadGroup(const Request& request, ThenGroup then) = 0;
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_SESSIONS_CHECK_SCOPES_H_
