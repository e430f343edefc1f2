// Steps that read a vehicle's stored checks and may write what came of that.
#ifndef REVISIT_SERVER_SESSIONS_CHECK_STEPS_H_
#define REVISIT_SERVER_SESSIONS_CHECK_STEPS_H_

#include <functional>

#include "absl/status/statusor.h"
#include "server/sessions/check_changes.h"
#include "server/sessions/vehicle_queue.h"
#include "server/sessions/vehicle_state.h"
#include "server/storage/records.h"

namespace revisit::server {

// Belongs to the strand.
class CheckSteps {
 public:
  using Step = std::function<absl::StatusOr<ChecksWrite>()>;

  CheckSteps(VehicleState* vehicle, VehicleQueue* queue,
             const CheckChanges* changes)
      : vehicle_(vehicle), queue_(queue), changes_(changes) {}

  // Runs a step, which may take long, after what came before and while nothing
  // else is written; then `then`, told whether that worked, before anything
  // that waits.
  void Run(Step step, std::function<void(bool)> then);

 private:
  void Begin(const Step& step, const std::function<void(bool)>& then);

  VehicleState* const vehicle_;
  VehicleQueue* const queue_;
  const CheckChanges* const changes_;
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_SESSIONS_CHECK_STEPS_H_
