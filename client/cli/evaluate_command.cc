#include "client/cli/evaluate_command.h"

#include <algorithm>
#include <chrono>
#include <cmath>
#include <cstdint>
#include <fstream>
#include <memory>
#include <mutex>
#include <random>
#include <utility>

#include "absl/status/statusor.h"
#include "client/cli/drive_poses.h"
#include "client/cli/interrupt_guard.h"
#include "client/cli/map_svg.h"
#include "client/cli/names.h"
#include "client/cli/private_server.h"
#include "client/revisit/channel.h"
#include "client/revisit/client.h"
#include "client/revisit/pose_stream.h"
#include "client/revisit/status.h"
#include "google/protobuf/util/time_util.h"
#include "grpcpp/channel.h"
#include "nlohmann/json.hpp"

namespace revisit::client {
namespace {

using Clock = std::chrono::steady_clock;
using Json = nlohmann::ordered_json;
using Verdict = CandidateAnswer::Verdict;

constexpr std::size_t kBatchPoses = 64;

struct DriveResult {
  std::string drive;
  std::vector<GraphNode> nodes;
  std::vector<PlanarPose> truth_at_nodes;
  std::vector<JudgedCheck> checks;
  Tally tally;
};

// What has to be undone, also when Ctrl-C is pressed: then Undo() runs on
// another thread.
class Undoing {
 public:
  PrivateServer* server() { return &server_; }

  void SetClient(const Client* client) {
    std::lock_guard<std::mutex> lock(mutex_);
    client_ = client;
  }
  void AddVehicle(const std::string& name) {
    std::lock_guard<std::mutex> lock(mutex_);
    vehicles_.push_back(name);
  }

  absl::Status Undo() {
    std::lock_guard<std::mutex> lock(mutex_);
    absl::Status first;
    for (const std::string& name : vehicles_) {
      v1::DeleteVehicleRequest request;
      request.set_name(name);
      const absl::Status status = client_->DeleteVehicle(request).status();
      if (!status.ok() && !absl::IsNotFound(status)) first.Update(status);
    }
    vehicles_.clear();
    server_.Stop();
    return first;
  }

 private:
  std::mutex mutex_;
  PrivateServer server_;
  const Client* client_ = nullptr;
  std::vector<std::string> vehicles_;
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

CheckAnswer MakeAnswer(const v1::CandidateSet& set) {
  CheckAnswer answer;
  answer.query = set.query().index();
  answer.search_milliseconds =
      1e-6 * static_cast<double>(
                 google::protobuf::util::TimeUtil::DurationToNanoseconds(
                     set.search_duration()));
  for (const v1::Candidate& candidate : set.candidates()) {
    const v1::Gate& gate = candidate.gate();
    const Verdict verdict = gate.verdict() == v1::GATE_VERDICT_ACCEPTED
                                ? Verdict::kAccepted
                            : gate.verdict() == v1::GATE_VERDICT_REJECTED
                                ? Verdict::kRejected
                                : Verdict::kIllConditioned;
    answer.candidates.push_back({candidate.matched().index(), verdict,
                                 gate.squared_mahalanobis_distance(),
                                 gate.threshold(), gate.p_value()});
  }
  if (set.candidates().empty()) {
    answer.empty_reason = Explain(set.empty_reason());
  }
  return answer;
}

struct Streamed {
  std::vector<CheckAnswer> answers;
  double seconds = 0.0;
};

absl::StatusOr<Streamed> StreamDrive(
    const std::shared_ptr<grpc::Channel>& channel, const std::string& vehicle,
    const Drive& drive, const std::vector<ClaimedUncertainty>& uncertainty,
    const Console& console) {
  Progress progress(console, drive.name, drive.samples.size(), "poses");
  // Written by callbacks, read when they are over.
  Streamed streamed;
  PoseStreamOptions options;
  options.batch_poses = static_cast<int>(kBatchPoses);
  options.send_candidates = true;
  options.give_up_after = std::chrono::seconds(30);
  PoseStreamCallbacks callbacks;
  callbacks.ack = [&](const v1::Ack& ack) {
    progress.Update(ack.durable_sequence());
    for (const v1::Jump& jump : ack.jumps()) {
      progress.Note("jump of " + Fixed(jump.distance_meters(), 1) +
                    " m before sequence " + std::to_string(jump.sequence()));
    }
  };
  callbacks.candidates = [&](const v1::CandidateSet& set) {
    streamed.answers.push_back(MakeAnswer(set));
  };
  PoseStream stream(channel, vehicle, options, callbacks);
  const auto durable = stream.WaitUntilOpened();
  if (!durable.ok()) return durable.status();
  if (*durable != 0) {
    return LocalError(absl::FailedPreconditionError(
        vehicle + " has poses already; an evaluation needs a new vehicle"));
  }
  const auto start = Clock::now();
  for (std::size_t next = 0; next < drive.samples.size();) {
    v1::PoseBatch batch;
    const std::size_t end = std::min(drive.samples.size(), next + kBatchPoses);
    for (; next < end; ++next) {
      *batch.add_poses() =
          MakePose(drive, uncertainty, v1::STATE_SPACE_PLANAR, next);
    }
    // Why it failed is what Finish() says as well.
    if (!stream.Append(std::move(batch)).ok()) break;
  }
  if (absl::Status status = stream.Finish(); !status.ok()) return status;
  streamed.seconds =
      std::chrono::duration<double>(Clock::now() - start).count();
  if (stream.reconnects() > 0) {
    return absl::UnavailableError("the connection broke while " + drive.name +
                                  " was streamed; answers of checks may be "
                                  "lost, so the figures would not "
                                  "be comparable: run it again");
  }
  return streamed;
}

absl::StatusOr<std::vector<GraphNode>> FetchNodes(const Client& client,
                                                  const std::string& vehicle,
                                                  std::size_t poses) {
  std::vector<GraphNode> nodes;
  v1::ExportPoseGraphRequest request;
  request.set_vehicle(vehicle);
  const absl::Status status = client.ExportPoseGraph(
      request, [&](const v1::ExportPoseGraphResponse& part) {
        for (const v1::Node& node : part.nodes()) {
          if (node.index() != static_cast<std::int64_t>(nodes.size()) ||
              node.sequence() < 1 || node.sequence() > poses ||
              node.covariance().form() != v1::COVARIANCE_FORM_PLANAR_6 ||
              node.covariance().values_size() != 6) {
            return absl::InternalError("the export's node " +
                                       std::to_string(node.index()) +
                                       " is not what was expected");
          }
          const auto& covariance = node.covariance().values();
          nodes.push_back(
              {node.sequence(), node.fraction(), node.travelled_meters(),
               PlanarPose{node.pose().x_meters(), node.pose().y_meters(),
                          node.pose().heading_radians()},
               covariance[0], covariance[1], covariance[3]});
        }
        return absl::OkStatus();
      });
  if (!status.ok()) return status;
  return nodes;
}

absl::StatusOr<Drive> ReadDriveWithTruth(const std::string& file) {
  auto drive = ReadDriveFile(file, DriveFormat::kDrive);
  if (!drive.ok()) return LocalError(drive.status());
  if (drive->truth.empty()) {
    return LocalError(absl::InvalidArgumentError(
        file +
        ":1: expected the columns gt_x, gt_y, gt_yaw, which an "
        "evaluation needs"));
  }
  return drive;
}

absl::StatusOr<DriveResult> EvaluateDrive(
    const std::shared_ptr<grpc::Channel>& channel, const Client& client,
    const Drive& drive, const EvaluateOptions& options, Undoing* undoing,
    const Console& console) {
  const auto uncertainty = ClaimUncertainty(drive, options.uncertainty);
  if (!uncertainty.ok()) return LocalError(uncertainty.status());
  v1::CreateVehicleRequest create;
  create.set_vehicle_id(options.vehicle.empty() ? UniqueVehicleId(drive.name)
                                                : options.vehicle);
  *create.mutable_vehicle()->mutable_settings() = options.settings;
  const auto created = client.CreateVehicle(create);
  if (!created.ok()) return created.status();
  const v1::Vehicle& vehicle = created->vehicle();
  // A private server's store goes as a whole.
  if (options.server.has_value() && !options.keep_vehicles &&
      vehicle.durable_sequence() == 0) {
    undoing->AddVehicle(vehicle.name());
  }
  const auto streamed =
      StreamDrive(channel, vehicle.name(), drive, *uncertainty, console);
  if (!streamed.ok()) return streamed.status();
  auto nodes = FetchNodes(client, vehicle.name(), drive.samples.size());
  if (!nodes.ok()) return nodes.status();
  for (const CheckAnswer& answer : streamed->answers) {
    const auto known = [&](std::int64_t index) {
      return index >= 0 && index < static_cast<std::int64_t>(nodes->size());
    };
    if (!known(answer.query) ||
        !std::all_of(answer.candidates.begin(), answer.candidates.end(),
                     [&](const CandidateAnswer& candidate) {
                       return known(candidate.matched);
                     })) {
      return absl::InternalError(
          "a candidate names a node that the export does not have");
    }
  }
  DriveResult result;
  result.drive = drive.name;
  result.nodes = std::move(*nodes);
  result.truth_at_nodes = TruthAtNodes(result.nodes, drive.truth);
  result.checks = Judge(result.nodes, result.truth_at_nodes, streamed->answers,
                        options.judging);
  result.tally = Count(result.checks);
  result.tally.poses = static_cast<std::int64_t>(drive.samples.size());
  result.tally.seconds = streamed->seconds;
  return result;
}

std::string NameOf(Verdict verdict) {
  switch (verdict) {
    case Verdict::kAccepted:
      return "ACCEPTED";
    case Verdict::kRejected:
      return "REJECTED";
    case Verdict::kIllConditioned:
      return "ILL_CONDITIONED";
  }
  return "";
}

std::string OutcomeOf(const JudgedCheck& check) {
  if (check.top_correct()) return "right";
  return check.true_loop ? "wrong" : "no loop";
}

void PrintChecks(const DriveResult& result, std::ostream& out) {
  using Align = Table::Align;
  Table table({{"CHECK", Align::kRight},
               {"AT m", Align::kRight},
               {"CANDIDATE m", Align::kRight},
               {"D2", Align::kRight},
               {"THRESHOLD", Align::kRight},
               {"P-VALUE", Align::kRight},
               {"VERDICT", Align::kLeft},
               {"TRUTH", Align::kLeft}});
  int number = 0;
  for (const JudgedCheck& check : result.checks) {
    const auto travelled = [&](std::int64_t node) {
      return Fixed(
          result.nodes[static_cast<std::size_t>(node)].travelled_meters, 1);
    };
    ++number;
    if (check.answer.candidates.empty()) {
      table.AddRow({std::to_string(number), travelled(check.answer.query), "-",
                    "-", "-", "-", "NONE", OutcomeOf(check)});
      continue;
    }
    const CandidateAnswer& best = check.answer.candidates[0];
    table.AddRow({std::to_string(number), travelled(check.answer.query),
                  travelled(best.matched), Fixed(best.squared_distance, 2),
                  Fixed(best.threshold, 2), Fixed(best.p_value, 4),
                  NameOf(best.verdict), OutcomeOf(check)});
  }
  out << result.drive << ": the best candidate of each check\n";
  table.Print(out);
  out << '\n';
}

std::string OrDash(std::optional<double> value, int digits) {
  return value.has_value() ? Fixed(*value, digits) : "-";
}

void PrintSummary(const DriveResult& result, std::ostream& out) {
  const Tally& t = result.tally;
  PrintFields(
      {{"drive", result.drive},
       {"checks", std::to_string(t.checks)},
       {"true loops", std::to_string(t.true_loops)},
       {"accepted", std::to_string(t.accepted)},
       {"correct", std::to_string(t.accepted_correct)},
       {"precision", OrDash(t.precision(), 3)},
       {"recall", OrDash(t.recall(), 3)},
       {"F1", OrDash(t.f1(), 3)},
       {"first correct", std::to_string(t.top1_correct) + " (gate aside)"},
       {"one of 5 correct", std::to_string(t.top5_correct) + " (gate aside)"},
       {"candidates to verify",
        std::to_string(t.to_verify) + ", " + OrDash(t.to_verify_per_loop(), 2) +
            " for each of the " + std::to_string(t.loops_found) +
            " loops found"},
       {"poses", std::to_string(t.poses) + ", " +
                     OrDash(t.poses_per_second(), 0) + "/s with all checks"},
       {"query time", "p50 " + OrDash(t.search_percentile(50.0), 2) +
                          " ms, p99 " + OrDash(t.search_percentile(99.0), 2) +
                          " ms"}},
      out);
}

void PrintTable(const std::vector<DriveResult>& results, const Tally& total,
                std::ostream& out) {
  using Align = Table::Align;
  Table table({{"DRIVE", Align::kLeft},
               {"CHECKS", Align::kRight},
               {"LOOPS", Align::kRight},
               {"ACCEPTED", Align::kRight},
               {"CORRECT", Align::kRight},
               {"PRECISION", Align::kRight},
               {"RECALL", Align::kRight},
               {"F1", Align::kRight},
               {"TOP 1", Align::kRight},
               {"TOP 5", Align::kRight},
               {"VERIFY/LOOP", Align::kRight},
               {"POSES/s", Align::kRight},
               {"p50 ms", Align::kRight},
               {"p99 ms", Align::kRight}});
  const auto add = [&](const std::string& name, const Tally& t) {
    table.AddRow(
        {name, std::to_string(t.checks), std::to_string(t.true_loops),
         std::to_string(t.accepted), std::to_string(t.accepted_correct),
         OrDash(t.precision(), 3), OrDash(t.recall(), 3), OrDash(t.f1(), 3),
         std::to_string(t.top1_correct), std::to_string(t.top5_correct),
         OrDash(t.to_verify_per_loop(), 2), OrDash(t.poses_per_second(), 0),
         OrDash(t.search_percentile(50.0), 2),
         OrDash(t.search_percentile(99.0), 2)});
  };
  for (const DriveResult& result : results) add(result.drive, result.tally);
  table.AddRule();
  add("total", total);
  table.Print(out);
}

Json OrNull(std::optional<double> value) {
  return value.has_value() ? Json(*value) : Json(nullptr);
}

Json TallyJson(const std::string& drive, const Tally& t) {
  Json json;
  json["drive"] = drive;
  json["checks"] = t.checks;
  json["true_loops"] = t.true_loops;
  json["accepted"] = t.accepted;
  json["accepted_correct"] = t.accepted_correct;
  json["top1_correct"] = t.top1_correct;
  json["top5_correct"] = t.top5_correct;
  json["precision"] = OrNull(t.precision());
  json["recall"] = OrNull(t.recall());
  json["f1"] = OrNull(t.f1());
  json["candidates_to_verify"] = t.to_verify;
  json["loops_found"] = t.loops_found;
  json["candidates_per_loop_found"] = OrNull(t.to_verify_per_loop());
  json["query_ms_p50"] = OrNull(t.search_percentile(50.0));
  json["query_ms_p99"] = OrNull(t.search_percentile(99.0));
  json["poses"] = t.poses;
  json["poses_per_second"] = OrNull(t.poses_per_second());
  return json;
}

Json ChecksJson(const DriveResult& result) {
  Json list = Json::array();
  for (const JudgedCheck& check : result.checks) {
    const auto travelled = [&](std::int64_t node) {
      return result.nodes[static_cast<std::size_t>(node)].travelled_meters;
    };
    Json entry;
    entry["node"] = check.answer.query;
    entry["travelled_meters"] = travelled(check.answer.query);
    entry["true_loop"] = check.true_loop;
    entry["query_ms"] = check.answer.search_milliseconds;
    entry["empty_reason"] = check.answer.empty_reason;
    entry["candidates"] = Json::array();
    for (std::size_t i = 0; i < check.answer.candidates.size(); ++i) {
      const CandidateAnswer& candidate = check.answer.candidates[i];
      Json item;
      item["matched_node"] = candidate.matched;
      item["matched_travelled_meters"] = travelled(candidate.matched);
      item["squared_mahalanobis_distance"] = candidate.squared_distance;
      item["threshold"] = candidate.threshold;
      item["p_value"] = candidate.p_value;
      item["verdict"] = NameOf(candidate.verdict);
      item["correct"] = static_cast<bool>(check.correct[i]);
      entry["candidates"].push_back(std::move(item));
    }
    list.push_back(std::move(entry));
  }
  return list;
}

absl::Status WriteMap(const DriveResult& result, const std::string& path) {
  if (result.nodes.empty()) {
    return LocalError(absl::FailedPreconditionError(
        result.drive + ": there is nothing to draw, the pose graph is empty"));
  }
  const Tally& t = result.tally;
  MapContents contents;
  contents.title = "Loop-closure candidates: " + result.drive;
  contents.subtitle = Fixed(result.nodes.back().travelled_meters / 1000.0, 1) +
                      " km, " + std::to_string(t.checks) + " checks, " +
                      std::to_string(t.true_loops) + " true loops; " +
                      std::to_string(t.accepted) + " candidates accepted, " +
                      std::to_string(t.accepted_correct) + " of them right";
  if (t.precision().has_value() && t.recall().has_value()) {
    contents.subtitle += " (precision " + Fixed(*t.precision(), 2) +
                         ", recall " + Fixed(*t.recall(), 2) + ")";
  }
  contents.nodes = result.nodes;
  contents.truth_at_nodes = result.truth_at_nodes;
  contents.checks = result.checks;
  std::ofstream file(path, std::ios::binary | std::ios::trunc);
  file << DrawMap(contents);
  file.close();
  if (!file) {
    return LocalError(absl::UnknownError(path + ": cannot be written"));
  }
  return absl::OkStatus();
}

void PrintResults(const std::vector<DriveResult>& results, bool verbose,
                  const Console& console) {
  Tally total;
  for (const DriveResult& result : results) total.Add(result.tally);
  if (!console.json) {
    if (results.size() == 1) {
      PrintSummary(results[0], console.out);
    } else {
      PrintTable(results, total, console.out);
    }
    return;
  }
  Json json;
  json["drives"] = Json::array();
  for (const DriveResult& result : results) {
    Json drive = TallyJson(result.drive, result.tally);
    if (verbose) drive["check_list"] = ChecksJson(result);
    json["drives"].push_back(std::move(drive));
  }
  json["total"] = TallyJson("total", total);
  console.out << json.dump(1, ' ', false, Json::error_handler_t::replace)
              << '\n';
}

absl::Status EvaluateAll(const EvaluateOptions& options, Undoing* undoing,
                         const Client& client,
                         const std::shared_ptr<grpc::Channel>& channel,
                         const std::vector<Drive>& drives,
                         const Console& console) {
  std::vector<DriveResult> results;
  for (const Drive& drive : drives) {
    auto result =
        EvaluateDrive(channel, client, drive, options, undoing, console);
    if (!result.ok()) return result.status();
    if (options.verbose && !console.json) PrintChecks(*result, console.out);
    results.push_back(std::move(*result));
  }
  if (!options.map.empty()) {
    if (absl::Status status = WriteMap(results[0], options.map); !status.ok()) {
      return status;
    }
  }
  PrintResults(results, options.verbose, console);
  return absl::OkStatus();
}

}  // namespace

absl::Status RunEvaluate(const EvaluateOptions& given, const Console& console) {
  EvaluateOptions options = given;
  options.judging.excluded_nodes = std::llround(
      options.exclude_meters / options.settings.node_spacing_meters());
  // All files are read before the first is streamed, so that a mistake in the
  // last shows at once.
  std::vector<Drive> drives;
  for (const std::string& file : options.files) {
    auto drive = ReadDriveWithTruth(file);
    if (!drive.ok()) return drive.status();
    drives.push_back(std::move(*drive));
  }
  Undoing undoing;
  const InterruptGuard guard([&undoing] { (void)undoing.Undo(); });
  if (!options.server.has_value()) {
    if (absl::Status status = undoing.server()->Start(); !status.ok()) {
      return LocalError(status);
    }
  }
  const std::shared_ptr<grpc::Channel> channel =
      MakeInsecureChannel(options.server.value_or(undoing.server()->address()));
  const Client client(channel);
  undoing.SetClient(&client);
  const absl::Status status =
      EvaluateAll(options, &undoing, client, channel, drives, console);
  const absl::Status undone = undoing.Undo();
  return status.ok() ? undone : status;
}

}  // namespace revisit::client
