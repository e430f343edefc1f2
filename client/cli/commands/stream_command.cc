#include "client/cli/commands/stream_command.h"

#include <algorithm>
#include <utility>
#include <vector>

#include "absl/strings/str_cat.h"
#include "client/cli/commands/shared_flags.h"
#include "client/cli/commands/stream_end.h"
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
    return LocalError(absl::FailedPreconditionError(absl::StrCat(
        vehicle.name(), " takes geodetic positions; files hold local ones")));
  }
  if (vehicle.settings().correlation_model() == v1::CORRELATION_MODEL_FILTER) {
    return LocalError(absl::FailedPreconditionError(absl::StrCat(
        vehicle.name(),
        " needs an error transition with every pose; files hold none")));
  }
  return absl::OkStatus();
}

// Counts over the answers of a stream.
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

PoseStreamOptions MakeStreamOptions(const StreamOptions& options,
                                    const v1::Vehicle& vehicle) {
  PoseStreamOptions stream;
  stream.batch_poses = options.batch_poses;
  stream.acked_sequence = options.acked_sequence;
  stream.vehicle_uid = options.vehicle_uid;
  // A sequence that is claimed without a uid may be that of an earlier vehicle
  // of this name: the present one must not answer for it.
  if (options.vehicle_uid.empty() && options.acked_sequence == 0) {
    stream.vehicle_uid = vehicle.uid();
  }
  stream.send_candidates = options.candidates;
  stream.give_up_after = options.give_up_after;
  return stream;
}

// All of `tally`, `progress` and `console` must outlive the stream.
PoseStreamCallbacks MakeCallbacks(Tally* tally, Progress* progress,
                                  const Console& console) {
  PoseStreamCallbacks callbacks;
  callbacks.ack = [tally, progress](const v1::Ack& ack) {
    progress->Update(ack.durable_sequence());
    const MutexLock lock(&tally->mutex);
    tally->revision = ack.revision();
    tally->jumps += ack.jumps_size();
    for (const v1::Jump& jump : ack.jumps()) {
      progress->Note(JumpText(jump));
    }
  };
  callbacks.candidates = [tally, &console](const v1::CandidateSet& set) {
    const MutexLock lock(&tally->mutex);
    ++tally->checks;
    PrintCandidates(set, console);
  };
  callbacks.disconnected = [progress](const absl::Status& status,
                                      std::chrono::nanoseconds wait) {
    progress->Note(
        absl::StrCat("connection lost, trying again in ",
                     Fixed(std::chrono::duration<double>(wait).count(), 1),
                     " s: ", Describe(status)));
  };
  return callbacks;
}

// The report on a stream that has ended well.
struct Summary {
  std::string vehicle;
  std::string vehicle_uid;
  std::size_t poses = 0;
  std::uint64_t already_durable = 0;
  std::uint64_t durable = 0;
  std::uint64_t revision = 0;
  std::int64_t jumps = 0;
  int reconnects = 0;
  double seconds = 0.0;
  // Absent where candidates were not asked for.
  std::optional<std::int64_t> checks;
};

void PrintJson(const Summary& summary, std::ostream& out) {
  nlohmann::ordered_json json;
  json["vehicle"] = summary.vehicle;
  json["vehicleUid"] = summary.vehicle_uid;
  json["poses"] = summary.poses;
  json["alreadyDurable"] = summary.already_durable;
  json["durableSequence"] = summary.durable;
  json["revision"] = summary.revision;
  json["jumps"] = summary.jumps;
  json["reconnects"] = summary.reconnects;
  json["seconds"] = summary.seconds;
  if (summary.checks.has_value()) json["checks"] = *summary.checks;
  out << json.dump() << '\n';
}

void PrintText(const Summary& summary, std::ostream& out) {
  const std::uint64_t sent = summary.durable - summary.already_durable;
  const double rate =
      summary.seconds > 0.0 ? static_cast<double>(sent) / summary.seconds : 0.0;
  std::vector<std::pair<std::string, std::string>> fields = {
      {"vehicle", summary.vehicle},
      {"vehicle uid", summary.vehicle_uid},
      {"already durable", absl::StrCat(summary.already_durable)},
      {"streamed", absl::StrCat(sent, " poses in ", Fixed(summary.seconds, 2),
                                " s, ", Fixed(rate, 0), "/s")},
      {"durable sequence", absl::StrCat(summary.durable)},
      {"revision", absl::StrCat(summary.revision)},
      {"jumps", absl::StrCat(summary.jumps)},
      {"reconnects", absl::StrCat(summary.reconnects)}};
  if (summary.checks.has_value()) {
    fields.emplace_back("checks", absl::StrCat(*summary.checks));
  }
  PrintFields(fields, out);
}

}  // namespace

void AddStreamCommand(const Command& program) {
  const Command command = program.AddCommand(
      {"stream", "Streams the poses of a file into a vehicle.",
       "Pose i of the file gets sequence i. A broken connection is made again. "
       "Stopped, by\nCtrl-C too, and run again, it goes on where the server's "
       "durable poses "
       "end, after the server has compared\nthe last of them with the file's. "
       "Truth in the file is not sent.",
       "  revisit stream drive.csv --vehicle shuttle-7\n"
       "  revisit stream poses.txt --format tum --vehicle shuttle-7 --create\n"
       "  revisit stream drive.csv --vehicle shuttle-7 --candidates --json"});
  const Words formats = {{"drive", static_cast<int>(DriveFormat::kDrive)},
                         {"tum", static_cast<int>(DriveFormat::kTum)}};
  const auto options = std::make_shared<StreamOptions>();
  const auto give_up_seconds = std::make_shared<double>(60.0);
  command.AddText("FILE", "TEXT", &options->file, "Drive file").Required();
  AddVehicleName(command, &options->vehicle);
  command.AddChoice("--format", formats, &options->format,
                    "Comma-separated columns by name (drive, the default), or "
                    "t x y z qx qy qz qw (tum)");
  command.AddSwitch("--create", &options->create,
                    "Create the vehicle if there is none, with the server's "
                    "default settings");
  command.AddSwitch("--candidates", &options->candidates,
                    "Print the candidates of every check that falls due");
  command
      .AddWholeNumber("--batch", {1, 1'000'000}, &options->batch_poses,
                      "Poses of one message")
      .ShowDefault();
  command.AddWholeNumber("--acked-sequence", WholeRange(),
                         &options->acked_sequence,
                         "Highest sequence known to be durable; if the server "
                         "has less, it answers DATA_LOSS");
  command.AddText(
      "--vehicle-uid", "UID", &options->vehicle_uid,
      "Uid of the vehicle that is meant; another of its name is refused, and "
      "with it --acked-sequence proves a loss to the server, which then "
      "refuses writes until accept-loss");
  command.AddNumber("--give-up-after", "S", give_up_seconds.get(),
                    "Seconds without progress; 0 tries for ever");
  AddUncertainty(command, &options->uncertainty);
  command.Runs([options, give_up_seconds](const Connection& server,
                                          const Console& console) {
    if (*give_up_seconds > 0.0) {
      options->give_up_after =
          std::chrono::duration_cast<std::chrono::milliseconds>(
              std::chrono::duration<double>(*give_up_seconds));
    }
    return RunStream(server.channel, *options, console);
  });
}

absl::Status RunStream(const std::shared_ptr<grpc::Channel>& channel,
                       const StreamOptions& options, const Console& console) {
  const auto drive = ReadDriveFile(options.file, options.format);
  if (!drive.ok()) return LocalError(drive.status());
  const auto uncertainty = ClaimUncertainty(*drive, options.uncertainty);
  if (!uncertainty.ok()) return LocalError(uncertainty.status());
  const std::size_t poses = drive->samples.size();
  const auto vehicle = GetOrCreate(Client(channel), options);
  if (!vehicle.ok()) return vehicle.status();
  if (absl::Status fits = CheckThatFilesFit(*vehicle); !fits.ok()) return fits;

  Progress progress(console, drive->name, poses, "poses");
  Tally tally;
  {
    const MutexLock lock(&tally.mutex);
    tally.revision = vehicle->revision();
  }
  PoseStream stream(channel, vehicle->name(),
                    MakeStreamOptions(options, *vehicle),
                    MakeCallbacks(&tally, &progress, console));
  std::optional<StreamInterrupt> interrupt;
  interrupt.emplace(&stream, vehicle->name(), console);
  const auto durable = stream.WaitUntilOpened();
  if (!durable.ok()) return durable.status();
  if (*durable > poses) {
    return LocalError(absl::FailedPreconditionError(absl::StrCat(
        vehicle->name(), " has ", *durable, " poses already, more than the ",
        poses, " of ", options.file)));
  }
  const auto start = Clock::now();
  // The last durable pose is sent again, for the server to compare it.
  AppendPoses(*drive, *uncertainty, vehicle->settings().state_space(),
              {*durable == 0 ? 0 : *durable - 1, poses},
              static_cast<std::size_t>(std::max(options.batch_poses, 1)),
              &stream);
  const absl::Status finished = stream.Finish();
  interrupt.reset();
  const double seconds =
      std::chrono::duration<double>(Clock::now() - start).count();
  if (!finished.ok()) return WithDurable(finished, vehicle->name(), stream);

  Summary summary;
  summary.vehicle = vehicle->name();
  summary.vehicle_uid = stream.vehicle_uid();
  summary.poses = poses;
  summary.already_durable = *durable;
  summary.durable = stream.acked_sequence();
  summary.reconnects = stream.reconnects();
  summary.seconds = seconds;
  const MutexLock lock(&tally.mutex);
  summary.revision = tally.revision;
  summary.jumps = tally.jumps;
  if (options.candidates) summary.checks = tally.checks;
  if (console.json) {
    PrintJson(summary, console.out);
  } else {
    PrintText(summary, console.out);
  }
  return absl::OkStatus();
}

}  // namespace revisit::client
