// One call of the service: who its caller is and what they may do, whether the
// caller still waits, and what the logs and counts say of it.
#ifndef REVISIT_SERVER_SERVICE_CALL_H_
#define REVISIT_SERVER_SERVICE_CALL_H_

#include <atomic>
#include <chrono>
#include <cstddef>
#include <cstdint>
#include <functional>
#include <memory>
#include <optional>
#include <string>
#include <vector>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "core/base/mutex.h"
#include "grpcpp/server_context.h"
#include "grpcpp/support/status.h"
#include "server/base/logging.h"
#include "server/connections/admission.h"
#include "server/connections/connection_meter.h"
#include "server/connections/drain.h"
#include "server/security/caller.h"
#include "server/security/gatekeeper.h"
#include "server/service/service_context.h"
#include "server/telemetry/service_counters.h"
#include "server/telemetry/trace_context.h"

namespace revisit::server {

struct MethodRule;

// Thread-safe, except ChooseVehicle(), AlsoNeeds(), NameChanged() and, for
// unary calls, Searched().
class Call {
 public:
  // Takes the request id from the metadata or makes one, and sends it back.
  // What the service refers to must outlive this.
  Call(grpc::CallbackServerContext* context, const char* method,
       const ServiceContext& service);

  Call(const Call&) = delete;
  Call& operator=(const Call&) = delete;

  // If not OK, end the call with this status at once: it came too late, its
  // caller is not let in, or there is no room for it.
  const absl::Status& admission() const { return admission_; }

  // Whether it is about what is stored, rather than about the server itself.
  bool needs_store() const;

  // The caller. REQUIRES: the call was admitted.
  const Caller& caller() const { return *caller_; }

  // Names the vehicle that the call is about. Every handler goes through here
  // before it does anything with a vehicle, and before the work is handed to
  // other threads. VEHICLE_NOT_FOUND if the caller may not know of the vehicle,
  // whether it exists or not; PERMISSION_DENIED (NOT_GRANTED) if the caller may
  // not use this method on it; STREAM_QUOTA or QUEUE_FULL if the vehicle has as
  // many streams, or as many unary calls, as it may have.
  absl::Status ChooseVehicle(const std::string& id);

  // Checks a further verb, for a call that does more than its method requires.
  // After ChooseVehicle().
  absl::Status AlsoNeeds(Verb verb);

  // Takes room until End() to make the vehicle's graph anew, which has so many
  // poses. After ChooseVehicle(); while nothing else can end the call.
  absl::Status AdmitRebuild(std::uint64_t poses);
  // Takes room for a search until End(), or until the call is given up. After
  // ChooseVehicle().
  absl::Status AdmitSearch();
  // OK while the tenant has not used up its budget of steps; SEARCH_QUOTA.
  absl::Status CheckSearchSteps() const;
  // The refusal of a search that has more to search first than one may.
  absl::Status TooManySteps() const;
  // Notes how long a turn of the search took, without its waits, and how many
  // steps it was to make.
  void SearchTook(std::chrono::steady_clock::duration duration,
                  std::int64_t steps) const;
  // Whose its searches are, and its stream's checks, among those who share the
  // threads of searches.
  std::string search_flow() const { return "calls/" + quota_key_; }
  std::string check_flow() const { return "checks/" + quota_key_; }
  // Counts a search, admitted or of a stream's check, and logs it if it was
  // slow: that of a stream at once, another with its call.
  void Searched(const absl::StatusOr<core::CandidateSet>& set,
                std::chrono::steady_clock::duration duration);
  // Names the finding that the call is about, beside its vehicle, for the log
  // of changes.
  void NameChanged(const std::string& id);
  // Takes room for a batch that waits to be durable. After ChooseVehicle(); on
  // any thread.
  absl::StatusOr<Permit> AdmitBatch(std::size_t bytes) const;
  // Takes room for a batch until End().
  absl::Status HoldBatch(std::size_t bytes);
  // Takes room for some more of a revision. After ChooseVehicle(); on any
  // thread.
  absl::StatusOr<Permit> AdmitDraft(std::int64_t bytes) const;
  // Takes room for a graph that is exported. After ChooseVehicle(); on any
  // thread.
  absl::StatusOr<Permit> AdmitExport(std::size_t bytes) const;

  // OK, or the refusal that a new call of the same kind with the same
  // credentials would get now. Long calls check it from time to time.
  absl::Status Recheck() const;
  // Calls `recheck` whenever the result of Recheck() may have changed, until
  // Done(). The call may also come shortly after.
  void WatchCaller(std::function<void()> recheck);

  // Call for every message of a stream that was read, once it was admitted.
  void CountMessage() const {
    if (meter_ != nullptr) meter_->CountProgress();
  }

  // Call from the reactor's OnCancel(), which also comes when the deadline
  // passes. Work that may outlive the call cannot ask the context.
  void MarkGivenUp();
  bool given_up() const { return given_up_; }

  // The status of a call that was given up: DEADLINE_EXCEEDED or CANCELLED.
  absl::Status GivenUpStatus() const;

  // Returns the status to finish with, logs the call, and gives back the room
  // that it took: a caller who has the answer may come again. Call once, at the
  // end.
  grpc::Status End(const absl::Status& status);

  // Call from the reactor's OnDone().
  void Done();

 private:
  absl::Status TakeRoom();
  Verb MethodVerb() const;
  absl::Status Check(const Caller& caller, Verb verb) const;
  bool IsSlow(std::chrono::steady_clock::duration duration) const;

  // The work of a search.
  struct SearchNumbers {
    std::int64_t nodes_considered = 0;
    std::int64_t nodes_pruned = 0;
    std::int64_t comparisons = 0;
    std::int64_t candidates = 0;
    const char* outcome = "";
    double milliseconds = 0.0;
  };

  void LogSlow(const char* event, std::chrono::steady_clock::duration duration,
               const std::optional<SearchNumbers>& search) const;

  const char* const method_;
  const Log* const log_;
  ServiceCounters* const counts_;
  // Null if changes are not logged, or this call is none.
  const AuditLog* const audit_;
  const std::optional<std::chrono::steady_clock::duration> slow_call_;
  Drain* const drain_;
  Gatekeeper* const gatekeeper_;
  Admission* const room_;
  const MeterPointer meter_;
  const MethodRule* const rule_;
  const std::chrono::steady_clock::time_point start_;
  const std::chrono::system_clock::time_point deadline_;
  std::string request_id_;
  const TraceContext trace_;
  // Empty unless changes are logged.
  const std::string peer_;
  Credentials credentials_;
  std::shared_ptr<const Caller> caller_;
  absl::Status admission_;
  // The key of the caller's limits; empty if the call has none.
  std::string quota_key_;
  std::vector<Permit> permits_;
  Mutex search_mutex_;
  // Held apart, since a search that waits may be given up on any thread.
  Permit search_permit_ ABSL_GUARDED_BY(search_mutex_);
  Gatekeeper::WatchId watch_ = -1;
  std::string vehicle_;
  std::string changed_;
  std::optional<SearchNumbers> search_;
  std::vector<Verb> also_needs_;
  std::atomic<bool> given_up_{false};
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_SERVICE_CALL_H_
