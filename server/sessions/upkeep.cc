#include "server/sessions/upkeep.h"

#include <algorithm>
#include <chrono>
#include <utility>

#include "server/base/process_memory.h"

namespace revisit::server {
namespace {

using Clock = std::chrono::steady_clock;

// How often memory is measured if no call does so.
constexpr std::chrono::milliseconds kMemoryPeriod{500};
// How often freed memory is given back to the system. Much of it is at once.
constexpr std::chrono::milliseconds kTrimPeriod{2000};
// A busy storage writes a part of a snapshot, about a megabyte, that often.
constexpr std::chrono::milliseconds kSnapshotPeriod{500};
// How often rows of vehicles are read to count them.
constexpr std::chrono::milliseconds kCensusPeriod{1000};
// How often vehicles are looked for that owe checks although no server has them
// in memory, and events that are kept no longer.
constexpr std::chrono::milliseconds kChecksPeriod{5000};

// How often vehicles are unloaded. A vehicle stays at most a tenth longer than
// promised, and memory at most a second above the budget.
std::chrono::milliseconds UnloadPeriod(const Fleet::Options& options) {
  return std::clamp<std::chrono::milliseconds>(
      options.idle_unload / 10, std::chrono::milliseconds(100),
      std::chrono::seconds(options.memory_budget_bytes ? 1 : 30));
}

// For one thread.
class Unloading {
 public:
  Unloading(Fleet* fleet, const Fleet::Options& options,
            std::function<bool()> is_pressed)
      : fleet_(fleet),
        is_pressed_(std::move(is_pressed)),
        idle_unload_(options.idle_unload),
        period_(UnloadPeriod(options)),
        next_(Clock::now() + period_),
        next_trim_(Clock::now()) {}

  void Look() {
    const auto now = Clock::now();
    const bool is_pressed = is_pressed_();
    const bool unloads = is_pressed || now >= next_;
    if (unloads) {
      next_ = now + period_;
      fleet_->UnloadIdle(is_pressed ? now + idle_unload_ : now);
    }
    if (is_pressed) {
      trimmer_.Trim();
    } else if (unloads || now >= next_trim_) {
      next_trim_ = now + kTrimPeriod;
      trimmer_.TrimIfWorthwhile();
    } else {
      trimmer_.TrimIfMuch();
    }
  }

 private:
  Fleet* fleet_;
  std::function<bool()> is_pressed_;
  std::chrono::milliseconds idle_unload_;
  std::chrono::milliseconds period_;
  Clock::time_point next_;
  Clock::time_point next_trim_;
  Trimmer trimmer_;
};

}  // namespace

Upkeep::Upkeep(Fleet* fleet, VehicleCensus* census,
               const Fleet::Options& options, std::function<bool()> is_pressed)
    : unloading_(std::min(UnloadPeriod(options), kMemoryPeriod),
                 [unloading = Unloading(fleet, options,
                                        std::move(is_pressed))]() mutable {
                   unloading.Look();
                 }),
      snapshots_(kSnapshotPeriod, [fleet] { fleet->WriteSnapshots(); }),
      checks_(kChecksPeriod,
              [fleet] {
                fleet->PayChecks();
                fleet->DropOldEvents();
              }),
      census_(kCensusPeriod, [census] { census->Continue(); }) {
  census_.Hasten();
}

}  // namespace revisit::server
