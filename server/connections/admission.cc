#include "server/connections/admission.h"

#include <algorithm>
#include <cmath>
#include <cstdio>
#include <iterator>
#include <limits>
#include <unordered_map>
#include <utility>

#include "server/base/metrics.h"
#include "server/base/status.h"

namespace revisit::server {
namespace {

using std::chrono::milliseconds;

constexpr milliseconds kMemoryInterval{100};

// Margin of the estimated wait, because a search takes time itself: a search
// that would begin in the last third of its caller's time is refused.
constexpr double kWaitMargin = 1.5;
// Weight of the last turn of a search in the mean of their times.
constexpr double kSearchWeight = 0.1;

// Times to come again: a queue empties soon, streams end late.
constexpr milliseconds kQueueDelay{200};
constexpr milliseconds kStreamDelay{2000};
constexpr milliseconds kMemoryDelay{5000};

// Exports of one vehicle may take the room divided by this, so that those of
// others have room too.
constexpr std::int64_t kExportsOfAllAndOfOne = 4;

// Callers remembered before those are forgotten of whom nothing is known that a
// new one would not have: who has not called for long has a full bucket.
constexpr std::size_t kMostCallers = 10000;
// Longest time for which a bucket that is not full is remembered in any case.
constexpr double kMostSecondsToFull = 86400.0;

}  // namespace

// Counts how much is taken, in total and per key. A key is kept as long as
// something is taken for it. Thread-safe.
class Admission::Pool {
 public:
  enum class Outcome { kTaken, kAllTaken, kKeyTaken };

  // Keys have no limit if `most_of_key` is 0; the empty key never has one.
  Pool(std::int64_t most, std::int64_t most_of_key)
      : most_(most), most_of_key_(most_of_key) {}

  Outcome Take(const std::string& key, std::int64_t amount) {
    // Zero always finds room, and leaves no key behind.
    if (amount == 0) return Outcome::kTaken;
    const MutexLock lock(&mutex_);
    // An amount larger than the whole pool may be taken while nothing else is.
    if (taken_ > 0 && amount > most_ - taken_) return Outcome::kAllTaken;
    if (Counts(key)) {
      const auto [known, is_new] = by_key_.try_emplace(key, 0);
      if (!is_new && amount > most_of_key_ - known->second) {
        return Outcome::kKeyTaken;
      }
      known->second += amount;
    }
    taken_ += amount;
    return Outcome::kTaken;
  }

  std::int64_t taken() {
    const MutexLock lock(&mutex_);
    return taken_;
  }
  std::int64_t most() const { return most_; }

  // REQUIRES: `amount` was taken for `key`.
  void GiveBack(const std::string& key, std::int64_t amount) {
    if (amount == 0) return;
    const MutexLock lock(&mutex_);
    taken_ -= amount;
    if (!Counts(key)) return;
    const auto known = by_key_.find(key);
    known->second -= amount;
    if (known->second == 0) by_key_.erase(known);
  }

  static Permit MakePermit(const std::shared_ptr<Pool>& pool,
                           const std::string& key, std::int64_t amount) {
    return Permit(
        static_cast<const void*>(pool.get()),
        [pool, key, amount](const void*) { pool->GiveBack(key, amount); });
  }

 private:
  bool Counts(const std::string& key) const {
    return most_of_key_ > 0 && !key.empty();
  }

  const std::int64_t most_;
  const std::int64_t most_of_key_;
  Mutex mutex_;
  std::int64_t taken_ ABSL_GUARDED_BY(mutex_) = 0;
  std::unordered_map<std::string, std::int64_t> by_key_ ABSL_GUARDED_BY(mutex_);
};

// The searches that wait or run, by vehicle and by caller. Thread-safe.
class Admission::SearchRoom {
 public:
  enum class Outcome { kTaken, kAllTaken, kVehicleTaken, kShareTaken };

  // `threads`: how many searches run at a time.
  SearchRoom(std::int64_t most, std::int64_t most_of_vehicle, int threads)
      : most_(most), most_of_vehicle_(most_of_vehicle), threads_(threads) {}

  Outcome Take(const std::string& vehicle, const std::string& caller) {
    const MutexLock lock(&mutex_);
    const auto of_vehicle = by_vehicle_.find(vehicle);
    if (of_vehicle != by_vehicle_.end() &&
        of_vehicle->second >= most_of_vehicle_) {
      return Outcome::kVehicleTaken;
    }
    ForgetCallers();
    Caller& known = by_caller_[caller];
    const std::int64_t callers = CallersWith(known);
    if (taken_ >= most_ &&
        known.searches >= std::max<std::int64_t>(1, most_ / callers)) {
      return callers == 1 ? Outcome::kAllTaken : Outcome::kShareTaken;
    }
    if (known.searches++ == 0) ++callers_;
    ++by_vehicle_[vehicle];
    ++taken_;
    return Outcome::kTaken;
  }

  // REQUIRES: was taken.
  void GiveBack(const std::string& vehicle, const std::string& caller) {
    const MutexLock lock(&mutex_);
    --taken_;
    if (--by_caller_.at(caller).searches == 0) --callers_;
    const auto of_vehicle = by_vehicle_.find(vehicle);
    if (--of_vehicle->second == 0) by_vehicle_.erase(of_vehicle);
  }

  void TurnTook(const std::string& caller, Clock::duration duration) {
    const MutexLock lock(&mutex_);
    Clock::duration& mean = by_caller_[caller].mean_turn;
    mean = std::chrono::duration_cast<Clock::duration>(
        kSearchWeight * duration + (1.0 - kSearchWeight) * mean);
  }

  // How long a search of the caller's that comes now will wait, roughly.
  Clock::duration ExpectedWait(const std::string& caller) {
    const MutexLock lock(&mutex_);
    const auto found = by_caller_.find(caller);
    if (found == by_caller_.end()) return Clock::duration::zero();
    const Caller& known = found->second;
    return known.mean_turn * known.searches * CallersWith(known) / threads_;
  }

  std::int64_t taken() {
    const MutexLock lock(&mutex_);
    return taken_;
  }
  std::int64_t most() const { return most_; }

  static Permit MakePermit(const std::shared_ptr<SearchRoom>& room,
                           const std::string& vehicle,
                           const std::string& caller) {
    return Permit(static_cast<const void*>(room.get()),
                  [room, vehicle, caller](const void*) {
                    room->GiveBack(vehicle, caller);
                  });
  }

 private:
  struct Caller {
    std::int64_t searches = 0;
    // The mean over the caller's last turns, the latest weighing most.
    Clock::duration mean_turn{};
  };

  // Callers with searches, among whom the room is shared if this one comes.
  std::int64_t CallersWith(const Caller& caller) const
      ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_) {
    return callers_ + (caller.searches == 0 ? 1 : 0);
  }

  void ForgetCallers() ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_) {
    if (by_caller_.size() <= kMostCallers) return;
    for (auto i = by_caller_.begin(); i != by_caller_.end();) {
      i = i->second.searches == 0 ? by_caller_.erase(i) : std::next(i);
    }
  }

  const std::int64_t most_;
  const std::int64_t most_of_vehicle_;
  const int threads_;
  Mutex mutex_;
  std::int64_t taken_ ABSL_GUARDED_BY(mutex_) = 0;
  // Counts callers that have at least one search.
  std::int64_t callers_ ABSL_GUARDED_BY(mutex_) = 0;
  std::unordered_map<std::string, Caller> by_caller_ ABSL_GUARDED_BY(mutex_);
  std::unordered_map<std::string, std::int64_t> by_vehicle_
      ABSL_GUARDED_BY(mutex_);
};

// Thread-safe.
class Admission::Buckets {
 public:
  // Fills the caller's bucket for the time that has passed, then takes so many
  // tokens if it holds `needed`. Returns how many it lacks of these.
  double Take(const std::string& caller, double rate, double needed,
              double tokens) {
    const MutexLock lock(&mutex_);
    const auto now = Clock::now();
    // A caller may use at once what one second brings.
    const double most = std::max(1.0, rate);
    if (buckets_.size() > kMostCallers) {
      for (auto i = buckets_.begin(); i != buckets_.end();) {
        i = i->second.full <= now ? buckets_.erase(i) : std::next(i);
      }
    }
    Bucket& bucket =
        buckets_.try_emplace(caller, Bucket{most, now, now}).first->second;
    const std::chrono::duration<double> passed = now - bucket.time;
    bucket.tokens = std::min(most, bucket.tokens + passed.count() * rate);
    bucket.time = now;
    const double lacks = std::max(0.0, needed - bucket.tokens);
    if (lacks == 0.0) bucket.tokens -= tokens;
    const double seconds_to_full =
        std::min((most - bucket.tokens) / rate, kMostSecondsToFull);
    bucket.full = now + std::chrono::duration_cast<Clock::duration>(
                            std::chrono::duration<double>(seconds_to_full));
    return lacks;
  }

 private:
  struct Bucket {
    // Below zero where more was used than there was.
    double tokens;
    Clock::time_point time;
    Clock::time_point full;
  };

  Mutex mutex_;
  std::unordered_map<std::string, Bucket> buckets_ ABSL_GUARDED_BY(mutex_);
};

Admission::Admission(const Limits& limits, int search_threads,
                     MemoryMeter memory_meter)
    : limits_(limits),
      memory_meter_(std::move(memory_meter)),
      calls_(std::make_shared<Pool>(limits.max_calls,
                                    limits.max_calls_per_caller)),
      vehicle_calls_(
          std::make_shared<Pool>(std::numeric_limits<std::int64_t>::max(),
                                 limits.max_calls_per_vehicle)),
      rebuilds_(std::make_shared<Pool>(limits.max_rebuilt_poses,
                                       limits.max_rebuilt_poses_per_caller)),
      streams_(std::make_shared<Pool>(limits.max_streams,
                                      limits.max_streams_per_caller)),
      vehicle_streams_(
          std::make_shared<Pool>(std::numeric_limits<std::int64_t>::max(),
                                 limits.max_streams_per_vehicle)),
      searches_(std::make_shared<SearchRoom>(limits.max_searches,
                                             limits.max_searches_per_vehicle,
                                             search_threads)),
      queue_(std::make_shared<Pool>(limits.max_queued_bytes,
                                    limits.max_queued_bytes_per_vehicle)),
      // A revision comes in pieces, so the pool cannot see whether it is alone.
      drafts_(std::make_shared<Pool>(
          std::max(limits.max_draft_bytes, limits.max_revision_bytes),
          limits.max_revision_bytes)),
      exports_(std::make_shared<Pool>(
          limits.max_export_bytes,
          limits.max_export_bytes / kExportsOfAllAndOfOne)),
      search_rates_(std::make_unique<Buckets>()),
      step_rates_(std::make_unique<Buckets>()),
      random_(std::random_device{}()) {}

Admission::~Admission() = default;

absl::StatusOr<Permit> Admission::Call(const std::string& caller) {
  if (absl::Status status = CheckMemory(); !status.ok()) return status;
  switch (calls_->Take(caller, 1)) {
    case Pool::Outcome::kTaken:
      break;
    case Pool::Outcome::kAllTaken:
      return Overloaded("max-calls", "calls", "calls that wait or run",
                        limits_.max_calls);
    case Pool::Outcome::kKeyTaken:
      return OverQuota("max-calls-per-caller", "QUEUE_FULL", "caller",
                       "calls that wait or run", limits_.max_calls_per_caller);
  }
  return Pool::MakePermit(calls_, caller, 1);
}

absl::StatusOr<Permit> Admission::CallOf(const std::string& vehicle) {
  return CallAt("vehicles/" + vehicle);
}

absl::StatusOr<Permit> Admission::CallOfGroup(const std::string& group) {
  return CallAt("groups/" + group);
}

absl::StatusOr<Permit> Admission::CallAt(const std::string& name) {
  if (vehicle_calls_->Take(name, 1) != Pool::Outcome::kTaken) {
    return OverQuota("max-calls-per-vehicle", "QUEUE_FULL", name,
                     "calls that wait or run", limits_.max_calls_per_vehicle);
  }
  return Pool::MakePermit(vehicle_calls_, name, 1);
}

absl::StatusOr<Permit> Admission::Rebuild(const std::string& caller,
                                          std::int64_t poses) {
  // A vehicle with more poses than a caller may have at a time takes that
  // caller's room, and leaves the others theirs.
  poses = std::min(poses, limits_.max_rebuilt_poses);
  if (limits_.max_rebuilt_poses_per_caller > 0) {
    poses = std::min(poses, limits_.max_rebuilt_poses_per_caller);
  }
  const char* const what = "poses of vehicles whose graphs are made anew";
  switch (rebuilds_->Take(caller, poses)) {
    case Pool::Outcome::kTaken:
      break;
    case Pool::Outcome::kAllTaken:
      return Overloaded("max-rebuilt-poses", "calls", what,
                        limits_.max_rebuilt_poses);
    case Pool::Outcome::kKeyTaken:
      return OverQuota("max-rebuilt-poses-per-caller", "QUEUE_FULL", "caller",
                       what, limits_.max_rebuilt_poses_per_caller);
  }
  return Pool::MakePermit(rebuilds_, caller, poses);
}

absl::StatusOr<Permit> Admission::Stream(const std::string& caller) {
  if (absl::Status status = CheckMemory(); !status.ok()) return status;
  switch (streams_->Take(caller, 1)) {
    case Pool::Outcome::kTaken:
      break;
    case Pool::Outcome::kAllTaken:
      return Overloaded("max-streams", "streams", "streams at a time",
                        limits_.max_streams);
    case Pool::Outcome::kKeyTaken:
      return OverQuota("max-streams-per-caller", "STREAM_QUOTA", "caller",
                       "streams at a time", limits_.max_streams_per_caller);
  }
  return Pool::MakePermit(streams_, caller, 1);
}

absl::StatusOr<Permit> Admission::StreamOf(const std::string& vehicle) {
  if (vehicle_streams_->Take(vehicle, 1) != Pool::Outcome::kTaken) {
    return OverQuota("max-streams-per-vehicle", "STREAM_QUOTA",
                     "vehicles/" + vehicle, "streams at a time",
                     limits_.max_streams_per_vehicle);
  }
  return Pool::MakePermit(vehicle_streams_, vehicle, 1);
}

absl::StatusOr<Permit> Admission::Search(const std::string& vehicle,
                                         const std::string& caller,
                                         Clock::duration remaining) {
  if (std::chrono::duration<double>(searches_->ExpectedWait(caller)).count() *
          kWaitMargin >
      std::chrono::duration<double>(remaining).count()) {
    refusals_.Count("caller-deadline");
    return QuotaExceeded(
        absl::StatusCode::kUnavailable, "OVERLOADED", "searches",
        "so many searches wait that this one would not be answered within the "
        "caller's deadline",
        Later(kQueueDelay));
  }
  switch (searches_->Take(vehicle, caller)) {
    case SearchRoom::Outcome::kTaken:
      break;
    case SearchRoom::Outcome::kAllTaken:
      return Overloaded("max-searches", "searches", "searches that wait or run",
                        limits_.max_searches);
    case SearchRoom::Outcome::kVehicleTaken:
      return OverQuota("max-searches-per-vehicle", "SEARCH_QUOTA",
                       "vehicles/" + vehicle, "searches that wait or run",
                       limits_.max_searches_per_vehicle);
    case SearchRoom::Outcome::kShareTaken:
      return OverQuota("max-searches-share", "SEARCH_QUOTA", "caller",
                       "searches that wait or run, which callers share,",
                       limits_.max_searches);
  }
  Permit permit = SearchRoom::MakePermit(searches_, vehicle, caller);
  if (absl::Status status = CheckRate(caller); !status.ok()) return status;
  return permit;
}

absl::StatusOr<Permit> Admission::Queue(const std::string& vehicle,
                                        std::int64_t bytes) {
  if (absl::Status status = CheckMemory(); !status.ok()) return status;
  switch (queue_->Take(vehicle, bytes)) {
    case Pool::Outcome::kTaken:
      break;
    case Pool::Outcome::kAllTaken:
      return Overloaded("max-queued-bytes", "queued_bytes",
                        "bytes that wait to be durable",
                        limits_.max_queued_bytes);
    case Pool::Outcome::kKeyTaken:
      return OverQuota("max-queued-bytes-per-vehicle", "QUEUE_FULL",
                       "vehicles/" + vehicle, "bytes that wait to be durable",
                       limits_.max_queued_bytes_per_vehicle);
  }
  return Pool::MakePermit(queue_, vehicle, bytes);
}

absl::StatusOr<Permit> Admission::Draft(const std::string& vehicle,
                                        std::int64_t bytes) {
  switch (drafts_->Take(vehicle, bytes)) {
    case Pool::Outcome::kTaken:
      break;
    case Pool::Outcome::kAllTaken:
      return Overloaded("max-draft-bytes", "streams",
                        "bytes of revisions that are being sent",
                        limits_.max_draft_bytes);
    case Pool::Outcome::kKeyTaken:
      return OverQuota(
          "max-revision-bytes", "QUEUE_FULL", "vehicles/" + vehicle,
          "bytes of revisions that are being sent", limits_.max_revision_bytes);
  }
  return Pool::MakePermit(drafts_, vehicle, bytes);
}

absl::StatusOr<Permit> Admission::Export(const std::string& vehicle,
                                         std::int64_t bytes) {
  if (absl::Status status = CheckMemory(); !status.ok()) return status;
  switch (exports_->Take(vehicle, bytes)) {
    case Pool::Outcome::kTaken:
      break;
    case Pool::Outcome::kAllTaken:
      return Overloaded("max-export-bytes", "streams",
                        "bytes of graphs that are being exported",
                        limits_.max_export_bytes);
    case Pool::Outcome::kKeyTaken:
      return OverQuota("max-export-bytes", "STREAM_QUOTA",
                       "vehicles/" + vehicle,
                       "bytes of its graph that are being exported",
                       limits_.max_export_bytes / kExportsOfAllAndOfOne);
  }
  return Pool::MakePermit(exports_, vehicle, bytes);
}

bool Admission::UnderMemoryPressure() {
  if (limits_.max_memory_bytes == 0) return false;
  const MutexLock lock(&mutex_);
  const auto now = Clock::now();
  if (now - last_measured_ >= kMemoryInterval) {
    last_measured_ = now;
    memory_bytes_ = memory_meter_();
  }
  return memory_bytes_ >= limits_.max_memory_bytes;
}

std::vector<Admission::Use> Admission::uses() const {
  const auto use_of = [](const char* limit, const auto& pool) {
    return Use{limit, pool->taken(), pool->most()};
  };
  return {use_of("max-calls", calls_),
          use_of("max-draft-bytes", drafts_),
          use_of("max-export-bytes", exports_),
          use_of("max-queued-bytes", queue_),
          use_of("max-rebuilt-poses", rebuilds_),
          use_of("max-searches", searches_),
          use_of("max-streams", streams_)};
}

void Admission::SearchTook(const std::string& caller,
                           Clock::duration duration) {
  searches_->TurnTook(caller, duration);
}

absl::Status Admission::CheckSteps(const std::string& caller,
                                   double steps_per_second) {
  // One step at least, so that debts are paid first.
  const double missing =
      step_rates_->Take(caller, steps_per_second, /*needed=*/1.0, 0.0);
  if (missing == 0.0) return absl::OkStatus();
  return OverRate("max-search-steps-per-second", "steps of searches",
                  steps_per_second, missing);
}

void Admission::UseSteps(const std::string& caller, double steps_per_second,
                         std::int64_t steps) {
  step_rates_->Take(caller, steps_per_second,
                    -std::numeric_limits<double>::infinity(),
                    static_cast<double>(steps));
}

absl::Status Admission::TooManySteps(const std::string& vehicle) {
  return OverQuota("max-search-steps", "SEARCH_QUOTA", "vehicles/" + vehicle,
                   "pairs of nodes that one search compares for marks of the "
                   "drive, which are kept for the next",
                   limits_.max_search_steps);
}

absl::Status Admission::CheckMemory() {
  if (!UnderMemoryPressure()) return absl::OkStatus();
  refusals_.Count("max-memory-bytes");
  const std::string limit = std::to_string(limits_.max_memory_bytes);
  return QuotaExceeded(absl::StatusCode::kResourceExhausted, "MEMORY_PRESSURE",
                       "server",
                       "the server has reached its limit of memory, " + limit +
                           " bytes; try again later",
                       Later(kMemoryDelay), {{"limit", limit}});
}

absl::Status Admission::CheckRate(const std::string& caller) {
  const double rate = limits_.max_search_rate_per_caller;
  if (rate <= 0.0 || caller.empty()) return absl::OkStatus();
  const double missing = search_rates_->Take(caller, rate, 1.0, 1.0);
  if (missing == 0.0) return absl::OkStatus();
  return OverRate("max-search-rate-per-caller", "searches", rate, missing);
}

absl::Status Admission::OverRate(const char* name, const char* what,
                                 double rate, double missing) {
  refusals_.Count(name);
  char limit[32];
  std::snprintf(limit, sizeof(limit), "%g", rate);
  const milliseconds wait(static_cast<std::int64_t>(
      std::ceil(std::min(missing / rate, 3600.0) * 1000.0)));
  return QuotaExceeded(absl::StatusCode::kResourceExhausted, "SEARCH_QUOTA",
                       "caller",
                       std::string("caller: the limit of ") + what +
                           " a second is reached, " + limit,
                       wait + Later(kQueueDelay), {{"limit", limit}});
}

milliseconds Admission::Later(milliseconds order) {
  const MutexLock lock(&mutex_);
  return milliseconds(std::uniform_int_distribution<std::int64_t>(
      order.count() / 2, order.count() * 3 / 2)(random_));
}

absl::Status Admission::Overloaded(const char* name, const char* subject,
                                   const char* what, std::int64_t limit) {
  refusals_.Count(name);
  const std::string text = std::to_string(limit);
  return QuotaExceeded(
      absl::StatusCode::kUnavailable, "OVERLOADED", subject,
      "the server's limit of " + std::string(what) + " is reached, " + text,
      Later(std::string(subject) == "streams" ? kStreamDelay : kQueueDelay),
      {{"limit", text}});
}

absl::Status Admission::OverQuota(const char* name, const char* reason,
                                  const std::string& subject, const char* what,
                                  std::int64_t limit) {
  refusals_.Count(name);
  const std::string text = std::to_string(limit);
  const bool streams = std::string(reason) == "STREAM_QUOTA";
  return QuotaExceeded(
      absl::StatusCode::kResourceExhausted, reason, subject,
      subject + ": the limit of " + what + " is reached, " + text,
      Later(streams ? kStreamDelay : kQueueDelay), {{"limit", text}});
}

void Admission::CollectMetrics(Metrics* metrics) const {
  refusals_.CollectMetrics(metrics);
  MetricFamily& used = metrics->Gauge(
      "revisit_limit_used_ratio",
      "Share of a limit of the whole server that is taken; 1 is all of it.");
  for (const Use& use : uses()) {
    used.Add(static_cast<double>(use.taken) / static_cast<double>(use.most),
             {{"limit", use.limit}});
  }
  metrics
      ->Gauge("revisit_queued_bytes",
              "Bytes of batches that wait to be durable.")
      .Add(queue_->taken());
}

}  // namespace revisit::server
