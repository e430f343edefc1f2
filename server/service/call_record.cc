#include "server/service/call_record.h"

#include <utility>

#include "server/base/status.h"
#include "server/telemetry/audit_log.h"
#include "server/telemetry/service_counters.h"

namespace revisit::server {
namespace {

double MillisecondsOf(CallRecord::Duration duration) {
  return std::chrono::duration<double, std::milli>(duration).count();
}

// Errors of the server have a higher level than those of callers, because
// operators look for them.
LogLevel LevelOf(absl::StatusCode code) {
  switch (code) {
    case absl::StatusCode::kInternal:
    case absl::StatusCode::kDataLoss:
      return LogLevel::kError;
    case absl::StatusCode::kUnavailable:
    case absl::StatusCode::kResourceExhausted:
      return LogLevel::kWarning;
    default:
      return LogLevel::kInfo;
  }
}

}  // namespace

CallRecord::CallRecord(const ServiceContext& service, const char* method,
                       const MethodRule* rule, Origin origin)
    : method_(method),
      rule_(rule),
      log_(service.log),
      counts_(service.counts),
      audit_(AuditLog::Covers(method) ? service.audit : nullptr),
      slow_call_(service.slow_call),
      origin_(std::move(origin)) {
  counts_->Began(rule_);
}

void CallRecord::NameCaller(const Caller& caller) { caller_ = &caller; }

void CallRecord::NameVehicle(const std::string& id) {
  const MutexLock lock(&mutex_);
  vehicle_ = id;
}

void CallRecord::NameGroup(const std::string& id) {
  const MutexLock lock(&mutex_);
  group_ = id;
}

void CallRecord::NameChanged(const std::string& id) {
  const MutexLock lock(&mutex_);
  changed_ = id;
}

void CallRecord::Searched(const absl::StatusOr<core::CandidateSet>& set,
                          Duration duration) {
  const MutexLock lock(&mutex_);
  if (ended_ && !streams()) return;
  counts_->Searched(set, duration);
  if (!slow_call_) return;
  if (!streams()) {
    search_ = NumbersOf(set, duration);
  } else if (IsSlow(duration)) {
    LogSlow("slow_search", duration, NumbersOf(set, duration));
  }
}

void CallRecord::End(const absl::Status& told, const std::string& message) {
  const Duration taken = std::chrono::steady_clock::now() - start_;
  counts_->Ended(rule_, told.raw_code(), ReasonOf(told), taken);
  const MutexLock lock(&mutex_);
  ended_ = true;
  LogCall(told, message, taken);
  if (!streams() && IsSlow(taken)) LogSlow("slow_call", taken, search_);
  if (audit_ != nullptr) LogChange(told);
}

void CallRecord::Leave() { counts_->Left(rule_); }

CallRecord::SearchNumbers CallRecord::NumbersOf(
    const absl::StatusOr<core::CandidateSet>& set, Duration duration) {
  SearchNumbers numbers;
  if (set.ok()) {
    numbers.nodes_considered = set->nodes_considered;
    numbers.nodes_pruned = set->nodes_pruned;
    numbers.comparisons = set->comparisons;
    numbers.candidates = static_cast<std::int64_t>(set->candidates.size());
  }
  numbers.outcome = OutcomeOf(set);
  numbers.milliseconds = MillisecondsOf(duration);
  return numbers;
}

void CallRecord::LogCall(const absl::Status& told, const std::string& message,
                         Duration taken) const {
  log_->Write(LevelOf(told.code()), "call",
              {{"request_id", origin_.request_id},
               {"method", method_},
               {"vehicle", vehicle_},
               {"group", group_},
               {"tenant", caller_->tenant},
               {"caller", caller_->identity},
               {"code", CodeName(told.raw_code())},
               {"reason", ReasonOf(told)},
               {"message", message},
               {"trace_id", origin_.trace.trace_id},
               {"parent_id", origin_.trace.parent_id},
               {"duration_ms", MillisecondsOf(taken)}});
}

void CallRecord::LogChange(const absl::Status& told) const {
  audit_->Write({{"request_id", origin_.request_id},
                 {"method", method_},
                 {"vehicle", vehicle_},
                 {"group", group_},
                 {"id", changed_},
                 {"tenant", caller_->tenant},
                 {"caller", caller_->identity},
                 {"peer", origin_.peer},
                 {"code", CodeName(told.raw_code())},
                 {"reason", ReasonOf(told)},
                 {"trace_id", origin_.trace.trace_id},
                 {"parent_id", origin_.trace.parent_id}});
}

void CallRecord::LogSlow(const char* event, Duration duration,
                         const std::optional<SearchNumbers>& search) const {
  if (!search) {
    log_->Write(LogLevel::kWarning, event,
                {{"request_id", origin_.request_id},
                 {"method", method_},
                 {"vehicle", vehicle_},
                 {"group", group_},
                 {"trace_id", origin_.trace.trace_id},
                 {"parent_id", origin_.trace.parent_id},
                 {"duration_ms", MillisecondsOf(duration)}});
    return;
  }
  log_->Write(LogLevel::kWarning, event,
              {{"request_id", origin_.request_id},
               {"method", method_},
               {"vehicle", vehicle_},
               {"group", group_},
               {"trace_id", origin_.trace.trace_id},
               {"parent_id", origin_.trace.parent_id},
               {"duration_ms", MillisecondsOf(duration)},
               {"search_ms", search->milliseconds},
               {"outcome", std::string(search->outcome)},
               {"candidates", search->candidates},
               {"nodes_considered", search->nodes_considered},
               {"nodes_pruned", search->nodes_pruned},
               {"comparisons", search->comparisons}});
}

}  // namespace revisit::server
