// How many vehicles the store has, by state: also of those that are not in
// memory. Their rows are read once after the start, some at a time, and what
// this server does to vehicles is added.
#ifndef REVISIT_SERVER_SESSIONS_VEHICLE_CENSUS_H_
#define REVISIT_SERVER_SESSIONS_VEHICLE_CENSUS_H_

#include <chrono>
#include <cstdint>
#include <map>
#include <optional>
#include <vector>

#include "core/base/mutex.h"
#include "server/sessions/record_codec.h"
#include "server/storage/records.h"

namespace revisit::server {

class Metrics;
class Storage;

// Thread-safe, but for Continue().
class VehicleCensus {
 public:
  // A vehicle that is both in data loss and damaged is damaged.
  enum class State { kActive, kDataLoss, kDamaged };

  struct Counts {
    std::int64_t active = 0;
    std::int64_t data_loss = 0;
    std::int64_t damaged = 0;
  };

  // Storage and codec must outlive the calls of Continue(). Where other servers
  // change vehicles too, all rows are read again `again_after` they were;
  // nothing where one server has the storage alone.
  VehicleCensus(Storage* storage, const RecordCodec* codec,
                std::optional<std::chrono::milliseconds> again_after);

  // Reads rows, if any are to be read, for some 50 ms at most. A timer of the
  // server calls it, from one thread. Where the storage cannot be read, the
  // next call goes on from there.
  void Continue();

  // Nothing until all rows were read once. With other servers, their changes
  // show once all rows were read again.
  std::optional<Counts> Read() const;

  // Tells the counts of Read(), if there are any.
  void CollectMetrics(Metrics* metrics) const;

  // A vehicle was created; was loaded, or has another state; was deleted.
  void Created(VehicleKey key);
  void Found(VehicleKey key, State state);
  void Deleted(VehicleKey key);

 private:
  using Clock = std::chrono::steady_clock;

  void Begin();
  void Take(const std::vector<VehicleRecord>& rows);
  void Finish();
  State StateOf(const VehicleRecord& row) const;
  void SetState(VehicleKey key, State state)
      ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_);

  Storage* const storage_;
  const RecordCodec* const codec_;
  const std::optional<std::chrono::milliseconds> again_after_;

  // Continue() alone uses these: the keys of the rows so far, ascending, and
  // the states of those that are not active.
  bool is_reading_ = false;
  std::vector<VehicleKey> keys_;
  std::map<VehicleKey, State> states_read_;
  std::optional<Clock::time_point> finished_;

  mutable Mutex mutex_;
  // The last key of the rows that were counted.
  std::optional<VehicleKey> counted_to_ ABSL_GUARDED_BY(mutex_);
  std::int64_t count_ ABSL_GUARDED_BY(mutex_) = 0;
  // The states of vehicles that are not active.
  std::map<VehicleKey, State> states_ ABSL_GUARDED_BY(mutex_);
  // Changes that have come while rows are being read; a deleted vehicle has no
  // state.
  bool keeps_news_ ABSL_GUARDED_BY(mutex_) = false;
  std::map<VehicleKey, std::optional<State>> news_ ABSL_GUARDED_BY(mutex_);
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_SESSIONS_VEHICLE_CENSUS_H_
