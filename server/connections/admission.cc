#include "server/connections/admission.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <utility>

#include "server/base/status.h"

namespace revisit::server {
namespace {

using std::chrono::milliseconds;

constexpr milliseconds kMemoryInterval{100};

// Margin of the estimated wait, because a search takes time itself: a search
// that would begin in the last third of its caller's time is refused.
constexpr double kWaitMargin = 1.5;
// Weight of the last search in the mean of their times.
constexpr double kSearchWeight = 0.1;

// Times to come again: a queue empties soon, streams end late.
constexpr milliseconds kQueueDelay{200};
constexpr milliseconds kStreamDelay{2000};
constexpr milliseconds kMemoryDelay{5000};

// Exports of one vehicle may take the room divided by this, so that those of
// others have room too.
constexpr std::int64_t kExportsOfAllAndOfOne = 4;

// Buckets kept before full ones are forgotten: a caller that has not called for
// long has a full bucket.
constexpr std::size_t kMostBuckets = 10000;

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

Admission::Admission(const Limits& limits, int search_threads,
                     MemoryMeter memory_meter)
    : limits_(limits),
      search_threads_(search_threads),
      memory_meter_(std::move(memory_meter)),
      calls_(std::make_shared<Pool>(limits.max_calls, 0)),
      streams_(std::make_shared<Pool>(limits.max_streams,
                                      limits.max_streams_per_caller)),
      vehicle_streams_(
          std::make_shared<Pool>(std::numeric_limits<std::int64_t>::max(),
                                 limits.max_streams_per_vehicle)),
      searches_(std::make_shared<Pool>(limits.max_searches,
                                       limits.max_searches_per_vehicle)),
      queue_(std::make_shared<Pool>(limits.max_queued_bytes,
                                    limits.max_queued_bytes_per_vehicle)),
      // A revision comes in pieces, so the pool cannot see whether it is alone.
      drafts_(std::make_shared<Pool>(
          std::max(limits.max_draft_bytes, limits.max_revision_bytes),
          limits.max_revision_bytes)),
      exports_(std::make_shared<Pool>(
          limits.max_export_bytes,
          limits.max_export_bytes / kExportsOfAllAndOfOne)),
      random_(std::random_device{}()) {}

Admission::~Admission() = default;

absl::StatusOr<Permit> Admission::Call() {
  if (absl::Status status = CheckMemory(); !status.ok()) return status;
  if (calls_->Take("", 1) != Pool::Outcome::kTaken) {
    return Overloaded("max-calls", "calls", "calls that wait or run",
                      limits_.max_calls);
  }
  return Pool::MakePermit(calls_, "", 1);
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
  if (std::chrono::duration<double>(ExpectedWait()).count() * kWaitMargin >
      std::chrono::duration<double>(remaining).count()) {
    refusals_.Count("caller-deadline");
    return QuotaExceeded(
        absl::StatusCode::kUnavailable, "OVERLOADED", "searches",
        "so many searches wait that this one would not be answered within the "
        "caller's deadline",
        Later(kQueueDelay));
  }
  switch (searches_->Take(vehicle, 1)) {
    case Pool::Outcome::kTaken:
      break;
    case Pool::Outcome::kAllTaken:
      return Overloaded("max-searches", "searches", "searches that wait or run",
                        limits_.max_searches);
    case Pool::Outcome::kKeyTaken:
      return OverQuota("max-searches-per-vehicle", "SEARCH_QUOTA",
                       "vehicles/" + vehicle, "searches that wait or run",
                       limits_.max_searches_per_vehicle);
  }
  Permit permit = Pool::MakePermit(searches_, vehicle, 1);
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
  std::vector<Use> uses;
  for (const auto& [limit, pool] :
       {std::pair("max-calls", &calls_), std::pair("max-draft-bytes", &drafts_),
        std::pair("max-export-bytes", &exports_),
        std::pair("max-queued-bytes", &queue_),
        std::pair("max-searches", &searches_),
        std::pair("max-streams", &streams_)}) {
    uses.push_back({limit, (*pool)->taken(), (*pool)->most()});
  }
  return uses;
}

void Admission::SearchTook(Clock::duration duration) {
  const MutexLock lock(&mutex_);
  mean_search_ = std::chrono::duration_cast<Clock::duration>(
      kSearchWeight * duration + (1.0 - kSearchWeight) * mean_search_);
}

Admission::Clock::duration Admission::ExpectedWait() {
  const std::int64_t ahead = searches_->taken();
  const MutexLock lock(&mutex_);
  return mean_search_ * ahead / search_threads_;
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
  double missing;
  {
    const MutexLock lock(&mutex_);
    const auto now = Clock::now();
    // The searches of one second may come at once.
    const double most = std::max(1.0, rate);
    const auto tokens_of = [&](const Bucket& bucket) {
      const std::chrono::duration<double> passed = now - bucket.time;
      return std::min(most, bucket.tokens + passed.count() * rate);
    };
    if (buckets_.size() > kMostBuckets) {
      for (auto i = buckets_.begin(); i != buckets_.end();) {
        i = tokens_of(i->second) >= most ? buckets_.erase(i) : std::next(i);
      }
    }
    Bucket& bucket =
        buckets_.try_emplace(caller, Bucket{most, now}).first->second;
    bucket = {tokens_of(bucket), now};
    if (bucket.tokens >= 1.0) {
      bucket.tokens -= 1.0;
      return absl::OkStatus();
    }
    missing = 1.0 - bucket.tokens;
  }
  refusals_.Count("max-search-rate-per-caller");
  char limit[32];
  std::snprintf(limit, sizeof(limit), "%g", rate);
  const milliseconds wait(static_cast<std::int64_t>(
      std::ceil(std::min(missing / rate, 3600.0) * 1000.0)));
  return QuotaExceeded(absl::StatusCode::kResourceExhausted, "SEARCH_QUOTA",
                       "caller",
                       std::string("caller: the limit of searches a second is "
                                   "reached, ") +
                           limit,
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

}  // namespace revisit::server
