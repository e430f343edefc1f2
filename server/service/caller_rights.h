// Who the caller of one call is, and what they may do.
#ifndef REVISIT_SERVER_SERVICE_CALLER_RIGHTS_H_
#define REVISIT_SERVER_SERVICE_CALLER_RIGHTS_H_

#include <functional>
#include <memory>
#include <string>
#include <vector>

#include "absl/status/status.h"
#include "core/base/mutex.h"
#include "server/security/caller.h"
#include "server/security/gatekeeper.h"
#include "server/security/method_rules.h"

namespace revisit::server {

// Thread-safe, except Watch() and Unwatch(), which are called one after the
// other.
class CallerRights {
 public:
  // Has the gatekeeper say who the caller is. `rule` is that of the method, as
  // FindMethodRule() finds it. Gatekeeper, method and rule outlive this.
  CallerRights(Gatekeeper* gatekeeper, Credentials credentials,
               const char* method, const MethodRule* rule);

  CallerRights(const CallerRights&) = delete;
  CallerRights& operator=(const CallerRights&) = delete;

  // OK, or the gatekeeper's refusal of a caller who is not let in.
  const absl::Status& entry() const { return entry_; }
  // One who may do nothing, if the caller is not let in.
  const Caller& caller() const { return *caller_; }

  // Names the vehicle or group that the call is about. VEHICLE_NOT_FOUND or
  // GROUP_NOT_FOUND if the caller may not know of it, whether it exists or not;
  // PERMISSION_DENIED (NOT_GRANTED) if the caller may not use the method on it.
  absl::Status Choose(Resource resource, const std::string& id);
  // Checks a further verb on it, for a call that does more than its method
  // requires. After Choose().
  absl::Status AlsoNeeds(Verb verb);
  // Checks a verb on a vehicle or group beside it.
  absl::Status AlsoNeeds(Verb verb, const std::string& id,
                         Resource resource = Resource::kVehicle);

  // The caller as one with the same credentials would be now: one who may do
  // nothing, if they would not be let in.
  std::shared_ptr<const Caller> Now() const;
  // OK, or the refusal that a new call of the same kind with the same
  // credentials would get now. Long calls check it from time to time.
  absl::Status Recheck() const;
  // Calls `recheck` whenever the result of Recheck() may have changed, until
  // Unwatch(). The call may also come shortly after.
  void Watch(std::function<void()> recheck);
  void Unwatch();

 private:
  struct Need {
    Verb verb = Verb::kAdmin;
    Resource resource = Resource::kVehicle;
    std::string id;
  };

  Verb MethodVerb() const;
  absl::Status Check(const Caller& caller, const Need& need) const;
  absl::Status AddNeed(Need need) ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_);

  Gatekeeper* const gatekeeper_;
  const char* const method_;
  const MethodRule* const rule_;
  const Credentials credentials_;
  std::shared_ptr<const Caller> caller_;
  absl::Status entry_;
  Gatekeeper::WatchId watch_ = -1;

  mutable Mutex mutex_;
  // That of the method on what was chosen is the last one; none until then.
  std::vector<Need> needs_ ABSL_GUARDED_BY(mutex_);
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_SERVICE_CALLER_RIGHTS_H_
