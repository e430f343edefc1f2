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
#include "server/service/call_reactor.h"
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

// The reactor of a unary call.
class UnaryCall : public CallReactor<UnaryCall, grpc::ServerUnaryReactor> {
 public:
  using CallReactor::CallReactor;

 private:
  // While the server drains, the call goes on to its answer; where the store is
  // out of reach, that may never come.
  void OnDrain(const Drain::End& end)
      ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_) override {
    if (!end.at_once) return;
    MarkGivenUp();
    EndLocked(end.status);
  }
};

using UnaryCallPtr = std::shared_ptr<UnaryCall>;

// The handler of a unary method. It either returns an error, which ends the
// call, or returns OK and has the call ended later, once, from any thread.
// Request and response live as long as the call, the service until it returns.
template <typename Request, typename Response>
using UnaryHandler = absl::Status (*)(const ServiceContext& service,
                                      const UnaryCallPtr& call,
                                      const Request& request,
                                      Response* response);

// A unary call with its messages.
template <typename Request, typename Response>
class TypedCall final : public UnaryCall {
 public:
  // The bytes of the request live until Start() returns, as does the service;
  // those of the response live until the end.
  TypedCall(const ServiceContext& service, const char* method,
            UnaryHandler<Request, Response> handler,
            grpc::CallbackServerContext* context,
            const grpc::ByteBuffer* request_bytes,
            grpc::ByteBuffer* response_bytes)
      : UnaryCall(context, method, service),
        service_(service),
        handler_(handler),
        request_bytes_(request_bytes),
        response_bytes_(response_bytes) {}

 private:
  void OnStart() override {
    absl::Status status = ParseMessage(request_bytes_, &request_);
    if (status.ok()) {
      status = handler_(service_, shared_from_this(), request_, &response_);
    }
    if (!status.ok()) End(status);
  }

  void OnEnd(const absl::Status& status)
      ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_) override {
    if (status.ok()) WriteMessage(response_, response_bytes_);
  }

  const ServiceContext& service_;
  const UnaryHandler<Request, Response> handler_;
  const grpc::ByteBuffer* const request_bytes_;
  grpc::ByteBuffer* const response_bytes_;
  Request request_;
  Response response_;
};

// Whether the caller may read this vehicle or group.
inline bool MayRead(const UnaryCall& call, const std::string& id,
                    Resource resource = Resource::kVehicle) {
  return call.rights().caller().May(Verb::kRead, id, resource);
}

// CANCELLED or DEADLINE_EXCEEDED once nobody waits for the call's answer.
inline absl::Status CheckAwaited(const UnaryCall& call) {
  return call.given_up() ? call.GivenUpStatus() : absl::OkStatus();
}

// A callback that finishes the call with what `encode` makes of the value.
template <typename Value, typename Encode>
std::function<void(absl::StatusOr<Value>)> FinishWith(UnaryCallPtr call,
                                                      Encode encode) {
  return [call = std::move(call), encode](absl::StatusOr<Value> value) {
    const absl::Status awaited = CheckAwaited(*call);
    if (!value.ok() || !awaited.ok()) {
      call->End(value.ok() ? awaited : value.status());
      return;
    }
    const absl::Status status = encode(*value);
    call->End(status);
  };
}

// Opens the session of the vehicle that a field names.
inline absl::StatusOr<std::shared_ptr<VehicleSession>> SessionOf(
    const ServiceContext& service, const std::string& name,
    const FieldPath& path, UnaryCall* call) {
  absl::StatusOr<std::string> id = ParseVehicleName(name, path);
  if (!id.ok()) return id.status();
  if (absl::Status status = call->ChooseVehicle(*id); !status.ok()) {
    return status;
  }
  return service.fleet->Session(*id);
}

// Names the group that a field names as the one that the call is about.
inline absl::StatusOr<std::string> ChooseGroup(const std::string& name,
                                               const FieldPath& path,
                                               UnaryCall* call) {
  absl::StatusOr<std::string> id = ParseGroupName(name, path);
  if (!id.ok()) return id.status();
  if (absl::Status status = call->ChooseGroup(*id); !status.ok()) {
    return status;
  }
  return *id;
}

}  // namespace revisit::server

#endif  // REVISIT_SERVER_SERVICE_UNARY_CALL_H_
