// The whole server over loopback, beside the limits it cannot pass: gRPC with
// nothing behind it, and SQLite with nothing before it. Prints JSON; see
// tests/bench/run.
#include <grpcpp/grpcpp.h>
#include <unistd.h>

#include <algorithm>
#include <atomic>
#include <chrono>
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <filesystem>
#include <memory>
#include <sstream>
#include <string>
#include <thread>
#include <vector>

#include "boost/asio/ip/tcp.hpp"
#include "nlohmann/json.hpp"
#include "revisit/v1/pose_graph_service.grpc.pb.h"
#include "tests/bench/child_process.h"
#include "tests/bench/empty_server.h"
#include "tests/bench/roads.h"
#include "tests/bench/sqlite_loop.h"
#include "tests/bench/stream_load.h"

namespace revisit::bench {
namespace {

using Clock = std::chrono::steady_clock;
using nlohmann::json;

struct Options {
  // Each measurement lasts this long, and all are taken in turn this many
  // times.
  double seconds = 3.0;
  int rounds = 3;
  // Nodes of the vehicle that is asked, and of the one that is asked slowly.
  std::int64_t nodes = 10'000;
  std::int64_t many_nodes = 100'000;
  // Where stores are made.
  std::string directory;
  // If not empty, the URL of a database with tables, to measure streams into
  // beside those into a file.
  std::string shared_store;
  // If not empty, what alone is measured; of streams, only with this many poses
  // a batch, if not 0.
  std::string only;
  int batch_poses = 0;
};

void SleepFor(double seconds) {
  std::this_thread::sleep_for(std::chrono::duration<double>(seconds));
}

std::filesystem::path OwnPath() {
  return std::filesystem::read_symlink("/proc/self/exe");
}

double Quantile(std::vector<double> values, double share) {
  if (values.empty()) return 0.0;
  std::sort(values.begin(), values.end());
  const auto last = static_cast<double>(values.size() - 1);
  return values[static_cast<std::size_t>(std::lround(share * last))];
}

json Latencies(const std::vector<double>& seconds) {
  return {{"count", seconds.size()},
          {"p50_ms", 1e3 * Quantile(seconds, 0.5)},
          {"p99_ms", 1e3 * Quantile(seconds, 0.99)}};
}

// kScraped serves its metrics too.
enum class Kind { kEmpty, kRevisit, kScraped, kShared };

const char* NameOf(Kind kind) {
  switch (kind) {
    case Kind::kEmpty:
      return "empty";
    case Kind::kShared:
      return "shared";
    case Kind::kRevisit:
    case Kind::kScraped:
      break;
  }
  return "revisit";
}

// Vehicles of a shared store outlive the server that made them.
std::string NewVehicleId() {
  static std::atomic<int> made{0};
  return "load-" + std::to_string(getpid()) + "-" + std::to_string(made++);
}

// A server with a store of its own.
class Server {
 public:
  Server(Kind kind, const Options& options)
      : kind_(kind),
        directory_(options.directory),
        process_(Command(kind, kind == Kind::kShared ? options.shared_store
                                                     : directory_.path()),
                 directory_.path() + "/log") {}

  const std::string& address() const { return process_.address(); }
  double cpu_seconds() const { return process_.cpu_seconds(); }
  double peak_bytes() const { return process_.peak_bytes(); }
  std::string store() const { return directory_.path() + "/revisit.sqlite"; }

  void AddVehicle(const std::string& id) {
    if (kind_ != Kind::kEmpty) CreateVehicle(NewChannel(address()), id);
  }

  void Stop() { process_.Stop(); }

  // After Stop(): writes that the store committed together, in the mean.
  double WritesACommit() const {
    const json stopped = LogLine("stopped");
    return stopped.value("writes", 0.0) /
           std::max(1.0, stopped.value("commits", 0.0));
  }

  // One page of /metrics. REQUIRES: this is kScraped.
  std::string Scrape() const {
    const std::string address =
        LogLine("serving").value("admin_address", std::string());
    const std::size_t colon = address.rfind(':');
    if (colon == std::string::npos) Die("no admin_address in the log");
    boost::asio::ip::tcp::iostream connection(address.substr(0, colon),
                                              address.substr(colon + 1));
    connection << "GET /metrics HTTP/1.1\r\nHost: " << address
               << "\r\nConnection: close\r\n\r\n"
               << std::flush;
    std::ostringstream page;
    page << connection.rdbuf();
    if (page.str().find(" 200 OK") == std::string::npos) {
      Die("/metrics: " + page.str());
    }
    return page.str();
  }

 private:
  // The line of the log with this event, or an empty object.
  json LogLine(const std::string& event) const {
    std::istringstream log(process_.Log());
    std::string line;
    while (std::getline(log, line)) {
      json entry = json::parse(line, nullptr, false);
      if (entry.is_object() && entry.value("event", "") == event) return entry;
    }
    return json::object();
  }

  static std::vector<std::string> Command(Kind kind, const std::string& store) {
    const std::filesystem::path self = OwnPath();
    if (kind == Kind::kEmpty) return {self.string(), "--empty-server"};
    std::vector<std::string> command = {
        (self.parent_path() / "revisitd").string(),
        "--listen",
        "127.0.0.1:0",
        "--store",
        store,
        "--log-format",
        "json",
        "--idle-unload-minutes",
        "1000"};
    // Only here: where two commits are compared, the others may be older
    // versions, which do not know the flag.
    if (kind == Kind::kScraped) {
      command.insert(command.end(), {"--admin-listen", "127.0.0.1:0"});
    }
    if (kind == Kind::kShared) {
      // No other server asks.
      command.insert(command.end(), {"--advertise-address", "127.0.0.1:1"});
    }
    return command;
  }

  const Kind kind_;
  const ScratchDirectory directory_;
  ChildProcess process_;
};

// Streams of as many vehicles, each on a connection of its own.
class Streams {
 public:
  Streams(Server* server, int vehicles, const LoadOptions& load) {
    for (int i = 0; i < vehicles; ++i) {
      const std::string id = NewVehicleId();
      server->AddVehicle(id);
      loads_.push_back(std::make_unique<StreamLoad>(
          NewChannel(server->address()), "vehicles/" + id, load));
    }
    for (const auto& one : loads_) one->Start();
  }

  std::uint64_t acked_poses() const {
    std::uint64_t sum = 0;
    for (const auto& one : loads_) sum += one->acked_poses();
    return sum;
  }

  std::vector<double> TakeLatencies() {
    std::vector<double> all;
    for (const auto& one : loads_) {
      const std::vector<double> some = one->TakeLatencies();
      all.insert(all.end(), some.begin(), some.end());
    }
    return all;
  }

  void Stop() {
    for (const auto& one : loads_) one->Stop();
  }

 private:
  std::vector<std::unique_ptr<StreamLoad>> loads_;
};

json MeasureStreams(Kind kind, const Options& options, int vehicles,
                    int batch_poses) {
  Server server(kind, options);
  LoadOptions load;
  load.batch_poses = batch_poses;
  Streams streams(&server, vehicles, load);
  // Until caches and windows are as they stay.
  SleepFor(std::min(0.5, options.seconds / 4.0));
  streams.TakeLatencies();
  const std::uint64_t before = streams.acked_poses();
  const double server_cpu = server.cpu_seconds();
  const double own_cpu = OwnCpuSeconds();
  const Clock::time_point start = Clock::now();
  SleepFor(options.seconds);
  const std::chrono::duration<double> spent = Clock::now() - start;
  const auto poses = static_cast<double>(streams.acked_poses() - before);
  json result = Latencies(streams.TakeLatencies());
  result["poses_per_second"] = poses / spent.count();
  result["server_cpu_us_per_pose"] =
      1e6 * (server.cpu_seconds() - server_cpu) / std::max(1.0, poses);
  result["client_cpu_us_per_pose"] =
      1e6 * (OwnCpuSeconds() - own_cpu) / std::max(1.0, poses);
  streams.Stop();
  result["server_peak_bytes"] = server.peak_bytes();
  server.Stop();
  if (kind != Kind::kEmpty) result["writes_a_commit"] = server.WritesACommit();
  return result;
}

// Streams in turn beside scrapes, one a second, and without: what a pose takes
// of the server in both kinds of slices.
json MetricsRound(const Options& options) {
  json round = json::array();
  for (const int batch_poses : {64, 1}) {
    if (options.batch_poses != 0 && options.batch_poses != batch_poses) {
      continue;
    }
    Server server(Kind::kScraped, options);
    LoadOptions load;
    load.batch_poses = batch_poses;
    Streams streams(&server, 8, load);
    SleepFor(std::min(0.5, options.seconds / 4.0));
    json entry = {{"vehicles", 8}, {"batch_poses", batch_poses}};
    // In an order in which what grows or slows down with time cancels out.
    for (const bool scraped : {false, true, true, false}) {
      const std::uint64_t before = streams.acked_poses();
      const double cpu = server.cpu_seconds();
      const Clock::time_point start = Clock::now();
      const auto end = start + std::chrono::duration<double>(options.seconds);
      std::size_t page_bytes = 0;
      while (Clock::now() < end) {
        if (scraped) page_bytes = server.Scrape().size();
        SleepFor(std::min(1.0, options.seconds));
      }
      const std::chrono::duration<double> spent = Clock::now() - start;
      const auto poses = static_cast<double>(streams.acked_poses() - before);
      json slice = {
          {"poses_per_second", poses / spent.count()},
          {"server_cpu_us_per_pose",
           1e6 * (server.cpu_seconds() - cpu) / std::max(1.0, poses)}};
      if (scraped) slice["page_bytes"] = page_bytes;
      entry[scraped ? "scraped" : "alone"].push_back(std::move(slice));
    }
    streams.Stop();
    round.push_back(std::move(entry));
  }
  return round;
}

json MeasureLoop(const Options& options, int batch_poses, int rows_a_commit) {
  // For its store.
  Server server(Kind::kRevisit, options);
  server.Stop();
  return {{"rows_a_commit", rows_a_commit},
          {"poses_per_second", SqliteLoop(server.store(), batch_poses,
                                          rows_a_commit, options.seconds)}};
}

json IngestRound(const Options& options) {
  json round = json::array();
  struct Case {
    int vehicles;
    int batch_poses;
  };
  for (const Case& one : {Case{1, 64}, Case{1, 1}, Case{8, 64}, Case{8, 1}}) {
    if (options.batch_poses != 0 && options.batch_poses != one.batch_poses) {
      continue;
    }
    json entry = {{"vehicles", one.vehicles}, {"batch_poses", one.batch_poses}};
    for (const Kind kind : {Kind::kEmpty, Kind::kRevisit, Kind::kShared}) {
      if (kind == Kind::kShared && options.shared_store.empty()) continue;
      entry[NameOf(kind)] =
          MeasureStreams(kind, options, one.vehicles, one.batch_poses);
    }
    const auto group = static_cast<int>(std::lround(
        std::max(1.0, entry["revisit"]["writes_a_commit"].get<double>())));
    entry["sqlite"] = MeasureLoop(options, one.batch_poses, group);
    entry["sqlite_row_a_commit"] = MeasureLoop(options, one.batch_poses, 1);
    round.push_back(std::move(entry));
  }
  return round;
}

// The poses of a drive through a town, one a node.
std::vector<v1::Pose> TownPoses(std::int64_t nodes) {
  const core::PoseGraph graph = MakeRoads(nodes);
  std::vector<v1::Pose> poses(static_cast<std::size_t>(nodes));
  for (core::NodeIndex i = 0; i < nodes; ++i) {
    const core::Node node = graph.node(i);
    v1::Pose& pose = poses[static_cast<std::size_t>(i)];
    pose.set_sequence(static_cast<std::uint64_t>(i) + 1);
    pose.mutable_local()->set_x_meters(node.pose.x);
    pose.mutable_local()->set_y_meters(node.pose.y);
    pose.set_heading_radians(node.pose.heading);
    pose.mutable_covariance()->set_form(v1::COVARIANCE_FORM_PLANAR_6);
    static constexpr int kRows[] = {0, 1, 3};
    for (int r = 0; r < 3; ++r) {
      for (int c = r; c < 3; ++c) {
        pose.mutable_covariance()->add_values(
            node.covariance(kRows[r], kRows[c]));
      }
    }
  }
  return poses;
}

// Calls one after the other until the time is over.
template <typename Call>
std::vector<double> MeasureCalls(double seconds, const Call& call) {
  std::vector<double> latencies;
  const Clock::time_point start = Clock::now();
  while (Clock::now() - start < std::chrono::duration<double>(seconds)) {
    const Clock::time_point sent = Clock::now();
    const grpc::Status status = call();
    if (!status.ok()) Die("a call failed: " + status.error_message());
    latencies.push_back(
        std::chrono::duration<double>(Clock::now() - sent).count());
  }
  return latencies;
}

class Caller {
 public:
  explicit Caller(const std::string& address)
      : stub_(v1::PoseGraphService::NewStub(NewChannel(address))) {}

  grpc::Status Find(const std::string& vehicle, bool with_belief = true) {
    grpc::ClientContext context;
    v1::FindCandidatesRequest request;
    request.set_vehicle(vehicle);
    if (!with_belief) request.mutable_options()->set_use_belief(false);
    return stub_->FindCandidates(&context, request, &found_);
  }

  grpc::Status Info() {
    grpc::ClientContext context;
    v1::GetServerInfoResponse response;
    return stub_->GetServerInfo(&context, {}, &response);
  }

  // Time of the last search, as the server measured it.
  double search_seconds() const {
    const auto& duration = found_.candidates().search_duration();
    return static_cast<double>(duration.seconds()) +
           1e-9 * static_cast<double>(duration.nanos());
  }

 private:
  const std::unique_ptr<v1::PoseGraphService::Stub> stub_;
  v1::FindCandidatesResponse found_;
};

// Vehicles that send a batch of 64 as soon as the one before is durable.
LoadOptions OneBatchAtATime() {
  LoadOptions load;
  load.window_batches = 1;
  return load;
}

json QueryRound(const Options& options) {
  json result;
  {
    Server empty(Kind::kEmpty, options);
    Caller caller(empty.address());
    MeasureCalls(0.2, [&] { return caller.Find("vehicles/asked"); });
    result["empty"] = Latencies(MeasureCalls(
        options.seconds, [&] { return caller.Find("vehicles/asked"); }));
    Streams streams(&empty, 4, OneBatchAtATime());
    result["empty_loaded"] = Latencies(MeasureCalls(
        options.seconds, [&] { return caller.Find("vehicles/asked"); }));
  }
  Server server(Kind::kRevisit, options);
  server.AddVehicle("asked");
  Upload(NewChannel(server.address()), "vehicles/asked",
         TownPoses(options.nodes));
  Caller caller(server.address());
  std::vector<double> searches;
  bool with_belief = true;
  const auto find = [&] {
    const grpc::Status status = caller.Find("vehicles/asked", with_belief);
    searches.push_back(caller.search_seconds());
    return status;
  };
  const auto measure_find = [&](const std::string& name) {
    searches.clear();
    result[name] = Latencies(MeasureCalls(options.seconds, find));
    result[name]["search_p50_ms"] = 1e3 * Quantile(searches, 0.5);
  };
  const auto measure = [&](const std::string& suffix) {
    measure_find("find" + suffix);
    result["info" + suffix] =
        Latencies(MeasureCalls(options.seconds, [&] { return caller.Info(); }));
  };
  MeasureCalls(0.2, find);
  measure("");
  with_belief = false;
  measure_find("find_without_belief");
  with_belief = true;
  Streams streams(&server, 4, OneBatchAtATime());
  measure("_loaded");
  streams.Stop();
  result["nodes"] = options.nodes;
  return result;
}

// What streams notice of slow searches, of as many callers at once.
json StallRound(const Options& options) {
  Server server(Kind::kRevisit, options);
  server.AddVehicle("asked");
  Upload(NewChannel(server.address()), "vehicles/asked",
         TownPoses(options.many_nodes));
  Streams streams(&server, 4, OneBatchAtATime());
  SleepFor(0.3);
  json result = {{"nodes", options.many_nodes}};
  for (const int callers : {0, 1, 4}) {
    std::atomic<bool> over{false};
    std::vector<std::vector<double>> searches(
        static_cast<std::size_t>(callers));
    std::vector<std::thread> threads;
    for (std::vector<double>& mine : searches) {
      threads.emplace_back([&] {
        Caller caller(server.address());
        while (!over) {
          const grpc::Status status = caller.Find("vehicles/asked");
          if (!status.ok()) Die("FindCandidates: " + status.error_message());
          mine.push_back(caller.search_seconds());
        }
      });
    }
    SleepFor(0.3);
    streams.TakeLatencies();
    SleepFor(options.seconds);
    json entry = Latencies(streams.TakeLatencies());
    over = true;
    std::vector<double> all;
    for (std::size_t i = 0; i < threads.size(); ++i) {
      threads[i].join();
      all.insert(all.end(), searches[i].begin(), searches[i].end());
    }
    entry["callers"] = callers;
    entry["searches"] = all.size();
    entry["search_p50_ms"] = 1e3 * Quantile(all, 0.5);
    result["acks"].push_back(std::move(entry));
  }
  streams.Stop();
  return result;
}

bool Wanted(const Options& options, const char* what) {
  return options.only.empty() || options.only == what;
}

int Run(const Options& options) {
  double load = 0.0;
  getloadavg(&load, 1);
  // The load that others make, before we add ours.
  json result = {
      {"seconds", options.seconds}, {"load", load}, {"rounds", json::array()}};
  for (int i = 0; i < options.rounds; ++i) {
    json round;
    if (Wanted(options, "ingest")) round["ingest"] = IngestRound(options);
    if (Wanted(options, "metrics")) round["metrics"] = MetricsRound(options);
    if (Wanted(options, "query")) round["query"] = QueryRound(options);
    if (Wanted(options, "stall")) round["stall"] = StallRound(options);
    result["rounds"].push_back(std::move(round));
  }
  std::printf("%s\n", result.dump(1).c_str());
  return 0;
}

constexpr char kUsage[] =
    "usage: revisit_server_bench [--seconds S] [--rounds N] [--nodes N]\n"
    "           [--many-nodes N] [--directory DIR] "
    "[--shared-store URL] [--only ingest|metrics|query|stall]\n"
    "           [--batch-poses N]\n";

int Main(int argc, char** argv) {
  Options options;
  for (int i = 1; i < argc; ++i) {
    const std::string flag = argv[i];
    if (flag == "--empty-server") return RunEmptyServer();
    const char* value = i + 1 < argc ? argv[++i] : nullptr;
    if (value == nullptr) {
      std::fputs(kUsage, stderr);
      return 64;
    }
    if (flag == "--shared-store") {
      options.shared_store = value;
    } else if (flag == "--seconds") {
      options.seconds = std::strtod(value, nullptr);
    } else if (flag == "--rounds") {
      options.rounds = static_cast<int>(std::strtol(value, nullptr, 10));
    } else if (flag == "--nodes") {
      options.nodes = std::strtol(value, nullptr, 10);
    } else if (flag == "--many-nodes") {
      options.many_nodes = std::strtol(value, nullptr, 10);
    } else if (flag == "--directory") {
      options.directory = value;
    } else if (flag == "--batch-poses") {
      options.batch_poses = static_cast<int>(std::strtol(value, nullptr, 10));
    } else if (flag == "--only") {
      options.only = value;
    } else {
      std::fputs(kUsage, stderr);
      return 64;
    }
  }
  return Run(options);
}

}  // namespace
}  // namespace revisit::bench

int main(int argc, char** argv) { return revisit::bench::Main(argc, argv); }
