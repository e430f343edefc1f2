// One call of the service: who its caller is and what that one may do, whether
// the caller still waits, and its one line in the log.
#ifndef REVISIT_SERVER_SERVICE_CALL_H_
#define REVISIT_SERVER_SERVICE_CALL_H_

#include <atomic>
#include <chrono>
#include <cstddef>
#include <functional>
#include <memory>
#include <string>
#include <vector>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "grpcpp/server_context.h"
#include "grpcpp/support/status.h"
#include "server/base/logging.h"
#include "server/connections/admission.h"
#include "server/connections/connection_meter.h"
#include "server/connections/drain.h"
#include "server/security/caller.h"
#include "server/security/gatekeeper.h"
#include "server/service/service_context.h"

namespace revisit::server {

// gRPC tells a stream's reader of a message that is no protobuf in the same way
// as of the stream's end. But a message that was read, well or badly, was
// cleared first: what is put into some string before and is still there after
// the last read means that this was the end.
inline constexpr char kUnread[] = "\x01unread";
// What a stream ends with otherwise.
absl::Status MalformedMessage();

struct MethodRule;

// Thread-safe, but for ChooseVehicle() and AlsoNeeds().
class Call {
 public:
  // Takes the request id from the metadata or makes one, and sends it back. Log
  // and drain of the service must outlive this.
  Call(grpc::CallbackServerContext* context, const char* method,
       const ServiceContext& service);

  Call(const Call&) = delete;
  Call& operator=(const Call&) = delete;

  // If not OK, the call ends with it at once: it came too late, its caller is
  // not let in, or there is no room for it.
  const absl::Status& admission() const { return admission_; }

  // Of a call that was admitted.
  const Caller& caller() const { return *caller_; }

  // Names the vehicle that the call is about. Every handler goes through here
  // before it does anything with a vehicle, and before the work is handed to
  // other threads. VEHICLE_NOT_FOUND if the vehicle is not the caller's to know
  // of, there or not; PERMISSION_DENIED (NOT_GRANTED) if the method is more
  // than the caller may do with it; STREAM_QUOTA if the vehicle has as many
  // streams as it may.
  absl::Status ChooseVehicle(const std::string& id);

  // The call turns out to do more than its method says. After ChooseVehicle().
  absl::Status AlsoNeeds(Verb verb);

  // Room for a search, held as long as this. After ChooseVehicle().
  absl::Status AdmitSearch();
  // How long it took, without waiting.
  void SearchTook(std::chrono::steady_clock::duration duration) const;
  // Room for a batch that waits to be durable. After ChooseVehicle(); any
  // thread.
  absl::StatusOr<Permit> AdmitBatch(std::size_t bytes) const;
  // The same, held as long as this: until End().
  absl::Status HoldBatch(std::size_t bytes);
  // Room for some more of a revision. After ChooseVehicle(); any thread.
  absl::StatusOr<Permit> AdmitDraft(std::int64_t bytes) const;
  // Room for a graph that is exported. After ChooseVehicle(); any thread.
  absl::StatusOr<Permit> AdmitExport(std::size_t bytes) const;

  // What a new call of the same kind, with the same credentials, would be told
  // now. Calls that last ask from time to time.
  absl::Status Recheck() const;
  // Calls `recheck` whenever Recheck() may have changed its mind, until Done().
  // It may also come shortly after.
  void WatchCaller(std::function<void()> recheck);

  // Call for every message of a stream that was read, once it was admitted.
  void CountMessage() const {
    if (meter_ != nullptr) meter_->CountProgress();
  }

  // Call from the reactor's OnCancel(), which also comes when the deadline
  // passes. The context cannot be asked by work that may outlive the call.
  void MarkGivenUp() { given_up_ = true; }
  bool given_up() const { return given_up_; }

  // What a call that was given up ends with: DEADLINE_EXCEEDED or CANCELLED.
  absl::Status GivenUpStatus() const;

  // The status to finish with; logs the call, and gives back the room that it
  // took: whoever has the answer may come again. Call once, at the end.
  grpc::Status End(const absl::Status& status);

  // Call from the reactor's OnDone().
  void Done();

 private:
  absl::Status TakeRoom();
  Verb MethodVerb() const;
  absl::Status Check(const Caller& caller, Verb verb) const;

  const char* const method_;
  const Log* const log_;
  Drain* const drain_;
  Gatekeeper* const gatekeeper_;
  Admission* const room_;
  const MeterPointer meter_;
  const MethodRule* const rule_;
  const std::chrono::steady_clock::time_point start_;
  const std::chrono::system_clock::time_point deadline_;
  std::string request_id_;
  Credentials credentials_;
  std::shared_ptr<const Caller> caller_;
  absl::Status admission_;
  // Whose limits count; empty for nobody's.
  std::string quota_key_;
  std::vector<Permit> permits_;
  Gatekeeper::WatchId watch_ = -1;
  std::string vehicle_;
  std::vector<Verb> also_needs_;
  std::atomic<bool> given_up_{false};
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_SERVICE_CALL_H_
