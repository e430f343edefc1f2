#include "server/sessions/measured_loops.h"

#include <optional>

#include "absl/status/statusor.h"

namespace revisit::server {

absl::Status MeasuredLoops::Add(const VehicleReader& vehicle,
                                core::StateSpace space,
                                const PosePairRecord& pair) {
  if (pair.payload.empty()) return absl::OkStatus();
  const absl::StatusOr<std::optional<core::LoopMeasurement>> measurement =
      vehicle.codec->DecodeMeasurement(pair.payload, space);
  if (!measurement.ok()) return measurement.status();
  if (!*measurement) return absl::OkStatus();
  measurements_.emplace(pair.id, **measurement);
  poses_.try_emplace(pair.query_sequence);
  poses_.try_emplace(pair.matched_sequence);
  return absl::OkStatus();
}

void MeasuredLoops::Take(const std::vector<core::PoseSample>& samples) {
  if (samples.empty()) return;
  const std::uint64_t first = samples.front().sequence;
  for (auto wanted = poses_.lower_bound(first);
       wanted != poses_.end() && wanted->first <= samples.back().sequence;
       ++wanted) {
    const core::PoseSample& sample = samples[wanted->first - first];
    wanted->second = std::make_unique<core::PoseEstimate>(
        core::PoseEstimate{sample.pose, sample.covariance});
  }
}

absl::StatusOr<bool> MeasuredLoops::ReadPoses(
    const VehicleReader& vehicle, VehicleKey key, const VehicleConfig& config,
    std::uint64_t last, const std::function<bool()>& go_on) {
  for (const auto& [sequence, pose] : poses_) {
    if (sequence > last) break;
    if (pose) continue;
    if (!go_on()) return false;
    const absl::StatusOr<std::vector<core::PoseSample>> samples =
        vehicle.ReadPosesAround(key, sequence, config);
    if (!samples.ok()) return samples.status();
    Take(*samples);
  }
  return true;
}

std::shared_ptr<const core::MeasuredLoop> MeasuredLoops::Find(
    const PosePairRecord& closure) const {
  const auto measurement = measurements_.find(closure.id);
  if (measurement == measurements_.end()) return nullptr;
  const auto query = poses_.find(closure.query_sequence);
  const auto matched = poses_.find(closure.matched_sequence);
  if (query->second == nullptr || matched->second == nullptr) return nullptr;
  return std::make_shared<const core::MeasuredLoop>(core::MeasuredLoop{
      measurement->second, *query->second, *matched->second});
}

}  // namespace revisit::server
