// Does what the vehicles of a server need from time to time, whoever calls.
#ifndef REVISIT_SERVER_SESSIONS_UPKEEP_H_
#define REVISIT_SERVER_SESSIONS_UPKEEP_H_

#include <functional>

#include "server/base/periodic.h"
#include "server/sessions/fleet.h"
#include "server/sessions/vehicle_census.h"

namespace revisit::server {

// Unloads vehicles that have been idle for long, or, if memory is short, all
// unused ones, and gives freed memory back to the system; writes their
// snapshots; has checks made that are owed; counts the store's vehicles. Each
// on a thread of its own, until this is destroyed.
class Upkeep {
 public:
  // `options` are those of the fleet. `is_pressed` measures whether memory is
  // short, and is called twice a second at least. All of these must outlive
  // this.
  Upkeep(Fleet* fleet, VehicleCensus* census, const Fleet::Options& options,
         std::function<bool()> is_pressed);

 private:
  Periodic unloading_;
  Periodic snapshots_;
  Periodic checks_;
  Periodic census_;
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_SESSIONS_UPKEEP_H_
