// Tells operators what retention (pose_dropper.h) does to the vehicles of a
// fleet.
#ifndef REVISIT_SERVER_SESSIONS_RETENTION_MONITOR_H_
#define REVISIT_SERVER_SESSIONS_RETENTION_MONITOR_H_

#include <atomic>
#include <chrono>
#include <cstdint>
#include <functional>
#include <string>
#include <utility>

#include "absl/status/status.h"
#include "server/base/histogram.h"

namespace revisit::server {

class Metrics;

// Thread-safe, without locks.
class RetentionMonitor {
 public:
  // Poses that left one vehicle, at one time.
  struct Drop {
    std::string vehicle_id;
    std::uint64_t poses = 0;
    // The first pose that the vehicle still has.
    std::uint64_t first_kept_sequence = 0;
    // Nodes that were to go, by the rule: max_age, and max_passes.
    std::int64_t nodes_too_old = 0;
    std::int64_t nodes_covered = 0;
    // How long the vehicle's appends waited for it.
    std::chrono::steady_clock::duration duration{0};
  };
  struct Counts {
    std::uint64_t poses = 0;
    std::uint64_t nodes_too_old = 0;
    std::uint64_t nodes_covered = 0;
    // Vehicles that are looked at now, or are losing poses.
    std::int64_t vehicles = 0;
    // How long the drops took; its count is how many there were.
    HistogramCounts seconds;
  };

  // What is called on the vehicle's strand; each may be empty.
  struct Reports {
    std::function<void(const Drop&)> drop;
    // Nothing was dropped of a vehicle, since nobody knows which of its poses
    // loop closures of groups need.
    std::function<void(const std::string& vehicle_id, const absl::Status&)>
        withheld;
  };

  explicit RetentionMonitor(Reports reports) : reports_(std::move(reports)) {}

  void Began() { ++vehicles_; }
  void Ended() { --vehicles_; }
  void Dropped(const Drop& drop) {
    poses_ += drop.poses;
    nodes_too_old_ += static_cast<std::uint64_t>(drop.nodes_too_old);
    nodes_covered_ += static_cast<std::uint64_t>(drop.nodes_covered);
    seconds_.Observe(drop.duration);
    if (reports_.drop) reports_.drop(drop);
  }
  void Withheld(const std::string& vehicle_id,
                const absl::Status& status) const {
    if (reports_.withheld) reports_.withheld(vehicle_id, status);
  }

  Counts Read() const {
    return {poses_, nodes_too_old_, nodes_covered_, vehicles_, seconds_.Read()};
  }

  void CollectMetrics(Metrics* metrics) const;

 private:
  const Reports reports_;
  std::atomic<std::uint64_t> poses_{0};
  std::atomic<std::uint64_t> nodes_too_old_{0};
  std::atomic<std::uint64_t> nodes_covered_{0};
  std::atomic<std::int64_t> vehicles_{0};
  Histogram seconds_{SecondsBounds()};
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_SESSIONS_RETENTION_MONITOR_H_
