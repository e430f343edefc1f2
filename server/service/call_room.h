// The room that one call takes, beside others, until it ends.
#ifndef REVISIT_SERVER_SERVICE_CALL_ROOM_H_
#define REVISIT_SERVER_SERVICE_CALL_ROOM_H_

#include <cstddef>
#include <cstdint>
#include <string>
#include <vector>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "core/base/mutex.h"
#include "server/connections/admission.h"
#include "server/security/method_rules.h"

namespace revisit::server {

// Room that Take...() takes is held until GiveBack(); what Admit...() returns,
// by whoever has the permit. Refusals are those of Admission. Thread-safe.
class CallRoom {
 public:
  // `rule` is that of the method, as FindMethodRule() finds it. Both outlive
  // this.
  CallRoom(Admission* admission, const MethodRule* rule)
      : admission_(admission), rule_(rule) {}

  CallRoom(const CallRoom&) = delete;
  CallRoom& operator=(const CallRoom&) = delete;

  // Takes room for the call itself, under the limits of `quota_key`. Calls that
  // need nothing of the store take none: an operator wants to know about a
  // server that is full.
  absl::Status Enter(const std::string& quota_key);
  // Takes room for the call at the vehicle that it is about.
  absl::Status ChooseVehicle(const std::string& id);
  // The same at the group that it is about.
  absl::Status ChooseGroup(const std::string& id);

  // The others come after ChooseVehicle().

  // To make the vehicle's graph anew, which has so many poses.
  absl::Status TakeRebuild(std::uint64_t poses);
  // For a batch that waits to be durable.
  absl::Status TakeBatch(std::size_t bytes);

  // For a batch that waits to be durable.
  absl::StatusOr<Permit> AdmitBatch(std::size_t bytes) const;
  // For some more of a revision.
  absl::StatusOr<Permit> AdmitDraft(std::int64_t bytes) const;
  // For a graph that is exported.
  absl::StatusOr<Permit> AdmitExport(std::size_t bytes) const;

  // Gives back all that was taken. From here on nothing is held: what is taken
  // is given back at once, with CANCELLED.
  void GiveBack();

 private:
  absl::Status Hold(absl::StatusOr<Permit> permit)
      ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_);
  std::string vehicle() const;

  Admission* const admission_;
  const MethodRule* const rule_;

  mutable Mutex mutex_;
  // The key of the caller's limits; empty until the call enters.
  std::string quota_key_ ABSL_GUARDED_BY(mutex_);
  std::string vehicle_ ABSL_GUARDED_BY(mutex_);
  std::vector<Permit> permits_ ABSL_GUARDED_BY(mutex_);
  bool given_back_ ABSL_GUARDED_BY(mutex_) = false;
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_SERVICE_CALL_ROOM_H_
