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
#include "server/logging.h"

namespace revisit::server {

// Thread-safe, but for set_vehicle().
class Call {
 public:
  // Takes the request id from the metadata or makes one, and sends it back.
  // `log` must outlive this.
  Call(grpc::CallbackServerContext* context, const char* method,
       const Log* log);

  // For the log. Call before the work is handed to other threads.
  void set_vehicle(const std::string& id) { vehicle_ = id; }

  // Of a call whose reactor hears of cancellation: instead of asking the
  // context, which is gone once the call is done.
  void MarkGivenUp() { given_up_ = true; }
  bool given_up() const { return given_up_; }

  // Whether the deadline has passed. Needs no context.
  bool expired() const;
  // What a call that was given up ends with: DEADLINE_EXCEEDED or CANCELLED.
  absl::Status GivenUpStatus() const;

  // The status to finish with; logs the call. Call once, at the end.
  grpc::Status End(const absl::Status& status) const;

 private:
  const char* const method_;
  const Log* const log_;
  const std::chrono::steady_clock::time_point start_;
  const std::chrono::system_clock::time_point deadline_;
  std::string request_id_;
  std::string vehicle_;
  std::atomic<bool> given_up_{false};
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_CALL_H_
