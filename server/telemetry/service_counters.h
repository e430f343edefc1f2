// Counts what the calls of the API do, as they do it: how many, how they
// ended, how long they took, how many poses and searches. Labels come from
// fixed sets, so that the number of counters does not grow with use. A new
// count is told in CollectMetrics(), and counted by service/call_record.cc
// where it is about a call, otherwise by the handler.
#ifndef REVISIT_SERVER_TELEMETRY_SERVICE_COUNTERS_H_
#define REVISIT_SERVER_TELEMETRY_SERVICE_COUNTERS_H_

#include <atomic>
#include <chrono>
#include <cstddef>
#include <cstdint>
#include <memory>
#include <string>
#include <utility>
#include <vector>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "core/search/candidates/candidate.h"
#include "server/base/histogram.h"
#include "server/security/method_rules.h"

namespace revisit::server {

class Metrics;

// Name of a code as gRPC writes it, such as "NOT_FOUND"; "UNKNOWN" for a number
// that is no code.
const char* CodeName(int code);

// How a search ended, in one word: the verdict of an accepted candidate, or
// else of the best ("rejected_by_gate"), or else why there is none
// ("no_history"); "stopped" where its caller gave up, "failed" for any other
// error.
const char* OutcomeOf(const absl::StatusOr<core::CandidateSet>& set);

// A decision about a vehicle by people, or by programs for them. Numbered from
// 0 without gaps.
enum class Decision {
  kLoopClosureAdded,
  kLoopClosureDeleted,
  kCandidateRejected,
  kRejectionDeleted,
  kPosesRevised,
  kDataLossAccepted
};

// Thread-safe, without locks. Values are counted since the start.
class ServiceCounters {
 public:
  ServiceCounters();
  ~ServiceCounters();

  ServiceCounters(const ServiceCounters&) = delete;
  ServiceCounters& operator=(const ServiceCounters&) = delete;

  // `rule` is a row of MethodRules(); null counts nothing.
  void Began(const MethodRule* rule);
  // The call has its status, of which `reason` is that of its ErrorInfo, empty
  // if it has none. Unary calls are timed.
  void Ended(const MethodRule* rule, int code, const std::string& reason,
             std::chrono::steady_clock::duration duration);
  // gRPC has forgotten the call.
  void Left(const MethodRule* rule);

  // A batch of `poses` is durable, of which `accepted` are new and the others
  // were stored before; the acknowledgement came so long after the batch.
  void Acknowledged(std::uint64_t poses, std::uint64_t accepted,
                    std::chrono::steady_clock::duration duration);
  // A batch of so many poses was not taken.
  void Refused(std::uint64_t poses, const absl::Status& status);

  void Searched(const absl::StatusOr<core::CandidateSet>& set,
                std::chrono::steady_clock::duration duration);

  // The store has changed by it: one that was repeated does not count again.
  void Decided(Decision decision);

  struct Method {
    const MethodRule* rule;
    std::int64_t open;
    // By code, which is the index.
    std::vector<std::uint64_t> ended;
    // Empty for streams.
    HistogramCounts seconds;
  };
  using Labelled = std::vector<std::pair<std::string, std::uint64_t>>;
  struct Counts {
    std::vector<Method> methods;
    // By reason, each of them.
    Labelled errors;
    Labelled poses_refused;
    std::uint64_t poses_accepted;
    std::uint64_t poses_repeated;
    HistogramCounts ack_seconds;
    Labelled searches;
    Labelled candidates;
    HistogramCounts search_seconds;
    HistogramCounts search_nodes;
    Labelled decisions;
  };
  Counts Read() const;

  void CollectMetrics(Metrics* metrics) const;

 private:
  using Count = std::atomic<std::uint64_t>;
  struct MethodCounts;

  MethodCounts* Of(const MethodRule* rule) const;

  const std::vector<std::unique_ptr<MethodCounts>> methods_;
  // By number of ErrorReason; those without one count as the first.
  std::vector<Count> errors_;
  std::vector<Count> poses_refused_;
  Count poses_accepted_{0};
  Count poses_repeated_{0};
  Histogram ack_seconds_{SecondsBounds()};
  std::vector<Count> searches_;
  std::vector<Count> candidates_;
  Histogram search_seconds_{SecondsBounds()};
  Histogram search_nodes_;
  std::vector<Count> decisions_;
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_TELEMETRY_SERVICE_COUNTERS_H_
