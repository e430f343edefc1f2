// One call of the service: who it is, whether its caller still waits, and its
// one line in the log.
#ifndef REVISIT_SERVER_CALL_H_
#define REVISIT_SERVER_CALL_H_

#include <atomic>
#include <chrono>
#include <string>

#include "absl/status/status.h"
#include "grpcpp/server_context.h"
#include "grpcpp/support/status.h"
#include "server/drain.h"
#include "server/logging.h"
#include "server/service_context.h"

namespace revisit::server {

// gRPC tells a stream's reader of a message that is no protobuf in the same way
// as of the stream's end. But a message that was read, well or badly, was
// cleared first: what is put into some string before and is still there after
// the last read means that this was the end.
inline constexpr char kUnread[] = "\x01unread";
// What a stream ends with otherwise.
absl::Status MalformedMessage();

// Thread-safe, but for set_vehicle().
class Call {
 public:
  // Takes the request id from the metadata or makes one, and sends it back. Log
  // and drain of the service must outlive this.
  Call(grpc::CallbackServerContext* context, const char* method,
       const ServiceContext& service);

  Call(const Call&) = delete;
  Call& operator=(const Call&) = delete;

  // Whether the call came in time. Otherwise it ends with Drain::Refusal().
  bool admitted() const { return admitted_; }

  // For the log. Call before the work is handed to other threads.
  void set_vehicle(const std::string& id) { vehicle_ = id; }

  // Call from the reactor's OnCancel(), which also comes when the deadline
  // passes. The context cannot be asked by work that may outlive the call.
  void MarkGivenUp() { given_up_ = true; }
  bool given_up() const { return given_up_; }

  // What a call that was given up ends with: DEADLINE_EXCEEDED or CANCELLED.
  absl::Status GivenUpStatus() const;

  // The status to finish with; logs the call. Call once, at the end.
  grpc::Status End(const absl::Status& status) const;

  // Call from the reactor's OnDone().
  void Done();

 private:
  const char* const method_;
  const Log* const log_;
  Drain* const drain_;
  const bool admitted_;
  const std::chrono::steady_clock::time_point start_;
  const std::chrono::system_clock::time_point deadline_;
  std::string request_id_;
  std::string vehicle_;
  std::atomic<bool> given_up_{false};
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_CALL_H_
