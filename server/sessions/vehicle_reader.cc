#include "server/sessions/vehicle_reader.h"

#include <cstddef>
#include <utility>
#include <vector>

#include "absl/strings/str_cat.h"
#include "core/geometry/pose.h"
#include "core/settings.h"
#include "server/base/status.h"
#include "server/storage/storage.h"

namespace revisit::server {
namespace {

using absl::StrCat;

bool AreOf(const BatchRecord& batch, const DecodedPoses& poses) {
  if (poses.dropped) {
    return poses.dropped->first_sequence == batch.first_sequence &&
           poses.dropped->last_sequence ==
               batch.first_sequence + batch.count - 1;
  }
  const std::vector<core::PoseSample>& samples = poses.samples;
  bool fits = samples.size() == batch.count;
  for (std::size_t i = 0; fits && i < samples.size(); ++i) {
    fits = samples[i].sequence == batch.first_sequence + i;
  }
  return fits;
}

}  // namespace

absl::StatusOr<VehicleConfig> VehicleReader::DecodeConfig(
    const VehicleRecord& record) const {
  absl::StatusOr<VehicleConfig> config = codec->DecodeVehicle(record);
  if (!config.ok()) return config;
  const std::vector<core::SettingProblem> problems =
      core::FindProblems(config->drive);
  if (!problems.empty()) {
    return Corrupt(StrCat("stored settings: ", problems.front().field, ": ",
                          problems.front().description));
  }
  return config;
}

absl::StatusOr<DecodedPoses> VehicleReader::DecodeStoredPoses(
    const BatchRecord& batch, const VehicleConfig& with_config) const {
  absl::StatusOr<DecodedPoses> poses =
      codec->DecodePoses(batch.payload, with_config);
  if (poses.ok() && !AreOf(batch, *poses)) return HoldsOthers(batch);
  return poses;
}

absl::StatusOr<std::vector<core::PoseSample>> VehicleReader::ReadPosesAround(
    VehicleKey key, std::uint64_t sequence,
    const VehicleConfig& with_config) const {
  absl::StatusOr<DecodedPoses> poses = DecodedPoses();
  const absl::Status reading =
      storage->ReadBatches(key, sequence, sequence, BatchVersion::kCurrent,
                           [&](const BatchRecord& batch) {
                             poses = DecodeStoredPoses(batch, with_config);
                             return false;
                           });
  if (!reading.ok()) return reading;
  if (!poses.ok()) return poses.status();
  return std::move(poses->samples);
}

absl::Status VehicleReader::Corrupt(const std::string& cause) const {
  return server::Corrupt(StrCat("vehicle '", id, "': ", cause),
                         {{"vehicle", id}});
}

absl::Status VehicleReader::HoldsOthers(const BatchRecord& batch) const {
  return Corrupt(StrCat("stored batch of ", batch.count,
                        " poses from sequence ", batch.first_sequence,
                        " holds others than these"));
}

}  // namespace revisit::server
