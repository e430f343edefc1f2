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
#include "grpcpp/server_context.h"
#include "grpcpp/support/byte_buffer.h"
#include "grpcpp/support/server_callback.h"
#include "server/conversion/field_violations.h"
#include "server/conversion/names.h"
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
      : call_(context, method, service) {}

  // Call before anything else.
  void Start() { self_ = shared_from_this(); }

  void OnCancel() override { call_.MarkGivenUp(); }

  void OnDone() override {
    call_.Done();
    // May destroy this.
    const std::shared_ptr<UnaryCall> self = std::move(self_);
  }

  const absl::Status& admission() const { return call_.admission(); }
  const Caller& caller() const { return call_.caller(); }
  absl::Status ChooseVehicle(const std::string& id) {
    return call_.ChooseVehicle(id);
  }
  absl::Status AdmitSearch() { return call_.AdmitSearch(); }
  void SearchTook(std::chrono::steady_clock::duration duration) const {
    call_.SearchTook(duration);
  }
  void Searched(const absl::StatusOr<core::CandidateSet>& set,
                std::chrono::steady_clock::duration duration) {
    call_.Searched(set, duration);
  }
  void NameChanged(const std::string& id) { call_.NameChanged(id); }
  absl::Status HoldBatch(std::size_t bytes) { return call_.HoldBatch(bytes); }
  bool given_up() const { return call_.given_up(); }
  absl::Status GivenUpStatus() const { return call_.GivenUpStatus(); }

  // Call once, on any thread.
  void End(const absl::Status& status) {
    if (status.ok()) WriteResponse();
    Finish(call_.End(status));
  }

 private:
  virtual void WriteResponse() = 0;

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
