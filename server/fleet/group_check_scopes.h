// Gets ready the scopes in which stored checks search in groups, and says what
// groups decide.
#ifndef REVISIT_SERVER_FLEET_GROUP_CHECK_SCOPES_H_
#define REVISIT_SERVER_FLEET_GROUP_CHECK_SCOPES_H_

#include "core/base/mutex.h"
#include "server/sessions/check_scopes.h"

namespace revisit::server {

class GroupSearches;

// All members of the group are searched, whoever may read them: what callers
// see of it is decided where they read it.
//
// Sessions need it before there can be searches in groups, which need the
// sessions, and until after these are gone. Thread-safe.
class GroupCheckScopes final : public CheckScopes {
 public:
  GroupCheckScopes() = default;
  // REQUIRES: nothing is used (UseNone()).
  ~GroupCheckScopes() override = default;

  // From now on these are asked; while none are, no scope is ready
  // (UNAVAILABLE). Once UseNone() has returned they are asked no more.
  void Use(GroupSearches* searches) ABSL_LOCKS_EXCLUDED(mutex_);
  void UseNone() { Use(nullptr); }

  void Prepare(const Request& request, Then then) override
      ABSL_LOCKS_EXCLUDED(mutex_);
  void ReadGroup(const Request& request, ThenGroup then) override
      ABSL_LOCKS_EXCLUDED(mutex_);

 private:
  Mutex mutex_;
  GroupSearches* searches_ ABSL_GUARDED_BY(mutex_) = nullptr;
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_FLEET_GROUP_CHECK_SCOPES_H_
