// What lies in the store, should its checksum hold and the bytes be wrong
// nevertheless: read, or refused as DATA_LOSS.
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <map>
#include <string>
#include <vector>

#include "core/drive/drive.h"
#include "core/drive/dropped_stretch.h"
#include "core/geometry/pose.h"
#include "core/settings.h"
#include "revisit/v1/pose_graph_service.pb.h"
#include "revisit/v1/vehicle.pb.h"
#include "server/conversion/answers.h"
#include "server/conversion/pose_pairs.h"
#include "server/conversion/vehicle_settings.h"
#include "server/fields/pose_fields.h"
#include "server/records/batch_records.h"
#include "server/records/proto_record_codec.h"
#include "tests/fuzz/fuzzing.h"
#include "tests/fuzz/vehicles.h"

namespace {

using revisit::fuzz::Require;

void RequireDataLoss(const absl::Status& status) {
  revisit::fuzz::RequireGoodError(status);
  Require(status.ok() || absl::IsDataLoss(status), "damage is DATA_LOSS");
}

// A drive in circles.
std::vector<revisit::core::PoseSample> Circles() {
  std::vector<revisit::core::PoseSample> samples;
  for (int i = 0; i < 150; ++i) {
    revisit::core::PoseSample sample;
    sample.sequence = samples.size() + 1;
    sample.stamp_ns = i;
    const double angle = 0.1 * i;
    sample.pose = {20.0 * std::cos(angle), 20.0 * std::sin(angle), 0.0,
                   std::remainder(angle + 1.57, 6.2831853)};
    for (int k = 0; k < 4; ++k) sample.covariance(k, k) = 0.01 * (i + 1);
    sample.transition.emplace();
    samples.push_back(sample);
  }
  return samples;
}

// Loads the state of a drive with changes: three bytes say where, and one
// which bits are flipped, or, with none, that the state ends there. It is
// refused, or the drive goes on.
void LoadChangedState(const revisit::core::DriveSettings& settings,
                      const std::string& changes) {
  using revisit::core::Drive;
  static const auto& samples =
      *new std::vector<revisit::core::PoseSample>(Circles());
  // One of each kind of vehicle.
  static auto& states = *new std::map<std::string, std::string>();
  const auto half = samples.begin() + 120;
  Drive loaded(settings);
  std::string& sound = states[loaded.StateKey()];
  if (sound.empty()) {
    Drive saved(settings);
    saved.Append({samples.begin(), half}, 1);
    sound = saved.SaveRest(0);
  }
  std::string state = sound;
  for (std::size_t i = 0; i + 4 <= changes.size() && !state.empty(); i += 4) {
    std::size_t at = 0;
    for (std::size_t k = 0; k < 3; ++k) {
      at = at << 8 | static_cast<std::uint8_t>(changes[i + k]);
    }
    at %= state.size();
    if (changes[i + 3] == 0) {
      state.resize(at);
    } else {
      state[at] = static_cast<char>(state[at] ^ changes[i + 3]);
    }
  }
  const bool is_usable = loaded.LoadRest(state);
  Require(is_usable || changes.size() >= 4, "a state that was saved is loaded");
  if (!is_usable || loaded.last_sequence() != 120) return;
  // No search: numbers that are wrong but in range may make one take for ever.
  loaded.Append({half, samples.end()}, 1);
  Require(!loaded.SaveRest(0).empty(), "it can be saved again");
}

}  // namespace

extern "C" int LLVMFuzzerTestOneInput(const std::uint8_t* data,
                                      std::size_t size) {
  namespace server = revisit::server;
  revisit::fuzz::Input input(data, size);
  const int record = input.Choice(5);
  const int kind = input.Choice(revisit::fuzz::kVehicleKinds);
  const server::VehicleConfig config = revisit::fuzz::VehicleOfKind(kind);
  const std::string payload = input.Rest();
  const server::ProtoRecordCodec codec;
  if (record == 0) {
    server::VehicleRecord listed;
    listed.id = "v";
    listed.payload = payload;
    const auto decoded = codec.DecodeVehicle(listed);
    RequireDataLoss(decoded.status());
    if (decoded.ok()) {
      server::VehicleRecord written;
      written.payload = codec.EncodeVehicle(*decoded);
      const auto again = codec.DecodeVehicle(written);
      Require(again.ok(), "a vehicle that was read can be written");
      Require(server::SameSettings(*decoded, *again), "and is the same");
    }
    revisit::v1::Vehicle vehicle;
    server::EncodeVehicle(listed, &vehicle);
    return 0;
  }
  if (record == 4) {
    LoadChangedState(config.drive, payload);
    return 0;
  }
  if (record == 3) {
    // The session answers DATA_LOSS, whatever this says.
    revisit::fuzz::RequireGoodError(
        codec.DecodeMeasurement(payload, config.drive.state_space).status());
    revisit::v1::LoopClosure closure;
    server::PosePairRecord pair;
    pair.payload = payload;
    server::EncodePosePair("v", pair, &closure);
    revisit::v1::RejectedCandidate rejection;
    server::EncodePosePair("v", pair, &rejection);
    return 0;
  }
  const auto decoded = codec.DecodePoses(payload, config);
  RequireDataLoss(decoded.status());
  RequireDataLoss(codec.Fingerprints(payload).status());
  RequireDataLoss(codec.AsMessages(payload).status());
  server::BatchRecord stored;
  stored.payload = payload;
  std::size_t visited = 0;
  RequireDataLoss(server::VisitPoses(stored, [&](const server::PoseFields&) {
    ++visited;
    return true;
  }));
  for (const std::size_t count : {std::size_t{0}, visited / 2, visited}) {
    RequireDataLoss(codec.SliceBatch(payload, visited - count, count).status());
  }
  RequireDataLoss(codec.SliceBatch(payload, visited, visited + 1).status());
  if (!decoded.ok()) return 0;
  Require(decoded->samples.size() == visited, "a sample for each pose");
  if (decoded->dropped) {
    revisit::core::DroppedStretch stretch = *decoded->dropped;
    Require(codec.DecodePoses(codec.EncodeDropped(stretch), config).ok(),
            "what is left of dropped poses can be written");
    stretch.last_sequence -= stretch.first_sequence - 1;
    stretch.first_sequence = 1;
    revisit::core::Drive drive(config.drive);
    drive.Skip(stretch, 1);
    Require(drive.dropped().count() == stretch.last_sequence,
            "a graph goes on behind them");
  }
  if (record == 2) revisit::fuzz::Drive(config, decoded->samples);
  return 0;
}
