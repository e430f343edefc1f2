// Unary calls: the reactor, and what their handlers share.
#ifndef REVISIT_SERVER_SERVICE_UNARY_CALL_H_
#define REVISIT_SERVER_SERVICE_UNARY_CALL_H_

#include <chrono>
#include <cstdint>
#include <functional>
#include <memory>
#include <string>
#include <utility>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "core/base/mutex.h"
#include "grpcpp/server_context.h"
#include "grpcpp/support/byte_buffer.h"
#include "grpcpp/support/server_callback.h"
#include "server/connections/drain.h"
#include "server/conversion/names.h"
#include "server/fields/field_violations.h"
#include "server/service/call.h"
#include "server/service/message_bytes.h"
#include "server/service/service_context.h"
#include "server/sessions/fleet.h"
#include "server/sessions/vehicle_session.h"

namespace revisit::server {

// The path that the fields of a request lie below.
inline constexpr FieldPath kRequest;

// Since the Unix epoch.
inline std::int64_t NowNanoseconds() {
  return std::chrono::duration_cast<std::chrono::nanoseconds>(
             std::chrono::system_clock::now().time_since_epoch())
      .count();
}

// The reactor of a unary call. A shared_ptr owns it, for the reasons given in
// stream_poses.cc.
class UnaryCall : public grpc::ServerUnaryReactor,
                  public std::enable_shared_from_this<UnaryCall> {
 public:
  UnaryCall(grpc::CallbackServerContext* context, const char* method,
            const ServiceContext& service)
      : drain_(service.drain), call_(context, method, service) {}

  // Call before anything else.
  void Start() {
    self_ = shared_from_this();
    if (!call_.needs_store()) return;
    drain_watch_ =
        drain_->Watch([weak = weak_from_this()](const Drain::End& end) {
          const auto call = weak.lock();
          if (call == nullptr || !end.at_once) return;
          call->call_.MarkGivenUp();
          call->End(end.status);
        });
  }

  void OnCancel() override { call_.MarkGivenUp(); }

  void OnDone() override {
    drain_->Unwatch(drain_watch_);
    call_.Done();
    // May destroy this.
    const std::shared_ptr<UnaryCall> self = std::move(self_);
  }

  const absl::Status& admission() const { return call_.admission(); }
  const Caller& caller() const { return call_.caller(); }
  absl::Status ChooseVehicle(const std::string& id) {
    return UnlessEnded([&] { return call_.ChooseVehicle(id); });
  }
  absl::Status AdmitRebuild(std::uint64_t poses) {
    return UnlessEnded([&] { return call_.AdmitRebuild(poses); });
  }
  absl::Status AdmitSearch() {
    return UnlessEnded([&] { return call_.AdmitSearch(); });
  }
  absl::Status TooManySteps() const { return call_.TooManySteps(); }
  absl::Status CheckSearchSteps() const { return call_.CheckSearchSteps(); }
  void SearchTook(std::chrono::steady_clock::duration duration,
                  std::int64_t steps) const {
    call_.SearchTook(duration, steps);
  }
  std::string search_flow() const { return call_.search_flow(); }
  void Searched(const absl::StatusOr<core::CandidateSet>& set,
                std::chrono::steady_clock::duration duration) {
    const MutexLock lock(&mutex_);
    if (!ended_) call_.Searched(set, duration);
  }
  void NameChanged(const std::string& id) {
    const MutexLock lock(&mutex_);
    if (!ended_) call_.NameChanged(id);
  }
  absl::Status HoldBatch(std::size_t bytes) {
    return UnlessEnded([&] { return call_.HoldBatch(bytes); });
  }
  bool given_up() const { return call_.given_up(); }
  absl::Status GivenUpStatus() const { return call_.GivenUpStatus(); }

  // Call once, on any thread. Nothing happens if the store was found out of
  // reach meanwhile, and the call ended with that.
  void End(const absl::Status& status) {
    grpc::Status answer;
    {
      const MutexLock lock(&mutex_);
      if (ended_) return;
      ended_ = true;
      if (status.ok()) WriteResponse();
      answer = call_.End(status);
    }
    // May destroy this.
    Finish(answer);
  }

 private:
  virtual void WriteResponse() = 0;

  // Does the work and returns its status, unless the call has ended: then
  // nobody hears the status that this returns.
  template <typename Work>
  absl::Status UnlessEnded(const Work& work) {
    const MutexLock lock(&mutex_);
    return ended_ ? call_.GivenUpStatus() : work();
  }

  Drain* const drain_;
  Drain::WatchId drain_watch_ = -1;
  // Held while the call is used in ways that its end rules out.
  Mutex mutex_;
  bool ended_ ABSL_GUARDED_BY(mutex_) = false;
  Call call_;
  std::shared_ptr<UnaryCall> self_;
};

// A unary call with its messages.
template <typename Request, typename Response>
class TypedCall final : public UnaryCall {
 public:
  // The bytes of the response live until Finish().
  TypedCall(grpc::CallbackServerContext* context, const char* method,
            const ServiceContext& service, grpc::ByteBuffer* response_bytes)
      : UnaryCall(context, method, service), response_bytes_(response_bytes) {}

  Request request;
  Response response;

 private:
  void WriteResponse() override { WriteMessage(response, response_bytes_); }

  grpc::ByteBuffer* const response_bytes_;
};

using UnaryCallPtr = std::shared_ptr<UnaryCall>;

// A callback that finishes the call with what `encode` makes of the value.
template <typename Value, typename Encode>
std::function<void(absl::StatusOr<Value>)> FinishWith(UnaryCallPtr call,
                                                      Encode encode) {
  return [call = std::move(call), encode](absl::StatusOr<Value> value) {
    // Nobody waits for the answer that would be made of it.
    const absl::Status given_up =
        call->given_up() ? call->GivenUpStatus() : absl::OkStatus();
    if (!value.ok() || !given_up.ok()) {
      call->End(value.ok() ? given_up : value.status());
      return;
    }
    const absl::Status status = encode(*value);
    call->End(status);
  };
}

// Opens the session of the vehicle that a field names.
inline absl::StatusOr<std::shared_ptr<VehicleSession>> SessionOf(
    const ServiceContext& context, const std::string& name,
    const FieldPath& path, UnaryCall* call) {
  absl::StatusOr<std::string> id = ParseVehicleName(name, path);
  if (!id.ok()) return id.status();
  if (absl::Status status = call->ChooseVehicle(*id); !status.ok()) {
    return status;
  }
  return context.fleet->Session(*id);
}

}  // namespace revisit::server

#endif  // REVISIT_SERVER_SERVICE_UNARY_CALL_H_
