#include "client/cli/commands/evaluate_command.h"

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <filesystem>
#include <fstream>
#include <memory>
#include <random>
#include <system_error>
#include <utility>

#include "absl/status/statusor.h"
#include "client/cli/evaluation/baselines.h"
#include "client/cli/evaluation/calibration.h"
#include "client/cli/evaluation/drive_evaluator.h"
#include "client/cli/evaluation/evaluation_plots.h"
#include "client/cli/evaluation/evaluation_report.h"
#include "client/cli/evaluation/map_svg.h"
#include "client/cli/evaluation/private_server.h"
#include "client/cli/evaluation/simulation.h"
#include "client/cli/interrupt_guard.h"
#include "client/formats/drive_file.h"
#include "client/formats/gnss_file.h"
#include "client/formats/text_lines.h"
#include "client/revisit/channel.h"
#include "client/revisit/client.h"
#include "core/base/mutex.h"
#include "grpcpp/channel.h"

namespace revisit::client {
namespace {

// What has to be undone, also when Ctrl-C is pressed: then Undo() runs on
// another thread.
class Undoing {
 public:
  PrivateServer* server() { return &server_; }

  void SetClient(const Client* client) {
    const MutexLock lock(&mutex_);
    client_ = client;
  }
  void AddVehicle(const std::string& name) {
    const MutexLock lock(&mutex_);
    vehicles_.push_back(name);
  }

  // Deletes the vehicles that were added since.
  absl::Status DeleteVehicles() {
    const MutexLock lock(&mutex_);
    absl::Status first;
    for (const std::string& name : vehicles_) {
      v1::DeleteVehicleRequest request;
      request.set_name(name);
      const absl::Status status = client_->DeleteVehicle(request).status();
      if (!status.ok() && !absl::IsNotFound(status)) first.Update(status);
    }
    vehicles_.clear();
    return first;
  }

  absl::Status Undo() {
    const absl::Status status = DeleteVehicles();
    server_.Stop();
    return status;
  }

 private:
  PrivateServer server_;
  Mutex mutex_;
  const Client* client_ ABSL_GUARDED_BY(mutex_) = nullptr;
  std::vector<std::string> vehicles_ ABSL_GUARDED_BY(mutex_);
};

// An id that nobody else takes: the drive's name, as far as ids may hold it,
// and a random number.
std::string UniqueVehicleId(const std::string& drive) {
  constexpr std::size_t kMostOfName = 40;
  std::string id = "evaluate-";
  for (const char c : drive.substr(0, kMostOfName)) {
    const bool allowed = (c >= 'a' && c <= 'z') || (c >= '0' && c <= '9');
    const bool capital = c >= 'A' && c <= 'Z';
    id += allowed ? c : capital ? static_cast<char>(c - 'A' + 'a') : '-';
  }
  std::random_device random;
  constexpr char kDigits[] = "0123456789abcdef";
  id += '-';
  for (int i = 0; i < 10; ++i) id += kDigits[random() % 16];
  return id;
}

// What is streamed: a drive, or one that was drawn from it.
struct Case {
  Drive drive;
  std::optional<std::uint64_t> seed;
  std::vector<ClaimedUncertainty> uncertainty;
};

// How candidates are found.
struct Method {
  enum class Source {
    // The service's answers.
    kService,
    // Of these, those beyond the recent path.
    kServiceBeyondRecentPath,
    // FindNearestPositions(), on the nodes and checks of the method before.
    kNearestPosition,
  };
  std::string name;
  Source source = Source::kService;
  v1::VehicleSettings settings;
  Judging judging;
  double sequence_length_meters = 0.0;
};

std::vector<Method> MethodsAt(const EvaluateOptions& options,
                              double sequence_length_meters,
                              double exclude_meters) {
  Method given;
  given.name = options.settings.alignment() == v1::ALIGNMENT_COMPOSITE
                   ? "composite"
                   : "relative";
  given.settings = options.settings;
  given.settings.set_sequence_length_meters(sequence_length_meters);
  given.judging = options.judging;
  given.judging.excluded_nodes =
      std::llround(exclude_meters / options.settings.node_spacing_meters());
  given.sequence_length_meters = sequence_length_meters;
  if (!options.baselines) return {given};

  const auto composite = [&](const char* name, v1::CorrelationModel model) {
    Method method = given;
    method.name = name;
    method.settings.set_alignment(v1::ALIGNMENT_COMPOSITE);
    method.settings.set_correlation_model(model);
    return method;
  };
  Method single =
      composite("single pose", options.settings.correlation_model());
  single.source = Method::Source::kServiceBeyondRecentPath;
  single.settings.set_sequence_length_meters(
      options.settings.node_spacing_meters());
  single.settings.set_max_candidates(100);
  Method nearest = given;
  nearest.name = "nearest position";
  nearest.source = Method::Source::kNearestPosition;
  return {
      composite("paper, independent", v1::CORRELATION_MODEL_INDEPENDENT),
      composite("paper, dead reckoning", v1::CORRELATION_MODEL_DEAD_RECKONING),
      single, given, nearest};
}

std::vector<Method> ChooseMethods(const EvaluateOptions& options,
                                  std::size_t* main) {
  if (options.sequence_lengths.empty()) {
    auto methods = MethodsAt(options, options.settings.sequence_length_meters(),
                             options.exclude_meters);
    *main = methods.size() > 1 ? methods.size() - 2 : 0;
    return methods;
  }
  std::vector<Method> all;
  *main = 0;
  for (const double length : options.sequence_lengths) {
    for (Method& method : MethodsAt(options, length, length)) {
      all.push_back(std::move(method));
    }
    const bool own = length == options.settings.sequence_length_meters();
    if (own || &length == &options.sequence_lengths.front()) {
      *main = all.size() - (options.baselines ? 2 : 1);
    }
  }
  return all;
}

std::vector<std::string> NotesOn(const EvaluateOptions& options) {
  std::vector<std::string> notes;
  if (!options.sequence_lengths.empty()) {
    notes.push_back(
        "Sequence lengths: the recent path that is no history is as long as "
        "the sequence, so that true loops differ too; checks begin at two "
        "sequence lengths or " +
        Fixed(options.judging.first_check_meters, 0) +
        " m, whichever is later.");
  }
  if (options.baselines) {
    notes.push_back(
        "nearest position: estimates within 15 m, all accepted. single pose: "
        "the best log-similarity of one node. paper: the log-similarities of "
        "all nodes of the sequence summed, without and with "
        "cross-covariance.");
  }
  if (!options.seeds.empty()) {
    notes.push_back("Simulated: estimates drawn along the true paths, " +
                    std::to_string(options.seeds.size()) +
                    " seeds; one row holds all seeds of a drive.");
  }
  if (options.uncertainty.claimed_scale != 1.0) {
    notes.push_back("Claimed standard deviations are multiplied by " +
                    Fixed(options.uncertainty.claimed_scale, 3) + ".");
  }
  if (options.verify) {
    notes.push_back(
        "Verified: accepted first candidates that are right became loop "
        "closures, wrong ones were rejected.");
  }
  if (options.format == EvaluateOptions::Format::kRtklib) {
    notes.push_back(
        "GNSS: the truth is the reference that was recorded beside it; heading "
        "is the direction of the velocity; epochs slower than " +
        Fixed(kGnssStandstillMetersPerSecond, 1) + " m/s are left out.");
  }
  return notes;
}

// The part of reading that opens a file.
template <typename Read>
auto ReadFile(const std::string& path, const Read& read)
    -> decltype(read(std::declval<std::istream&>(), path)) {
  const auto input = OpenText(path);
  if (!input.ok()) return LocalError(input.status());
  auto value = read(**input, path);
  if (!value.ok()) return LocalError(value.status());
  return value;
}

absl::StatusOr<std::vector<Drive>> ReadGnssDrives(
    const EvaluateOptions& options) {
  std::vector<Drive> drives;
  std::optional<GeodeticPosition> origin;
  for (std::size_t i = 0; i < options.files.size(); ++i) {
    const auto fixes = ReadFile(options.files[i], ReadRtklib);
    if (!fixes.ok()) return fixes.status();
    const auto reference = ReadFile(options.truth_files[i], ReadReference);
    if (!reference.ok()) return reference.status();
    if (!origin.has_value() || !options.one_vehicle) {
      origin = fixes->front().position;
    }
    auto drive =
        MakeGnssDrive(StemOf(options.files[i]), *fixes, *reference, *origin);
    if (!drive.ok()) return LocalError(drive.status());
    drives.push_back(*std::move(drive));
  }
  return drives;
}

absl::StatusOr<std::vector<Drive>> ReadDrives(const EvaluateOptions& options) {
  std::vector<Drive> drives;
  if (options.format == EvaluateOptions::Format::kRtklib) {
    auto read = ReadGnssDrives(options);
    if (!read.ok()) return read.status();
    drives = *std::move(read);
  } else {
    for (const std::string& file : options.files) {
      auto drive = ReadDriveFile(file, DriveFormat::kDrive);
      if (!drive.ok()) return LocalError(drive.status());
      if (drive->truth.empty()) {
        return LocalError(absl::InvalidArgumentError(
            file +
            ":1: expected the columns gt_x, gt_y, gt_yaw, which an "
            "evaluation needs"));
      }
      drives.push_back(*std::move(drive));
    }
  }
  if (!options.one_vehicle || drives.size() == 1) return drives;
  Drive all = std::move(drives[0]);
  for (std::size_t i = 1; i < drives.size(); ++i) {
    all.name += "+" + drives[i].name;
    all.samples.insert(all.samples.end(), drives[i].samples.begin(),
                       drives[i].samples.end());
    all.truth.insert(all.truth.end(), drives[i].truth.begin(),
                     drives[i].truth.end());
  }
  return std::vector<Drive>{std::move(all)};
}

absl::StatusOr<std::vector<Case>> MakeCases(const EvaluateOptions& options,
                                            std::vector<Drive> drives) {
  std::vector<Case> cases;
  for (Drive& drive : drives) {
    if (options.seeds.empty()) {
      cases.push_back({std::move(drive), std::nullopt, {}});
      continue;
    }
    for (const std::uint64_t seed : options.seeds) {
      cases.push_back(
          {SimulateDeadReckoning(drive, options.uncertainty, seed), seed, {}});
    }
  }
  for (Case& one : cases) {
    auto uncertainty = ClaimUncertainty(one.drive, options.uncertainty);
    if (!uncertainty.ok()) return LocalError(uncertainty.status());
    one.uncertainty = *std::move(uncertainty);
  }
  return cases;
}

DriveResult NearestPositionResult(const DriveResult& other,
                                  const Method& method) {
  NearestPosition options;
  options.excluded_nodes = method.judging.excluded_nodes;
  options.separation_meters = method.settings.candidate_separation_meters();
  options.max_candidates =
      static_cast<std::size_t>(std::max(1, method.settings.max_candidates()));
  std::vector<std::int64_t> queries;
  for (const CheckAnswer& answer : other.answers) {
    queries.push_back(answer.query);
  }
  DriveResult result;
  result.drive = other.drive;
  result.seed = other.seed;
  result.nodes = other.nodes;
  result.truth_at_nodes = other.truth_at_nodes;
  result.answers = FindNearestPositions(result.nodes, queries, options);
  result.checks = Judge(result.nodes, result.truth_at_nodes, result.answers,
                        method.judging);
  result.tally = Count(result.checks);
  result.tally.poses = other.tally.poses;
  result.tally.jumps = other.tally.jumps;
  return result;
}

class Evaluation {
 public:
  Evaluation(const EvaluateOptions& options, std::vector<Case> cases,
             const std::shared_ptr<grpc::Channel>& channel,
             const Client& client, Undoing* undoing, const Console& console)
      : options_(options),
        cases_(std::move(cases)),
        channel_(channel),
        client_(client),
        undoing_(undoing),
        console_(console) {}

  absl::Status Run() {
    Report report;
    report.verified = options_.verify;
    report.repeats = options_.repeats;
    report.notes = NotesOn(options_);
    methods_ = ChooseMethods(options_, &report.main);
    auto methods = RunMethods();
    if (!methods.ok()) return methods.status();
    report.methods = *std::move(methods);
    for (int repeat = 2; repeat <= options_.repeats; ++repeat) {
      const auto again = RunMethods();
      if (!again.ok()) return again.status();
      if (absl::Status same = Merge(*again, repeat, &report.methods);
          !same.ok()) {
        return same;
      }
    }
    if (options_.repeats > 1) {
      report.notes.push_back("Repeated: " + std::to_string(options_.repeats) +
                             " times, all answers the same; timings are over "
                             "all of them.");
    }
    const MethodResult& main = report.methods[report.main];
    if (options_.verbose && !console_.json) {
      for (const DriveResult& result : main.drives) {
        PrintChecks(result, console_.out);
      }
    }
    if (!options_.map.empty()) {
      const absl::Status written = WriteMap(main.drives[0]);
      if (!written.ok()) return written;
    }
    if (!options_.plots.empty()) {
      const absl::Status written = WritePlots(report);
      if (!written.ok()) return written;
    }
    if (console_.json) {
      console_.out << ReportJson(report, options_.verbose) << '\n';
    } else {
      PrintReport(report, console_.out);
    }
    return absl::OkStatus();
  }

 private:
  absl::StatusOr<std::vector<MethodResult>> RunMethods() {
    std::vector<MethodResult> results;
    for (const Method& method : methods_) {
      MethodResult result;
      result.method = method.name;
      result.sequence_length_meters = method.sequence_length_meters;
      for (std::size_t i = 0; i < cases_.size(); ++i) {
        if (method.source == Method::Source::kNearestPosition) {
          result.drives.push_back(
              NearestPositionResult(results.back().drives[i], method));
          continue;
        }
        auto drive = RunCase(method, cases_[i]);
        if (!drive.ok()) return drive.status();
        result.drives.push_back(*std::move(drive));
      }
      results.push_back(std::move(result));
    }
    return results;
  }

  absl::StatusOr<DriveResult> RunCase(const Method& method, const Case& one) {
    DriveRun run;
    run.vehicle_id = options_.vehicle.empty() ? UniqueVehicleId(one.drive.name)
                                              : options_.vehicle;
    run.settings = method.settings;
    run.label = one.drive.name;
    if (one.seed.has_value()) {
      run.label += ", seed " + std::to_string(*one.seed);
    }
    if (methods_.size() > 1) {
      run.label += ", " + method.name + " at " +
                   Fixed(method.sequence_length_meters, 0) + " m";
    }
    run.judging = method.judging;
    run.exhaustive = options_.exhaustive;
    run.verify = options_.verify;
    if (method.source == Method::Source::kServiceBeyondRecentPath) {
      run.older_candidates = static_cast<std::size_t>(
          std::max(1, options_.settings.max_candidates()));
    }
    const auto created = [this](const v1::Vehicle& vehicle) {
      // A private server's vehicles go too, lest they pile up.
      if (!(options_.server.has_value() && options_.keep_vehicles) &&
          vehicle.durable_sequence() == 0) {
        undoing_->AddVehicle(vehicle.name());
      }
    };
    auto result = EvaluateDrive(channel_, client_, one.drive, one.uncertainty,
                                run, created, console_);
    if (!result.ok()) return result.status();
    if (absl::Status deleted = undoing_->DeleteVehicles(); !deleted.ok()) {
      return deleted;
    }
    result->seed = one.seed;
    return result;
  }

  // Adds the timings of a repeat to the first run, whose answers must be the
  // same.
  absl::Status Merge(const std::vector<MethodResult>& again, int repeat,
                     std::vector<MethodResult>* methods) const {
    for (std::size_t m = 0; m < again.size(); ++m) {
      for (std::size_t d = 0; d < again[m].drives.size(); ++d) {
        const DriveResult& other = again[m].drives[d];
        DriveResult& first = (*methods)[m].drives[d];
        const auto differs = [&](const std::string& what) {
          return LocalError(absl::AbortedError(
              "repeat " + std::to_string(repeat) + " of " + first.drive + ", " +
              again[m].method + ": " + what +
              " differ from the first run's; with the same poses all answers "
              "should be the same"));
        };
        if (!std::equal(first.answers.begin(), first.answers.end(),
                        other.answers.begin(), other.answers.end(),
                        SameAnswer)) {
          return differs("answers");
        }
        if (first.tally.confirmed != other.tally.confirmed ||
            first.tally.rejected != other.tally.rejected ||
            first.inflation != other.inflation) {
          return differs("what the verifier found, or the inflation,");
        }
        first.tally.search_milliseconds.insert(
            first.tally.search_milliseconds.end(),
            other.tally.search_milliseconds.begin(),
            other.tally.search_milliseconds.end());
        first.tally.timed_poses += other.tally.timed_poses;
        first.tally.seconds += other.tally.seconds;
      }
    }
    return absl::OkStatus();
  }

  static absl::Status Write(const std::string& path, const std::string& text) {
    std::ofstream file(path, std::ios::binary | std::ios::trunc);
    file << text;
    file.close();
    if (!file) {
      return LocalError(absl::UnknownError(path + ": cannot be written"));
    }
    return absl::OkStatus();
  }

  absl::Status WriteMap(const DriveResult& result) const {
    if (result.nodes.empty()) {
      return LocalError(absl::FailedPreconditionError(
          result.drive +
          ": there is nothing to draw, the pose graph is empty"));
    }
    const Tally& t = result.tally;
    MapContents contents;
    contents.title = "Loop-closure candidates: " + result.drive;
    contents.subtitle =
        Fixed(result.nodes.back().travelled_meters / 1000.0, 1) + " km, " +
        std::to_string(t.checks) + " checks, " + std::to_string(t.true_loops) +
        " true loops; " + std::to_string(t.accepted) +
        " candidates accepted, " + std::to_string(t.accepted_correct) +
        " of them right";
    if (t.precision().has_value() && t.recall().has_value()) {
      contents.subtitle += " (precision " + Fixed(*t.precision(), 2) +
                           ", recall " + Fixed(*t.recall(), 2) + ")";
    }
    contents.nodes = result.nodes;
    contents.truth_at_nodes = result.truth_at_nodes;
    contents.one_frame = options_.format == EvaluateOptions::Format::kRtklib;
    contents.checks = result.checks;
    return Write(options_.map, DrawMap(contents));
  }

  absl::Status WritePlots(const Report& report) const {
    std::error_code error;
    std::filesystem::create_directories(options_.plots, error);
    if (error) {
      return LocalError(
          absl::UnknownError(options_.plots + ": " + error.message()));
    }
    const Tally main = TotalOf(report.methods[report.main]);
    const std::string subtitle =
        std::to_string(report.methods[report.main].drives.size()) +
        (report.methods[report.main].drives.size() == 1 ? " drive, "
                                                        : " drives, ") +
        std::to_string(main.checks) + " checks, " +
        std::to_string(main.true_loops) + " true loops";
    std::vector<PlottedCurve> curves;
    for (const MethodResult& method : report.methods) {
      const Tally total = TotalOf(method);
      PlottedCurve curve;
      curve.name = method.method;
      if (!options_.sequence_lengths.empty()) {
        curve.name += ", " + Fixed(method.sequence_length_meters, 0) + " m";
      }
      curve.curve = PrecisionRecallCurve(total.confidences, total.true_loops);
      curve.precision = total.precision();
      curve.recall = total.recall();
      curves.push_back(std::move(curve));
    }
    const std::string directory = options_.plots + "/";
    if (absl::Status written = Write(directory + "precision_recall.svg",
                                     DrawPrecisionRecall(subtitle, curves));
        !written.ok()) {
      return written;
    }
    return Write(directory + "reliability.svg",
                 DrawReliability(subtitle, Reliability(main.probabilities),
                                 main.calibration_error()));
  }

  const EvaluateOptions& options_;
  const std::vector<Case> cases_;
  const std::shared_ptr<grpc::Channel> channel_;
  const Client& client_;
  Undoing* const undoing_;
  const Console& console_;
  std::vector<Method> methods_;
};

}  // namespace

absl::Status RunEvaluate(const EvaluateOptions& given, const Console& console) {
  EvaluateOptions options = given;
  if (options.format == EvaluateOptions::Format::kRtklib) {
    options.settings.set_coordinate_frame(v1::COORDINATE_FRAME_GEODETIC);
    options.uncertainty.source = UncertaintyOptions::Source::kFixes;
  }
  // All files are read before the first is streamed, so that a mistake in the
  // last shows at once.
  auto drives = ReadDrives(options);
  if (!drives.ok()) return drives.status();
  auto cases = MakeCases(options, *std::move(drives));
  if (!cases.ok()) return cases.status();
  Undoing undoing;
  const InterruptGuard guard([&undoing] { (void)undoing.Undo(); });
  if (!options.server.has_value()) {
    if (absl::Status status = undoing.server()->Start(); !status.ok()) {
      return LocalError(status);
    }
  }
  ChannelOptions server;
  server.address = undoing.server()->address();
  const auto made = MakeChannel(options.server.value_or(server));
  if (!made.ok()) return LocalError(made.status());
  const std::shared_ptr<grpc::Channel>& channel = *made;
  const Client client(channel);
  undoing.SetClient(&client);
  const absl::Status status =
      Evaluation(options, *std::move(cases), channel, client, &undoing, console)
          .Run();
  const absl::Status undone = undoing.Undo();
  return status.ok() ? undone : status;
}

}  // namespace revisit::client
