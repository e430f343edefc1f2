#include "client/evaluation/run_evaluation.h"

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <memory>
#include <random>
#include <set>
#include <string>
#include <utility>
#include <vector>

#include "absl/status/statusor.h"
#include "absl/strings/str_cat.h"
#include "client/evaluation/baselines.h"
#include "client/evaluation/cases.h"
#include "client/evaluation/drawings.h"
#include "client/evaluation/drive_evaluator.h"
#include "client/evaluation/evaluation_report.h"
#include "client/evaluation/methods.h"
#include "client/evaluation/private_server.h"
#include "client/revisit/channel.h"
#include "client/revisit/client.h"
#include "client/terminal/interrupt_guard.h"
#include "core/base/mutex.h"
#include "grpcpp/channel.h"

namespace revisit::client {
namespace {

// Vehicles to delete and a server to stop, at the end or when Ctrl-C is
// pressed: then Undo() runs on another thread.
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

  // Deletes the vehicles that were added since the last call.
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

// An id that nobody else takes: the drive's name, with dashes for what ids may
// not hold, and a random number.
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

// Says how many checks pass a place that was passed the other way alone, where
// only passes the same way are looked for.
void NoteOppositePasses(const MethodResult& result, const Judging& judging,
                        std::vector<std::string>* notes) {
  if (judging.direction != PassDirection::kSame) return;
  Judging opposite = judging;
  opposite.direction = PassDirection::kOpposite;
  opposite.only_revisited = false;
  std::int64_t passes = 0;
  for (const DriveResult& drive : result.drives) {
    std::set<std::int64_t> same;
    for (const JudgedCheck& check : drive.checks) {
      if (check.true_loop) same.insert(check.answer.query);
    }
    for (const JudgedCheck& check :
         Judge(drive.nodes, drive.truth_at_nodes, drive.answers, opposite)) {
      passes += check.true_loop && same.count(check.answer.query) == 0;
    }
  }
  if (passes == 0) return;
  notes->push_back(absl::StrCat(
      "Direction: ", passes,
      " checks that are no true loops here lie where the vehicle had passed in "
      "the opposite direction; --direction either looks for these passes "
      "too."));
}

class Evaluation {
 public:
  Evaluation(const EvaluateOptions& options, std::vector<Case> cases,
             const std::shared_ptr<grpc::Channel>& channel,
             const Client& client, Undoing* undoing, const Terminal& terminal)
      : options_(options),
        cases_(std::move(cases)),
        channel_(channel),
        client_(client),
        undoing_(undoing),
        terminal_(terminal) {}

  absl::Status Run() {
    Report report;
    report.verified = options_.verify;
    report.recordings = options_.recordings.has_value();
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
      report.notes.push_back(absl::StrCat(
          "Repeated: ", options_.repeats,
          " times, all answers the same; timings are over all of them."));
    }
    if (!report.recordings) {
      NoteOppositePasses(report.methods[report.main], options_.judging,
                         &report.notes);
    }
    return WriteOut(report);
  }

 private:
  absl::Status WriteOut(const Report& report) const {
    const MethodResult& main = report.methods[report.main];
    if (options_.verbose && !terminal_.json()) {
      for (const DriveResult& result : main.drives) {
        PrintChecks(result, terminal_.out, terminal_.width);
      }
    }
    if (!options_.map.empty()) {
      const absl::Status written = WriteMap(options_, main.drives[0]);
      if (!written.ok()) return written;
    }
    if (!options_.plots.empty()) {
      const absl::Status written = WritePlots(options_, report);
      if (!written.ok()) return written;
    }
    if (terminal_.json()) {
      terminal_.out << ReportJson(report, options_.verbose) << '\n';
    } else {
      PrintReport(report, terminal_.out, terminal_.width);
    }
    return absl::OkStatus();
  }

  absl::StatusOr<std::vector<MethodResult>> RunMethods() {
    std::vector<MethodResult> results;
    for (const Method& method : methods_) {
      MethodResult result;
      result.method = method.name;
      result.sequence_length_meters = method.sequence_length_meters;
      result.claimed_scale = method.claimed_scale;
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
      absl::StrAppend(&run.label, ", seed ", *one.seed);
    }
    if (methods_.size() > 1) {
      absl::StrAppend(&run.label, ", ", method.name, " at ",
                      Fixed(method.sequence_length_meters, 0), " m");
    }
    std::vector<ClaimedUncertainty> uncertainty = one.uncertainty;
    if (method.claimed_scale.has_value()) {
      absl::StrAppend(&run.label, ", claimed x ", *method.claimed_scale);
      ScaleClaims(*method.claimed_scale, &uncertainty);
    }
    run.judging = method.judging;
    run.exhaustive = options_.exhaustive;
    run.verify = options_.verify;
    run.verifier_errors = options_.verifier_errors;
    run.seed = one.seed.value_or(0);
    run.asking_from = one.asking_from;
    if (method.source == Method::Source::kServiceBeyondRecentPath) {
      run.older_candidates = static_cast<std::size_t>(
          std::max(1, options_.settings.max_candidates()));
    }
    const auto created = [this](const v1::Vehicle& vehicle) {
      // A private server's vehicles go too, lest they pile up.
      if (!options_.keep_vehicles && vehicle.durable_sequence() == 0) {
        undoing_->AddVehicle(vehicle.name());
      }
    };
    auto result = EvaluateDrive(channel_, client_, one.drive, uncertainty,
                                one.starts, run, created, terminal_);
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
          return LocalError(absl::AbortedError(absl::StrCat(
              "repeat ", repeat, " of ", first.drive, ", ", again[m].method,
              ": ", what,
              " differ from the first run's; with the same poses all answers "
              "should be the same")));
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

  const EvaluateOptions& options_;
  const std::vector<Case> cases_;
  const std::shared_ptr<grpc::Channel> channel_;
  const Client& client_;
  Undoing* const undoing_;
  const Terminal& terminal_;
  std::vector<Method> methods_;
};

}  // namespace

absl::Status RunEvaluate(const EvaluateOptions& given,
                         const Terminal& terminal) {
  EvaluateOptions options = given;
  auto cases = ReadCases(&options);
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
  absl::Status status = Evaluation(options, *std::move(cases), channel, client,
                                   &undoing, terminal)
                            .Run();
  if (status.ok() && options.before_undoing) {
    status = options.before_undoing(options.server.value_or(server).address);
  }
  const absl::Status undone = undoing.Undo();
  return status.ok() ? undone : status;
}

}  // namespace revisit::client
