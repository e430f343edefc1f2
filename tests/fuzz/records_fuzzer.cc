// What lies in the store, should its checksum hold and the bytes be wrong
// nevertheless: read, or refused as DATA_LOSS.
#include <string>

#include "revisit/v1/pose_graph_service.pb.h"
#include "revisit/v1/vehicle.pb.h"
#include "server/conversion/answers.h"
#include "server/conversion/pose_pairs.h"
#include "server/conversion/record_codec.h"
#include "server/conversion/vehicle_settings.h"
#include "tests/fuzz/fuzzing.h"
#include "tests/fuzz/vehicles.h"

namespace {

using revisit::fuzz::Require;

void RequireDataLoss(const absl::Status& status) {
  revisit::fuzz::RequireGoodError(status);
  Require(status.ok() || absl::IsDataLoss(status), "damage is DATA_LOSS");
}

}  // namespace

extern "C" int LLVMFuzzerTestOneInput(const std::uint8_t* data,
                                      std::size_t size) {
  namespace server = revisit::server;
  revisit::fuzz::Input input(data, size);
  const int record = input.Choice(4);
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
  if (record == 3) {
    // The session answers DATA_LOSS, whatever this says.
    revisit::fuzz::RequireGoodError(
        codec.DecodeMeasurement(payload, config.engine.state_space).status());
    revisit::v1::LoopClosure closure;
    server::PosePairRecord pair;
    pair.payload = payload;
    server::EncodePosePair("v", pair, &closure);
    return 0;
  }
  const auto decoded = codec.DecodeBatch(payload, config);
  RequireDataLoss(decoded.status());
  server::BatchRecord stored;
  stored.payload = payload;
  std::size_t visited = 0;
  RequireDataLoss(server::VisitPoses(stored, [&](revisit::v1::Pose*) {
    ++visited;
    return true;
  }));
  for (const std::size_t count : {std::size_t{0}, visited / 2, visited}) {
    RequireDataLoss(codec.SliceBatch(payload, visited - count, count).status());
  }
  RequireDataLoss(codec.SliceBatch(payload, visited, visited + 1).status());
  if (!decoded.ok()) return 0;
  Require(decoded->samples.size() == visited, "a sample for each pose");
  if (record == 2) revisit::fuzz::Drive(config, decoded->samples);
  return 0;
}
