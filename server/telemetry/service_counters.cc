#include "server/telemetry/service_counters.h"

#include <algorithm>
#include <iterator>
#include <string_view>

#include "revisit/v1/error_reason.pb.h"
#include "server/base/metrics.h"
#include "server/base/status.h"

namespace revisit::server {
namespace {

constexpr const char* kCodes[] = {"OK",
                                  "CANCELLED",
                                  "UNKNOWN",
                                  "INVALID_ARGUMENT",
                                  "DEADLINE_EXCEEDED",
                                  "NOT_FOUND",
                                  "ALREADY_EXISTS",
                                  "PERMISSION_DENIED",
                                  "RESOURCE_EXHAUSTED",
                                  "FAILED_PRECONDITION",
                                  "ABORTED",
                                  "OUT_OF_RANGE",
                                  "UNIMPLEMENTED",
                                  "INTERNAL",
                                  "UNAVAILABLE",
                                  "DATA_LOSS",
                                  "UNAUTHENTICATED"};
constexpr std::size_t kUnknownCode = 2;

// Names of values in labels and in the log; null for a number that is no value.
// Counters are numbered by the values that have a name, so that a value without
// one is an error in builds that only warn of others, too.
#pragma GCC diagnostic push
#pragma GCC diagnostic error "-Wswitch"
constexpr const char* NameOf(core::Verdict verdict) {
  switch (verdict) {
    case core::Verdict::kAccepted:
      return "accepted";
    case core::Verdict::kRejectedByGate:
      return "rejected_by_gate";
    case core::Verdict::kRejectedByShape:
      return "rejected_by_shape";
    case core::Verdict::kAmbiguous:
      return "ambiguous";
    case core::Verdict::kUninformative:
      return "uninformative";
    case core::Verdict::kIllConditioned:
      return "ill_conditioned";
  }
  return nullptr;
}

constexpr const char* NameOf(core::EmptyReason reason) {
  switch (reason) {
    case core::EmptyReason::kPathTooShort:
      return "path_too_short";
    case core::EmptyReason::kNoHistory:
      return "no_history";
    case core::EmptyReason::kAllSuppressed:
      return "all_suppressed";
    case core::EmptyReason::kNotEmpty:
    case core::EmptyReason::kNoAlignment:
      return "no_alignment";
    case core::EmptyReason::kNoProbablePlace:
      return "no_probable_place";
    case core::EmptyReason::kTooMuchWork:
      return "too_much_work";
  }
  return nullptr;
}

constexpr const char* NameOf(Decision decision) {
  switch (decision) {
    case Decision::kLoopClosureAdded:
      return "loop_closure_added";
    case Decision::kLoopClosureDeleted:
      return "loop_closure_deleted";
    case Decision::kCandidateRejected:
      return "candidate_rejected";
    case Decision::kRejectionDeleted:
      return "rejection_deleted";
    case Decision::kPosesRevised:
      return "poses_revised";
    case Decision::kDataLossAccepted:
      return "data_loss_accepted";
  }
  return nullptr;
}

#pragma GCC diagnostic pop

// How many values of an enum have a name.
template <typename Enum>
constexpr std::size_t CountNamed() {
  std::size_t count = 0;
  while (NameOf(static_cast<Enum>(count)) != nullptr) ++count;
  return count;
}

// The names of an enum's values, from the first that counts.
template <typename Enum>
std::vector<const char*> NamesOf(std::size_t first = 0) {
  std::vector<const char*> names;
  for (std::size_t i = first; i < CountNamed<Enum>(); ++i) {
    names.push_back(NameOf(static_cast<Enum>(i)));
  }
  return names;
}

constexpr char kStopped[] = "stopped";
constexpr char kFailed[] = "failed";

// All results of OutcomeOf().
const std::vector<const char*>& Outcomes() {
  static const auto* const outcomes = [] {
    auto* const names = new std::vector<const char*>(NamesOf<core::Verdict>());
    // Without the first, kNotEmpty, whose name another has as well.
    for (const char* name : NamesOf<core::EmptyReason>(1)) {
      names->push_back(name);
    }
    names->push_back(kStopped);
    names->push_back(kFailed);
    return names;
  }();
  return *outcomes;
}

constexpr char kReasonPrefix[] = "ERROR_REASON_";

std::size_t CodeIndex(int code) {
  const auto index = static_cast<std::size_t>(code);
  return index < std::size(kCodes) ? index : kUnknownCode;
}

std::size_t ReasonIndex(const std::string& reason) {
  v1::ErrorReason value = v1::ERROR_REASON_UNSPECIFIED;
  v1::ErrorReason_Parse(kReasonPrefix + reason, &value);
  return static_cast<std::size_t>(value);
}

// The last of Outcomes(), kFailed, for a word that is none of them.
std::size_t OutcomeIndex(std::string_view outcome) {
  const auto& outcomes = Outcomes();
  const auto found = std::find(outcomes.begin(), outcomes.end() - 1, outcome);
  return static_cast<std::size_t>(found - outcomes.begin());
}

void Increase(std::atomic<std::uint64_t>* count, std::uint64_t amount = 1) {
  count->fetch_add(amount, std::memory_order_relaxed);
}

ServiceCounters::Labelled WithReasons(
    const std::vector<std::atomic<std::uint64_t>>& counts) {
  ServiceCounters::Labelled labelled;
  for (std::size_t i = 0; i < counts.size(); ++i) {
    // Empty for a number that is no reason.
    const std::string name =
        v1::ErrorReason_Name(static_cast<v1::ErrorReason>(i));
    if (name.empty()) continue;
    labelled.emplace_back(name.substr(sizeof(kReasonPrefix) - 1),
                          counts[i].load(std::memory_order_relaxed));
  }
  return labelled;
}

void AddAll(const ServiceCounters::Labelled& counts, const char* label,
            MetricFamily* family) {
  for (const auto& [name, count] : counts) family->Add(count, {{label, name}});
}

void CollectCalls(const ServiceCounters::Counts& counts, Metrics* metrics) {
  MetricFamily& ended = metrics->Counter(
      "revisit_calls_total", "Calls that have ended, by method and code.");
  MetricFamily& open =
      metrics->Gauge("revisit_calls_open", "Calls and streams that are open.");
  MetricFamily& seconds = metrics->Histogram(
      "revisit_call_seconds", "Time of unary calls until they had a status.");
  for (const ServiceCounters::Method& method : counts.methods) {
    const std::string name = method.rule->method;
    for (std::size_t code = 0; code < method.ended.size(); ++code) {
      // Codes that did not occur are left out, but for OK: an alert has to see
      // a counter before it rises.
      if (code != 0 && method.ended[code] == 0) continue;
      ended.Add(method.ended[code],
                {{"method", name}, {"code", CodeName(static_cast<int>(code))}});
    }
    open.Add(method.open, {{"method", name}});
    seconds.Add(method.seconds, {{"method", name}});
  }
  AddAll(counts.errors, "reason",
         &metrics->Counter("revisit_call_errors_total",
                           "Calls that ended with an error, by its reason."));
}

void CollectPoses(const ServiceCounters::Counts& counts, Metrics* metrics) {
  metrics
      ->Counter("revisit_poses_accepted_total",
                "New poses that were stored and acknowledged.")
      .Add(counts.poses_accepted);
  metrics
      ->Counter("revisit_poses_repeated_total",
                "Poses that came again and were acknowledged again.")
      .Add(counts.poses_repeated);
  AddAll(counts.poses_refused, "reason",
         &metrics->Counter(
             "revisit_poses_refused_total",
             "Poses of batches that were read and not stored, by reason."));
  metrics
      ->Histogram("revisit_ack_seconds",
                  "Time from reading a batch to its acknowledgement.")
      .Add(counts.ack_seconds);
}

void CollectSearches(const ServiceCounters::Counts& counts, Metrics* metrics) {
  AddAll(
      counts.searches, "outcome",
      &metrics->Counter("revisit_searches_total",
                        "Searches, by the best verdict or why there is none."));
  AddAll(counts.candidates, "verdict",
         &metrics->Counter("revisit_candidates_total",
                           "Candidates that searches found, by verdict."));
  metrics
      ->Histogram("revisit_search_seconds", "Time of searches, without waits.")
      .Add(counts.search_seconds);
  metrics
      ->Histogram("revisit_search_nodes",
                  "Nodes of the history that a search considered.")
      .Add(counts.search_nodes);
}

ServiceCounters::Labelled WithNames(
    const std::vector<const char*>& names,
    const std::vector<std::atomic<std::uint64_t>>& counts) {
  ServiceCounters::Labelled labelled;
  for (std::size_t i = 0; i < names.size(); ++i) {
    labelled.emplace_back(names[i], counts[i].load(std::memory_order_relaxed));
  }
  return labelled;
}

}  // namespace

struct ServiceCounters::MethodCounts {
  MethodCounts() : ended(std::size(kCodes)) {}

  std::atomic<std::int64_t> open{0};
  std::vector<Count> ended;
  Histogram seconds{SecondsBounds()};
};

const char* CodeName(int code) { return kCodes[CodeIndex(code)]; }

const char* OutcomeOf(const absl::StatusOr<core::CandidateSet>& set) {
  if (absl::IsCancelled(set.status())) return kStopped;
  if (absl::IsResourceExhausted(set.status())) {
    return NameOf(core::EmptyReason::kTooMuchWork);
  }
  if (!set.ok()) return kFailed;
  if (set->candidates.empty()) return NameOf(set->empty_reason);
  for (const core::Candidate& candidate : set->candidates) {
    if (candidate.verdict == core::Verdict::kAccepted) {
      return NameOf(candidate.verdict);
    }
  }
  return NameOf(set->candidates.front().verdict);
}

ServiceCounters::ServiceCounters()
    : methods_([] {
        std::vector<std::unique_ptr<MethodCounts>> methods;
        for (std::size_t i = 0; i < MethodRules().size(); ++i) {
          methods.push_back(std::make_unique<MethodCounts>());
        }
        return methods;
      }()),
      errors_(v1::ErrorReason_ARRAYSIZE),
      poses_refused_(v1::ErrorReason_ARRAYSIZE),
      searches_(Outcomes().size()),
      candidates_(CountNamed<core::Verdict>()),
      search_nodes_({100.0, 1e3, 1e4, 1e5, 1e6, 1e7}),
      decisions_(CountNamed<Decision>()) {}

ServiceCounters::~ServiceCounters() = default;

ServiceCounters::MethodCounts* ServiceCounters::Of(
    const MethodRule* rule) const {
  if (rule == nullptr) return nullptr;
  return methods_[static_cast<std::size_t>(rule - MethodRules().data())].get();
}

void ServiceCounters::Began(const MethodRule* rule) {
  if (MethodCounts* method = Of(rule)) {
    method->open.fetch_add(1, std::memory_order_relaxed);
  }
}

void ServiceCounters::Ended(const MethodRule* rule, int code,
                            const std::string& reason,
                            std::chrono::steady_clock::duration duration) {
  MethodCounts* const method = Of(rule);
  if (method == nullptr) return;
  const std::size_t index = CodeIndex(code);
  Increase(&method->ended[index]);
  if (index != 0) Increase(&errors_[ReasonIndex(reason)]);
  if (!rule->streams) method->seconds.Observe(duration);
}

void ServiceCounters::Left(const MethodRule* rule) {
  if (MethodCounts* method = Of(rule)) {
    method->open.fetch_sub(1, std::memory_order_relaxed);
  }
}

void ServiceCounters::Acknowledged(
    std::uint64_t poses, std::uint64_t accepted,
    std::chrono::steady_clock::duration duration) {
  Increase(&poses_accepted_, accepted);
  if (poses > accepted) Increase(&poses_repeated_, poses - accepted);
  ack_seconds_.Observe(duration);
}

void ServiceCounters::Refused(std::uint64_t poses, const absl::Status& status) {
  if (poses == 0) return;
  std::string reason = ReasonOf(status);
  // Errors of the store's cancelled work carry no reason of their own.
  if (reason.empty()) reason = "INTERNAL";
  Increase(&poses_refused_[ReasonIndex(reason)], poses);
}

void ServiceCounters::Searched(const absl::StatusOr<core::CandidateSet>& set,
                               std::chrono::steady_clock::duration duration) {
  Increase(&searches_[OutcomeIndex(OutcomeOf(set))]);
  // One that was stopped may not even have begun.
  if (!set.ok()) return;
  search_seconds_.Observe(duration);
  search_nodes_.Observe(static_cast<double>(set->nodes_considered));
  for (const core::Candidate& candidate : set->candidates) {
    Increase(&candidates_[static_cast<std::size_t>(candidate.verdict)]);
  }
}

void ServiceCounters::Decided(Decision decision) {
  Increase(&decisions_[static_cast<std::size_t>(decision)]);
}

ServiceCounters::Counts ServiceCounters::Read() const {
  Counts counts;
  for (std::size_t i = 0; i < methods_.size(); ++i) {
    const MethodCounts& from = *methods_[i];
    Method method{
        &MethodRules()[i], from.open.load(std::memory_order_relaxed), {}, {}};
    for (const Count& count : from.ended) {
      method.ended.push_back(count.load(std::memory_order_relaxed));
    }
    if (!method.rule->streams) method.seconds = from.seconds.Read();
    counts.methods.push_back(std::move(method));
  }
  counts.errors = WithReasons(errors_);
  counts.poses_refused = WithReasons(poses_refused_);
  counts.poses_accepted = poses_accepted_.load(std::memory_order_relaxed);
  counts.poses_repeated = poses_repeated_.load(std::memory_order_relaxed);
  counts.ack_seconds = ack_seconds_.Read();
  counts.searches = WithNames(Outcomes(), searches_);
  counts.candidates = WithNames(NamesOf<core::Verdict>(), candidates_);
  counts.search_seconds = search_seconds_.Read();
  counts.search_nodes = search_nodes_.Read();
  counts.decisions = WithNames(NamesOf<Decision>(), decisions_);
  return counts;
}

void ServiceCounters::CollectMetrics(Metrics* metrics) const {
  const Counts counts = Read();
  CollectCalls(counts, metrics);
  CollectPoses(counts, metrics);
  CollectSearches(counts, metrics);
  AddAll(counts.decisions, "decision",
         &metrics->Counter(
             "revisit_decisions_total",
             "Changes that people have decided on and that were stored."));
}

}  // namespace revisit::server
