// The record of one call: what counts, log and log of changes say of it.
#ifndef REVISIT_SERVER_SERVICE_CALL_RECORD_H_
#define REVISIT_SERVER_SERVICE_CALL_RECORD_H_

#include <chrono>
#include <cstdint>
#include <optional>
#include <string>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "core/base/mutex.h"
#include "core/search/candidates/candidate.h"
#include "server/base/logging.h"
#include "server/security/caller.h"
#include "server/security/method_rules.h"
#include "server/service/service_context.h"
#include "server/telemetry/trace_context.h"

namespace revisit::server {

// Thread-safe, after NameCaller().
class CallRecord {
 public:
  using Duration = std::chrono::steady_clock::duration;

  // How the call came.
  struct Origin {
    std::string request_id;
    TraceContext trace;
    // In gRPC's form, such as "ipv4:127.0.0.1:4711".
    std::string peer;
  };

  // Counts that the call began. `rule` is that of the method, as
  // FindMethodRule() finds it. What the service refers to, method and rule
  // outlive this.
  CallRecord(const ServiceContext& service, const char* method,
             const MethodRule* rule, Origin origin);

  CallRecord(const CallRecord&) = delete;
  CallRecord& operator=(const CallRecord&) = delete;

  const std::string& request_id() const { return origin_.request_id; }

  // The caller outlives this.
  void NameCaller(const Caller& caller);
  void NameVehicle(const std::string& id);
  void NameGroup(const std::string& id);
  // Names the finding that the call is about, beside its vehicle or group, for
  // the log of changes.
  void NameChanged(const std::string& id);

  // Counts a search, admitted or of a stream's check, and logs it if it was
  // slow: that of a stream at once, another with its call, unless that has
  // ended.
  void Searched(const absl::StatusOr<core::CandidateSet>& set,
                Duration duration);

  // The call ends with what the caller is told, which is Named(); `message` is
  // for the log. Call once.
  void End(const absl::Status& told, const std::string& message);
  // gRPC has forgotten the call.
  void Leave();

 private:
  // The work of a search.
  struct SearchNumbers {
    std::int64_t nodes_considered = 0;
    std::int64_t nodes_pruned = 0;
    std::int64_t comparisons = 0;
    std::int64_t candidates = 0;
    const char* outcome = "";
    double milliseconds = 0.0;
  };

  bool streams() const { return rule_ != nullptr && rule_->streams; }
  bool IsSlow(Duration duration) const {
    return slow_call_ && duration >= *slow_call_;
  }
  static SearchNumbers NumbersOf(const absl::StatusOr<core::CandidateSet>& set,
                                 Duration duration);
  void LogCall(const absl::Status& told, const std::string& message,
               Duration taken) const ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_);
  void LogChange(const absl::Status& told) const
      ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_);
  void LogSlow(const char* event, Duration duration,
               const std::optional<SearchNumbers>& search) const
      ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_);

  const char* const method_;
  const MethodRule* const rule_;
  const Log* const log_;
  ServiceCounters* const counts_;
  // Null if changes are not logged, or this call is none.
  const AuditLog* const audit_;
  const std::optional<Duration> slow_call_;
  const Origin origin_;
  const std::chrono::steady_clock::time_point start_ =
      std::chrono::steady_clock::now();
  const Caller* caller_ = nullptr;

  Mutex mutex_;
  std::string vehicle_ ABSL_GUARDED_BY(mutex_);
  std::string group_ ABSL_GUARDED_BY(mutex_);
  std::string changed_ ABSL_GUARDED_BY(mutex_);
  // The search of a unary call.
  std::optional<SearchNumbers> search_ ABSL_GUARDED_BY(mutex_);
  bool ended_ ABSL_GUARDED_BY(mutex_) = false;
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_SERVICE_CALL_RECORD_H_
