// Loop closures with what was measured between their poses. The graph has only
// nodes, so the poses themselves come from the store.
#ifndef REVISIT_SERVER_SESSIONS_MEASURED_LOOPS_H_
#define REVISIT_SERVER_SESSIONS_MEASURED_LOOPS_H_

#include <cstdint>
#include <functional>
#include <map>
#include <memory>
#include <string>
#include <vector>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "core/drive/measured_loop.h"
#include "core/geometry/pose.h"
#include "server/sessions/vehicle_reader.h"
#include "server/storage/records.h"

namespace revisit::server {

// Thread-compatible.
class MeasuredLoops {
 public:
  // Notes what was measured of a loop closure, if anything was; of a rejected
  // candidate nothing ever was. Errors: those of
  // RecordCodec::DecodeMeasurement().
  absl::Status Add(const VehicleReader& vehicle, core::StateSpace space,
                   const PosePairRecord& pair);
  bool empty() const { return measurements_.empty(); }

  // Takes those of the poses that are wanted.
  void Take(const std::vector<core::PoseSample>& samples);
  // Takes the poses up to `last` that are wanted from the store, until `go_on`
  // says false. Returns whether all were taken.
  absl::StatusOr<bool> ReadPoses(const VehicleReader& vehicle, VehicleKey key,
                                 const VehicleConfig& config,
                                 std::uint64_t last,
                                 const std::function<bool()>& go_on);

  // Null if nothing was measured of this closure, or a pose was never taken.
  std::shared_ptr<const core::MeasuredLoop> Find(
      const PosePairRecord& closure) const;

 private:
  // By id.
  std::map<std::string, core::LoopMeasurement> measurements_;
  // By sequence: null until the pose was taken.
  std::map<std::uint64_t, std::unique_ptr<core::PoseEstimate>> poses_;
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_SESSIONS_MEASURED_LOOPS_H_
