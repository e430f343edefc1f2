// Decides whether there is room for one more call, stream, search or batch of a
// caller or vehicle; what bounds connections: connection_acceptor.h. Work
// without room is refused at once, before it costs anything, with a time to
// come again: so that under overload the server goes on doing as much as it
// can.
#ifndef REVISIT_SERVER_CONNECTIONS_ADMISSION_H_
#define REVISIT_SERVER_CONNECTIONS_ADMISSION_H_

#include <chrono>
#include <cstdint>
#include <functional>
#include <memory>
#include <random>
#include <string>
#include <vector>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "core/base/mutex.h"
#include "server/connections/refusals.h"
#include "server/settings/limits.h"

namespace revisit::server {

// Room that was taken; it is given back when the last copy is destroyed.
using Permit = std::shared_ptr<const void>;

// Refusals name the limit that was reached, and carry QuotaFailure and a
// RetryInfo that differs from caller to caller. At a limit of the server as a
// whole they are UNAVAILABLE (OVERLOADED), at one of a caller or a vehicle
// RESOURCE_EXHAUSTED; where memory runs out, RESOURCE_EXHAUSTED
// (MEMORY_PRESSURE).
//
// Permits may outlive this. Thread-safe.
class Admission {
 public:
  using Clock = std::chrono::steady_clock;
  // Resident memory of the process, in bytes.
  using MemoryMeter = std::function<std::int64_t()>;

  // `search_threads`: how many searches may run at the same time.
  Admission(const Limits& limits, int search_threads, MemoryMeter memory_meter);
  ~Admission();

  Admission(const Admission&) = delete;
  Admission& operator=(const Admission&) = delete;

  // Room for a unary call: OVERLOADED, or QUEUE_FULL of the caller. With an
  // empty `caller`, no caller's limit counts.
  absl::StatusOr<Permit> Call(const std::string& caller);
  // Room for that call at a vehicle, once it is known which one it is about:
  // QUEUE_FULL.
  absl::StatusOr<Permit> CallOf(const std::string& vehicle);
  // The same at a group, which may have as many as a vehicle.
  absl::StatusOr<Permit> CallOfGroup(const std::string& group);
  // Room for a call, beside its other permits, to make the graph of a vehicle
  // with so many poses anew: OVERLOADED, or QUEUE_FULL of the caller.
  absl::StatusOr<Permit> Rebuild(const std::string& caller, std::int64_t poses);
  // Room for a streaming call, as it begins: OVERLOADED, or STREAM_QUOTA of the
  // caller. With an empty `caller`, no caller's limit counts.
  absl::StatusOr<Permit> Stream(const std::string& caller);
  // Room for that stream at a vehicle, once it is known which one it is about:
  // STREAM_QUOTA.
  absl::StatusOr<Permit> StreamOf(const std::string& vehicle);
  // Room for a search, beside the permit of its call. Callers share it: when
  // all is taken, one that has less than its share, which is as large as
  // everybody's who has searches, gets room nevertheless. OVERLOADED if the
  // caller has taken all by itself, or so many of its searches wait that this
  // one would not be answered in the `remaining` time; SEARCH_QUOTA of the
  // vehicle, of the caller's share, or of its rate.
  absl::StatusOr<Permit> Search(const std::string& vehicle,
                                const std::string& caller,
                                Clock::duration remaining);
  // Notes how long a turn of an admitted search took: a search that comes waits
  // for one of each of the caller's before it, while other callers have as much
  // of the threads.
  void SearchTook(const std::string& caller, Clock::duration duration);
  // Whether the caller has not used up its budget of steps of searches: its
  // searches may use those of one second at once, and the last one more than is
  // left, for which the caller then waits. SEARCH_QUOTA of the caller.
  // REQUIRES: steps_per_second > 0.
  absl::Status CheckSteps(const std::string& caller, double steps_per_second);
  void UseSteps(const std::string& caller, double steps_per_second,
                std::int64_t steps);
  // The refusal of an admitted search that has more to search first than one
  // may: SEARCH_QUOTA of the vehicle.
  absl::Status TooManySteps(const std::string& vehicle);
  // Room for the bytes of a batch that waits to be durable: OVERLOADED, or
  // QUEUE_FULL of the vehicle.
  absl::StatusOr<Permit> Queue(const std::string& vehicle, std::int64_t bytes);
  // Room for the bytes of a revision that is being sent: OVERLOADED, or
  // QUEUE_FULL of the vehicle.
  absl::StatusOr<Permit> Draft(const std::string& vehicle, std::int64_t bytes);
  // Room for the bytes of a graph that is being exported: OVERLOADED, or
  // STREAM_QUOTA of the vehicle.
  absl::StatusOr<Permit> Export(const std::string& vehicle, std::int64_t bytes);

  // Whether the memory limit is reached, as last measured.
  bool UnderMemoryPressure();

  // How often each limit has refused.
  const Refusals& refusals() const { return refusals_; }

  // How much is taken of a limit of the server as a whole.
  struct Use {
    // As in kLimitNames.
    const char* limit;
    std::int64_t taken;
    std::int64_t most;
  };
  std::vector<Use> uses() const;

  void CollectMetrics(Metrics* metrics) const;

 private:
  class Pool;
  class SearchRoom;
  // A bucket of tokens for each caller, which holds how much the caller may use
  // at once of something that it has at a rate.
  class Buckets;

  absl::Status CheckMemory();
  absl::Status CheckRate(const std::string& caller);
  // Room for a call at a vehicle or a group of this name.
  absl::StatusOr<Permit> CallAt(const std::string& name);
  // The refusal of a caller whose bucket has `missing` tokens too little.
  absl::Status OverRate(const char* name, const char* what, double rate,
                        double missing);
  // A random time to come again, of this order.
  std::chrono::milliseconds Later(std::chrono::milliseconds order)
      ABSL_LOCKS_EXCLUDED(mutex_);
  // `name`: of the limit that was reached (kLimitNames).
  absl::Status Overloaded(const char* name, const char* subject,
                          const char* what, std::int64_t limit);
  absl::Status OverQuota(const char* name, const char* reason,
                         const std::string& subject, const char* what,
                         std::int64_t limit);

  const Limits limits_;
  const MemoryMeter memory_meter_;
  const std::shared_ptr<Pool> calls_;
  const std::shared_ptr<Pool> vehicle_calls_;
  const std::shared_ptr<Pool> rebuilds_;
  const std::shared_ptr<Pool> streams_;
  const std::shared_ptr<Pool> vehicle_streams_;
  const std::shared_ptr<SearchRoom> searches_;
  const std::shared_ptr<Pool> queue_;
  const std::shared_ptr<Pool> drafts_;
  const std::shared_ptr<Pool> exports_;
  const std::unique_ptr<Buckets> search_rates_;
  const std::unique_ptr<Buckets> step_rates_;
  Refusals refusals_;

  Mutex mutex_;
  std::mt19937 random_ ABSL_GUARDED_BY(mutex_);
  Clock::time_point last_measured_ ABSL_GUARDED_BY(mutex_){};
  std::int64_t memory_bytes_ ABSL_GUARDED_BY(mutex_) = 0;
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_CONNECTIONS_ADMISSION_H_
