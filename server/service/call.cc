#include "server/service/call.h"

#include <algorithm>
#include <cstdint>
#include <cstdio>
#include <random>
#include <utility>

#include "absl/strings/cord.h"
#include "absl/strings/string_view.h"
#include "google/rpc/error_details.pb.h"
#include "grpc/grpc_security_constants.h"
#include "grpcpp/security/auth_context.h"
#include "server/base/status.h"
#include "server/base/status_grpc.h"
#include "server/security/method_rules.h"
#include "server/telemetry/audit_log.h"

namespace revisit::server {
namespace {

constexpr char kRequestIdKey[] = "x-request-id";
constexpr char kAuthorizationKey[] = "authorization";
constexpr char kTraceParentKey[] = "traceparent";
constexpr std::size_t kMaxRequestIdBytes = 128;

// The remaining time of callers without a deadline, short enough to be added to
// other times.
constexpr std::chrono::hours kEndless{24};

std::string NewRequestId() {
  thread_local std::mt19937_64 generator(std::random_device{}());
  char text[17];
  std::snprintf(text, sizeof(text), "%016llx",
                static_cast<unsigned long long>(generator()));
  return text;
}

std::string RequestId(const grpc::CallbackServerContext& context) {
  const auto& metadata = context.client_metadata();
  const auto entry = metadata.find(kRequestIdKey);
  if (entry != metadata.end()) {
    const std::string id(entry->second.data(), entry->second.size());
    const bool printable = std::all_of(
        id.begin(), id.end(), [](char c) { return c >= ' ' && c <= '~'; });
    if (!id.empty() && id.size() <= kMaxRequestIdBytes && printable) return id;
  }
  return NewRequestId();
}

TraceContext TraceOf(const grpc::CallbackServerContext& context) {
  const auto& metadata = context.client_metadata();
  // Given twice, it is malformed.
  if (metadata.count(kTraceParentKey) != 1) return {};
  const grpc::string_ref header = metadata.find(kTraceParentKey)->second;
  return ParseTraceParent({header.data(), header.size()});
}

Credentials CredentialsOf(const grpc::CallbackServerContext& context) {
  Credentials credentials;
  const auto [first, last] =
      context.client_metadata().equal_range(kAuthorizationKey);
  for (auto entry = first; entry != last; ++entry) {
    credentials.authorizations.emplace_back(entry->second.data(),
                                            entry->second.size());
  }
  const auto authentication = context.auth_context();
  if (authentication == nullptr || !authentication->IsPeerAuthenticated()) {
    return credentials;
  }
  const auto property = [&](const char* name) {
    const auto values = authentication->FindPropertyValues(name);
    return values.empty()
               ? std::string()
               : std::string(values.front().data(), values.front().size());
  };
  credentials.certificate_pem = property(GRPC_X509_PEM_CERT_PROPERTY_NAME);
  credentials.certificate_chain_pem =
      property(GRPC_X509_PEM_CERT_CHAIN_PROPERTY_NAME);
  return credentials;
}

std::shared_ptr<const Caller> Nobody() {
  static const auto* const nobody = new std::shared_ptr<const Caller>([] {
    auto caller = std::make_shared<Caller>();
    caller->grants.emplace();
    return caller;
  }());
  return *nobody;
}

// The key of a caller's limits. They are shared by all callers of a tenant, or,
// where nobody is asked who calls, by all programs at one address.
std::string QuotaKey(const Caller& caller,
                     const grpc::CallbackServerContext& context) {
  if (!caller.tenant.empty() && caller.tenant != "*") return caller.tenant;
  if (!caller.identity.empty()) return caller.identity;
  // An address such as ipv4:127.0.0.1:4711.
  const std::string peer = context.peer();
  return peer.substr(0, peer.rfind(':'));
}

// Errors of the server have a higher level than those of callers, because
// operators look for them.
LogLevel LevelOf(grpc::StatusCode code) {
  switch (code) {
    case grpc::StatusCode::INTERNAL:
    case grpc::StatusCode::DATA_LOSS:
      return LogLevel::kError;
    case grpc::StatusCode::UNAVAILABLE:
    case grpc::StatusCode::RESOURCE_EXHAUSTED:
      return LogLevel::kWarning;
    default:
      return LogLevel::kInfo;
  }
}

// Adds the request id to the ErrorInfo of an error.
absl::Status WithRequestId(const absl::Status& status, const std::string& id) {
  if (status.ok()) return status;
  absl::Status result = Named(status);
  google::rpc::ErrorInfo info;
  info.ParseFromString(std::string(*result.GetPayload(kErrorInfoUrl)));
  (*info.mutable_metadata())["request_id"] = id;
  result.SetPayload(kErrorInfoUrl, absl::Cord(info.SerializeAsString()));
  return result;
}

}  // namespace

Call::Call(grpc::CallbackServerContext* context, const char* method,
           const ServiceContext& service)
    : method_(method),
      log_(service.log),
      counts_(service.counts),
      audit_(AuditLog::Covers(method) ? service.audit : nullptr),
      slow_call_(service.slow_call),
      drain_(service.drain),
      gatekeeper_(service.gatekeeper),
      room_(service.admission),
      meter_(service.meters->Find(context->peer())),
      rule_(FindMethodRule(method)),
      start_(std::chrono::steady_clock::now()),
      deadline_(context->deadline()),
      request_id_(RequestId(*context)),
      trace_(TraceOf(*context)),
      peer_(audit_ != nullptr ? context->peer() : std::string()) {
  counts_->Began(rule_);
  context->AddInitialMetadata(kRequestIdKey, request_id_);
  const absl::Status entry = drain_->Enter(needs_store());
  if (gatekeeper_->asks()) credentials_ = CredentialsOf(*context);
  auto caller =
      gatekeeper_->Admit(credentials_, std::chrono::system_clock::now());
  if (caller.ok()) {
    caller_ = *std::move(caller);
    if (entry.ok()) CountMessage();
  } else {
    caller_ = Nobody();
    admission_ = caller.status();
  }
  if (!entry.ok()) admission_ = entry;
  if (!admission_.ok()) return;
  quota_key_ = QuotaKey(*caller_, *context);
  admission_ = TakeRoom();
}

bool Call::needs_store() const {
  return rule_ != nullptr && rule_->verb.has_value();
}

absl::Status Call::TakeRoom() {
  // An operator wants to know about a server that is full.
  if (!needs_store()) return absl::OkStatus();
  absl::StatusOr<Permit> permit =
      rule_->streams ? room_->Stream(quota_key_) : room_->Call(quota_key_);
  if (!permit.ok()) return permit.status();
  permits_.push_back(*std::move(permit));
  return absl::OkStatus();
}

void Call::Done() {
  if (watch_ >= 0) gatekeeper_->Unwatch(watch_);
  counts_->Left(rule_);
  drain_->Leave();
}

Verb Call::MethodVerb() const {
  if (rule_ == nullptr) return Verb::kAdmin;
  return rule_->verb.value_or(Verb::kAdmin);
}

absl::Status Call::Check(const Caller& caller, Verb verb) const {
  if (caller.May(verb, vehicle_)) return absl::OkStatus();
  const bool creates = rule_ != nullptr && rule_->creates;
  if (!caller.MaySee(vehicle_) && !creates) return VehicleNotFound(vehicle_);
  return Error(absl::StatusCode::kPermissionDenied, "NOT_GRANTED",
               std::string(method_) + " needs the verb " + VerbName(verb) +
                   " on this vehicle, which is not granted to the caller",
               {{"verb", VerbName(verb)}});
}

absl::Status Call::ChooseVehicle(const std::string& id) {
  vehicle_ = id;
  if (absl::Status status = Check(*caller_, MethodVerb()); !status.ok()) {
    return status;
  }
  if (rule_ == nullptr) return absl::OkStatus();
  absl::StatusOr<Permit> permit =
      rule_->streams ? room_->StreamOf(id) : room_->CallOf(id);
  if (!permit.ok()) return permit.status();
  permits_.push_back(*std::move(permit));
  return absl::OkStatus();
}

absl::Status Call::AdmitRebuild(std::uint64_t poses) {
  absl::StatusOr<Permit> permit =
      room_->Rebuild(quota_key_, static_cast<std::int64_t>(poses));
  if (!permit.ok()) return permit.status();
  permits_.push_back(*std::move(permit));
  return absl::OkStatus();
}

absl::Status Call::AdmitSearch() {
  const auto now = std::chrono::system_clock::now();
  const auto latest = std::min(deadline_, now + kEndless);
  if (absl::Status status = CheckSearchSteps(); !status.ok()) return status;
  absl::StatusOr<Permit> permit =
      room_->Search(vehicle_, quota_key_, latest - now);
  if (!permit.ok()) return permit.status();
  const MutexLock lock(&search_mutex_);
  if (!given_up_) search_permit_ = *std::move(permit);
  return absl::OkStatus();
}

absl::Status Call::CheckSearchSteps() const {
  if (!caller_->max_search_steps_per_second) return absl::OkStatus();
  return room_->CheckSteps(quota_key_, *caller_->max_search_steps_per_second);
}

void Call::SearchTook(std::chrono::steady_clock::duration duration,
                      std::int64_t steps) const {
  room_->SearchTook(quota_key_, duration);
  if (!caller_->max_search_steps_per_second) return;
  room_->UseSteps(quota_key_, *caller_->max_search_steps_per_second, steps);
}

void Call::MarkGivenUp() {
  given_up_ = true;
  // A search that waits is dropped when its turn comes; its room is free at
  // once, while that of its call still bounds how many such there are.
  const MutexLock lock(&search_mutex_);
  search_permit_.reset();
}

absl::Status Call::TooManySteps() const {
  return room_->TooManySteps(vehicle_);
}

void Call::Searched(const absl::StatusOr<core::CandidateSet>& set,
                    std::chrono::steady_clock::duration duration) {
  counts_->Searched(set, duration);
  if (!slow_call_) return;
  SearchNumbers numbers;
  if (set.ok()) {
    numbers.nodes_considered = set->nodes_considered;
    numbers.nodes_pruned = set->nodes_pruned;
    numbers.comparisons = set->comparisons;
    numbers.candidates = static_cast<std::int64_t>(set->candidates.size());
  }
  numbers.outcome = OutcomeOf(set);
  numbers.milliseconds =
      std::chrono::duration<double, std::milli>(duration).count();
  const bool of_stream = rule_ != nullptr && rule_->streams;
  if (!of_stream) {
    search_ = numbers;
  } else if (IsSlow(duration)) {
    LogSlow("slow_search", duration, numbers);
  }
}

void Call::NameChanged(const std::string& id) { changed_ = id; }

bool Call::IsSlow(std::chrono::steady_clock::duration duration) const {
  return slow_call_ && duration >= *slow_call_;
}

absl::StatusOr<Permit> Call::AdmitBatch(std::size_t bytes) const {
  return room_->Queue(vehicle_, static_cast<std::int64_t>(bytes));
}

absl::Status Call::HoldBatch(std::size_t bytes) {
  absl::StatusOr<Permit> permit = AdmitBatch(bytes);
  if (!permit.ok()) return permit.status();
  permits_.push_back(*std::move(permit));
  return absl::OkStatus();
}

absl::StatusOr<Permit> Call::AdmitDraft(std::int64_t bytes) const {
  return room_->Draft(vehicle_, bytes);
}

absl::StatusOr<Permit> Call::AdmitExport(std::size_t bytes) const {
  return room_->Export(vehicle_, static_cast<std::int64_t>(bytes));
}

absl::Status Call::AlsoNeeds(Verb verb) {
  also_needs_.push_back(verb);
  return Check(*caller_, verb);
}

absl::Status Call::Recheck() const {
  const auto caller =
      gatekeeper_->Admit(credentials_, std::chrono::system_clock::now());
  if (!caller.ok()) return caller.status();
  if (vehicle_.empty()) return absl::OkStatus();
  std::vector<Verb> verbs = also_needs_;
  verbs.push_back(MethodVerb());
  for (const Verb verb : verbs) {
    if (absl::Status status = Check(**caller, verb); !status.ok()) {
      return status;
    }
  }
  return absl::OkStatus();
}

void Call::WatchCaller(std::function<void()> recheck) {
  watch_ = gatekeeper_->Watch(caller_->expires, std::move(recheck));
}

absl::Status Call::GivenUpStatus() const {
  if (std::chrono::system_clock::now() < deadline_) {
    return Error(absl::StatusCode::kCancelled, "CANCELLED",
                 "the caller gave up");
  }
  return Error(absl::StatusCode::kDeadlineExceeded, "DEADLINE_EXCEEDED",
               "the caller's deadline passed");
}

grpc::Status Call::End(const absl::Status& status) {
  permits_.clear();
  {
    const MutexLock lock(&search_mutex_);
    search_permit_.reset();
  }
  const absl::Status named = WithRequestId(status, request_id_);
  const grpc::Status answer = ToGrpcStatus(named);
  const auto taken = std::chrono::steady_clock::now() - start_;
  const std::chrono::duration<double, std::milli> duration = taken;
  const std::string reason = ReasonOf(named);
  const char* const code = CodeName(answer.error_code());
  counts_->Ended(rule_, answer.error_code(), reason, taken);
  log_->Write(LevelOf(answer.error_code()), "call",
              {{"request_id", request_id_},
               {"method", method_},
               {"vehicle", vehicle_},
               {"tenant", caller_->tenant},
               {"caller", caller_->identity},
               {"code", code},
               {"reason", reason},
               {"message", std::string(status.message())},
               {"trace_id", trace_.trace_id},
               {"parent_id", trace_.parent_id},
               {"duration_ms", duration.count()}});
  const bool streams = rule_ != nullptr && rule_->streams;
  if (!streams && IsSlow(taken)) LogSlow("slow_call", taken, search_);
  if (audit_ != nullptr) {
    audit_->Write({{"request_id", request_id_},
                   {"method", method_},
                   {"vehicle", vehicle_},
                   {"id", changed_},
                   {"tenant", caller_->tenant},
                   {"caller", caller_->identity},
                   {"peer", peer_},
                   {"code", code},
                   {"reason", reason},
                   {"trace_id", trace_.trace_id},
                   {"parent_id", trace_.parent_id}});
  }
  return answer;
}

void Call::LogSlow(const char* event,
                   std::chrono::steady_clock::duration duration,
                   const std::optional<SearchNumbers>& search) const {
  const double milliseconds =
      std::chrono::duration<double, std::milli>(duration).count();
  if (!search) {
    log_->Write(LogLevel::kWarning, event,
                {{"request_id", request_id_},
                 {"method", method_},
                 {"vehicle", vehicle_},
                 {"trace_id", trace_.trace_id},
                 {"parent_id", trace_.parent_id},
                 {"duration_ms", milliseconds}});
    return;
  }
  log_->Write(LogLevel::kWarning, event,
              {{"request_id", request_id_},
               {"method", method_},
               {"vehicle", vehicle_},
               {"trace_id", trace_.trace_id},
               {"parent_id", trace_.parent_id},
               {"duration_ms", milliseconds},
               {"search_ms", search->milliseconds},
               {"outcome", std::string(search->outcome)},
               {"candidates", search->candidates},
               {"nodes_considered", search->nodes_considered},
               {"nodes_pruned", search->nodes_pruned},
               {"comparisons", search->comparisons}});
}

}  // namespace revisit::server
