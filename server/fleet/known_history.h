// A vehicle's history as it was at one moment, for searches of other vehicles.
#ifndef REVISIT_SERVER_FLEET_KNOWN_HISTORY_H_
#define REVISIT_SERVER_FLEET_KNOWN_HISTORY_H_

#include <chrono>
#include <cstdint>
#include <memory>
#include <string>

#include "core/drive/drive.h"
#include "core/drive/drive_view.h"
#include "server/sessions/vehicle_config.h"
#include "server/storage/records.h"

namespace revisit::server {

// Never changes, so that any number of threads may read it.
struct KnownHistory {
  std::string vehicle_id;
  VehicleKey key = 0;
  VehicleConfig config;
  // The vehicle's revision, and the highest sequence, which is durable.
  std::uint64_t revision = 0;
  std::uint64_t last_sequence = 0;
  // While it is the same, poses were only added.
  std::string series;
  // Never null.
  std::shared_ptr<const core::DriveView> view;
};

// The drive as searches of other vehicles see it. The scale that its own
// searches have shown does not count, since that is known only where they were
// made: a history is the same wherever it is read.
inline std::shared_ptr<const core::DriveView> HistoryView(
    const core::Drive& drive) {
  return drive.View(1.0);
}

// Why nothing is known of a history.
enum class Absence {
  kNone,
  // It was not read yet.
  kNotReady,
  // It is damaged in the store.
  kDamaged,
  // Histories that were asked for have no room for it.
  kMemory,
  // There is no such vehicle any more.
  kGone,
};

struct HistoryState {
  // Null where nothing is known.
  std::shared_ptr<const KnownHistory> history;
  Absence absence = Absence::kNotReady;
  // What was stored then is in it.
  std::chrono::steady_clock::time_point as_of;
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_FLEET_KNOWN_HISTORY_H_
