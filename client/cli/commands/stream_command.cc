#include "client/cli/commands/stream_command.h"

#include <algorithm>
#include <vector>

#include "client/cli/drive_poses.h"
#include "client/cli/names.h"
#include "client/revisit/pose_stream.h"
#include "client/revisit/status.h"
#include "core/base/mutex.h"
#include "grpcpp/channel.h"
#include "nlohmann/json.hpp"

namespace revisit::client {
namespace {

using Clock = std::chrono::steady_clock;

absl::StatusOr<v1::Vehicle> GetOrCreate(const Client& client,
                                        const StreamOptions& options) {
  v1::GetVehicleRequest get;
  get.set_name(VehicleName(options.vehicle));
  const auto found = client.GetVehicle(get);
  if (found.ok()) return found->vehicle();
  if (!options.create || !absl::IsNotFound(found.status())) {
    return found.status();
  }
  v1::CreateVehicleRequest create;
  create.set_vehicle_id(get.name().substr(get.name().find('/') + 1));
  *create.mutable_vehicle()->mutable_settings() = options.settings;
  const auto created = client.CreateVehicle(create);
  if (!created.ok()) return created.status();
  return created->vehicle();
}

// Files hold local positions and no error transitions.
absl::Status CheckThatFilesFit(const v1::Vehicle& vehicle) {
  if (vehicle.settings().coordinate_frame() == v1::COORDINATE_FRAME_GEODETIC) {
    return LocalError(absl::FailedPreconditionError(
        vehicle.name() + " takes geodetic positions; files hold local ones"));
  }
  if (vehicle.settings().correlation_model() == v1::CORRELATION_MODEL_FILTER) {
    return LocalError(absl::FailedPreconditionError(
        vehicle.name() +
        " needs an error transition with every pose; files hold none"));
  }
  return absl::OkStatus();
}

// What the answers of a stream add up to.
struct Tally {
  Mutex mutex;
  std::uint64_t revision ABSL_GUARDED_BY(mutex) = 0;
  std::int64_t jumps ABSL_GUARDED_BY(mutex) = 0;
  std::int64_t checks ABSL_GUARDED_BY(mutex) = 0;
};

void PrintCandidates(const v1::CandidateSet& set, const Console& console) {
  if (console.json) {
    console.out << ToJson(set, false) << '\n';
    return;
  }
  console.out << "check at sequence " << set.query().sequence() << ", "
              << Fixed(set.query().travelled_meters(), 1) << " m: ";
  if (set.candidates().empty()) {
    console.out << "no candidates, " << Explain(set.empty_reason()) << '\n';
    return;
  }
  const v1::Candidate& best = set.candidates(0);
  console.out << "sequence " << best.matched().sequence() << ", "
              << Fixed(best.matched().travelled_meters(), 1) << " m, d2 "
              << Fixed(best.gate().squared_mahalanobis_distance(), 2)
              << " against " << Fixed(best.gate().threshold(), 2) << ", ";
  if (best.has_probability()) {
    console.out << "probability " << Fixed(best.probability(), 4) << ", ";
  }
  if (best.direction() == v1::DIRECTION_OPPOSITE) {
    console.out << "opposite direction, ";
  }
  console.out << NameOf(best.verdict()) << '\n';
}

}  // namespace

absl::Status RunStream(const std::shared_ptr<grpc::Channel>& channel,
                       const StreamOptions& options, const Console& console) {
  const auto drive = ReadDriveFile(options.file, options.format);
  if (!drive.ok()) return LocalError(drive.status());
  const auto uncertainty = ClaimUncertainty(*drive, options.uncertainty);
  if (!uncertainty.ok()) return LocalError(uncertainty.status());
  const Client client(channel);
  const auto vehicle = GetOrCreate(client, options);
  if (!vehicle.ok()) return vehicle.status();
  if (absl::Status fits = CheckThatFilesFit(*vehicle); !fits.ok()) return fits;

  Progress progress(console, drive->name, drive->samples.size(), "poses");
  Tally tally;
  {
    const MutexLock lock(&tally.mutex);
    tally.revision = vehicle->revision();
  }
  PoseStreamOptions stream_options;
  stream_options.batch_poses = options.batch_poses;
  stream_options.acked_sequence = options.acked_sequence;
  stream_options.vehicle_uid = options.vehicle_uid;
  // What is claimed without a uid may be of an earlier vehicle of this name:
  // the one that is there now must not answer for it.
  if (options.vehicle_uid.empty() && options.acked_sequence == 0) {
    stream_options.vehicle_uid = vehicle->uid();
  }
  stream_options.send_candidates = options.candidates;
  stream_options.give_up_after = options.give_up_after;
  PoseStreamCallbacks callbacks;
  callbacks.ack = [&](const v1::Ack& ack) {
    progress.Update(ack.durable_sequence());
    const MutexLock lock(&tally.mutex);
    tally.revision = ack.revision();
    tally.jumps += ack.jumps_size();
    for (const v1::Jump& jump : ack.jumps()) {
      progress.Note("jump of " + Fixed(jump.distance_meters(), 1) +
                    " m before sequence " + std::to_string(jump.sequence()));
    }
  };
  callbacks.candidates = [&](const v1::CandidateSet& set) {
    const MutexLock lock(&tally.mutex);
    ++tally.checks;
    PrintCandidates(set, console);
  };
  callbacks.disconnected = [&](const absl::Status& status,
                               std::chrono::nanoseconds wait) {
    progress.Note("connection lost, trying again in " +
                  Fixed(std::chrono::duration<double>(wait).count(), 1) +
                  " s: " + Describe(status));
  };
  PoseStream stream(channel, vehicle->name(), stream_options, callbacks);
  const auto durable = stream.WaitUntilOpened();
  if (!durable.ok()) return durable.status();
  if (*durable > drive->samples.size()) {
    return LocalError(absl::FailedPreconditionError(
        vehicle->name() + " has " + std::to_string(*durable) +
        " poses already, more than the " +
        std::to_string(drive->samples.size()) + " of " + options.file));
  }
  const auto start = Clock::now();
  const std::size_t batch_poses =
      static_cast<std::size_t>(std::max(options.batch_poses, 1));
  for (std::size_t next = *durable == 0 ? 0 : *durable - 1;
       next < drive->samples.size();) {
    v1::PoseBatch batch;
    const std::size_t end = std::min(drive->samples.size(), next + batch_poses);
    for (; next < end; ++next) {
      *batch.add_poses() = MakePose(*drive, *uncertainty,
                                    vehicle->settings().state_space(), next);
    }
    // Why it failed is what Finish() says as well.
    if (!stream.Append(std::move(batch)).ok()) break;
  }
  const absl::Status finished = stream.Finish();
  const double seconds =
      std::chrono::duration<double>(Clock::now() - start).count();
  if (!finished.ok()) return finished;

  const MutexLock lock(&tally.mutex);
  const std::uint64_t sent = stream.acked_sequence() - *durable;
  if (console.json) {
    nlohmann::ordered_json json;
    json["vehicle"] = vehicle->name();
    json["vehicleUid"] = stream.vehicle_uid();
    json["poses"] = drive->samples.size();
    json["alreadyDurable"] = *durable;
    json["durableSequence"] = stream.acked_sequence();
    json["revision"] = tally.revision;
    json["jumps"] = tally.jumps;
    json["reconnects"] = stream.reconnects();
    json["seconds"] = seconds;
    if (options.candidates) json["checks"] = tally.checks;
    console.out << json.dump() << '\n';
    return absl::OkStatus();
  }
  std::vector<std::pair<std::string, std::string>> fields = {
      {"vehicle", vehicle->name()},
      {"vehicle uid", stream.vehicle_uid()},
      {"already durable", std::to_string(*durable)},
      {"streamed",
       std::to_string(sent) + " poses in " + Fixed(seconds, 2) + " s, " +
           Fixed(seconds > 0.0 ? static_cast<double>(sent) / seconds : 0.0, 0) +
           "/s"},
      {"durable sequence", std::to_string(stream.acked_sequence())},
      {"revision", std::to_string(tally.revision)},
      {"jumps", std::to_string(tally.jumps)},
      {"reconnects", std::to_string(stream.reconnects())}};
  if (options.candidates) {
    fields.emplace_back("checks", std::to_string(tally.checks));
  }
  PrintFields(fields, console.out);
  return absl::OkStatus();
}

}  // namespace revisit::client
