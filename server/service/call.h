// One call of the service beside its messages: whether it is let in, how long
// its caller waits, and what it ends with. The rest is in its parts: who calls,
// the room that the call takes, what it may search, and what is said of it.
#ifndef REVISIT_SERVER_SERVICE_CALL_H_
#define REVISIT_SERVER_SERVICE_CALL_H_

#include <atomic>
#include <chrono>
#include <string>

#include "absl/status/status.h"
#include "grpcpp/server_context.h"
#include "grpcpp/support/status.h"
#include "server/connections/connection_meter.h"
#include "server/connections/drain.h"
#include "server/security/method_rules.h"
#include "server/service/call_record.h"
#include "server/service/call_room.h"
#include "server/service/caller_rights.h"
#include "server/service/search_allowance.h"
#include "server/service/service_context.h"

namespace revisit::server {

// Thread-safe.
class Call {
 public:
  // Takes the request id from the metadata or makes one, and sends it back.
  // All that the service refers to must outlive this.
  Call(grpc::CallbackServerContext* context, const char* method,
       const ServiceContext& service);

  Call(const Call&) = delete;
  Call& operator=(const Call&) = delete;

  // Whether it is about what is stored, rather than about the server itself.
  bool needs_store() const { return NeedsStore(rule_); }

  // Names the vehicle that the call is about. Every handler goes through here
  // before it does anything with a vehicle, and before the work is handed to
  // other threads. VEHICLE_NOT_FOUND if the caller may not know of the vehicle,
  // whether it exists or not; PERMISSION_DENIED (NOT_GRANTED) if the caller may
  // not use this method on it; STREAM_QUOTA or QUEUE_FULL if the vehicle has as
  // many streams, or as many unary calls, as it may have.
  absl::Status ChooseVehicle(const std::string& id);
  // The same of the group that the call is about: GROUP_NOT_FOUND in the place
  // of VEHICLE_NOT_FOUND. Groups share the limit of calls per vehicle.
  absl::Status ChooseGroup(const std::string& id);

  CallerRights& rights() { return rights_; }
  const CallerRights& rights() const { return rights_; }
  CallRoom& room() { return room_; }
  SearchAllowance& searches() { return searches_; }
  CallRecord& record() { return record_; }

  // Whether nobody waits for the answer any more. Work that may outlive the
  // call cannot ask gRPC's context.
  bool given_up() const { return given_up_; }
  // The status of a call that was given up: DEADLINE_EXCEEDED or CANCELLED.
  absl::Status GivenUpStatus() const;

 protected:
  ~Call() = default;

  // OK, or what to end the call with at once: it came too late, its caller is
  // not let in, or there is no room for it.
  const absl::Status& entry() const { return entry_; }

  // Call for every message of a stream that was read, once it was let in.
  void CountMessage() const {
    if (meter_ != nullptr) meter_->CountProgress();
  }

  void MarkGivenUp();

  // Returns the status to finish with, logs the call, and gives back the room
  // that it took: a caller who has the answer may come again. Call once, at the
  // end.
  grpc::Status Conclude(const absl::Status& status);

  // gRPC has forgotten the call.
  void Leave();

 private:
  Drain* const drain_;
  const MeterPointer meter_;
  const MethodRule* const rule_;
  const std::chrono::system_clock::time_point deadline_;
  CallRecord record_;
  absl::Status entry_;
  CallerRights rights_;
  CallRoom room_;
  SearchAllowance searches_;
  std::atomic<bool> given_up_{false};
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_SERVICE_CALL_H_
