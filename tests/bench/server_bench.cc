// The whole server over loopback, beside the limits it cannot pass: gRPC with
// nothing behind it, and SQLite with nothing before it. Prints JSON; see
// tests/bench/run.
#include <grpcpp/grpcpp.h>

#include <algorithm>
#include <atomic>
#include <chrono>
#include <cstdio>
#include <cstdlib>
#include <map>
#include <memory>
#include <string>
#include <thread>
#include <vector>

#include "absl/synchronization/mutex.h"
#include "nlohmann/json.hpp"
#include "revisit/v1/pose_graph_service.grpc.pb.h"
#include "tests/bench/child_process.h"
#include "tests/bench/empty_server.h"
#include "tests/bench/ingest_round.h"
#include "tests/bench/measured_server.h"
#include "tests/bench/roads.h"
#include "tests/bench/server_options.h"
#include "tests/bench/stream_load.h"
#include "tests/bench/watch_round.h"

namespace revisit::bench {
namespace {

using Clock = std::chrono::steady_clock;
using nlohmann::json;

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
    Streams streams(server, server.AddVehicles(8), 1, load);
    streams.Start();
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

// The poses of a drive through a town, one a node.
std::vector<v1::Pose> PosesOf(const core::PoseGraph& graph) {
  std::vector<v1::Pose> poses(static_cast<std::size_t>(graph.size()));
  for (core::NodeIndex i = 0; i < graph.size(); ++i) {
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

// Makes the vehicle "asked" with a drive of so many nodes.
void AddAsked(const Options& options, std::int64_t nodes, Server* server) {
  const bool fixes = options.errors == "fixes";
  v1::VehicleSettings settings;
  if (fixes) {
    settings.set_correlation_model(v1::CORRELATION_MODEL_INDEPENDENT);
  }
  server->AddVehicle("asked", settings);
  Upload(NewChannel(server->address()), "vehicles/asked",
         PosesOf(fixes ? MakeSmoothRoads(nodes) : MakeRoads(nodes)));
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

  // The first search of a long history learns what its marks have shown, for
  // which a call has a quota: asks until it is answered. Returns how often.
  int FindAtLast(const std::string& vehicle) {
    for (int calls = 1;; ++calls) {
      const grpc::Status status = Find(vehicle);
      if (status.ok()) return calls;
      if (status.error_code() != grpc::StatusCode::RESOURCE_EXHAUSTED) {
        Die("FindCandidates: " + status.error_message());
      }
    }
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

// Measures the search that does not know yet what the drive has shown.
json FirstSearch(Caller* caller) {
  const Clock::time_point sent = Clock::now();
  const int calls = caller->FindAtLast("vehicles/asked");
  const std::chrono::duration<double> spent = Clock::now() - sent;
  return {{"calls", calls}, {"ms", 1e3 * spent.count()}};
}

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
    Streams streams(empty, empty.AddVehicles(4), 1, OneBatchAtATime());
    streams.Start();
    result["empty_loaded"] = Latencies(MeasureCalls(
        options.seconds, [&] { return caller.Find("vehicles/asked"); }));
  }
  Server server(Kind::kRevisit, options);
  AddAsked(options, options.nodes, &server);
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
  result["first"] = FirstSearch(&caller);
  MeasureCalls(0.2, find);
  measure("");
  with_belief = false;
  measure_find("find_without_belief");
  with_belief = true;
  Streams streams(server, server.AddVehicles(4), 1, OneBatchAtATime());
  streams.Start();
  measure("_loaded");
  streams.Stop();
  result["nodes"] = options.nodes;
  return result;
}

// What streams notice of slow searches, of as many callers at once.
json StallRound(const Options& options) {
  Server server(Kind::kRevisit, options);
  AddAsked(options, options.many_nodes, &server);
  Caller(server.address()).FindAtLast("vehicles/asked");
  Streams streams(server, server.AddVehicles(4), 1, OneBatchAtATime());
  streams.Start();
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
    // It takes vehicles by the thousand, so that only who asks has it.
    if (options.only == "pace") round["pace"] = PaceRound(options);
    if (Wanted(options, "metrics")) round["metrics"] = MetricsRound(options);
    if (Wanted(options, "query")) round["query"] = QueryRound(options);
    if (Wanted(options, "stall")) round["stall"] = StallRound(options);
    // It takes minutes, so that only who asks for it by name has it.
    if (options.only == "watch") round["watch"] = WatchRound(options, i);
    result["rounds"].push_back(std::move(round));
  }
  std::printf("%s\n", result.dump(1).c_str());
  return 0;
}

constexpr char kUsage[] =
    "usage: revisit_server_bench [--seconds S] [--rounds N] [--nodes N]\n"
    "           [--many-nodes N] [--directory DIR] [--shared-store URL]\n"
    "           [--only ingest|metrics|query|stall] [--batch-poses N]\n"
    "           [--form messages|columns] [--vehicles N]\n"
    "           [--errors reckoned|fixes]\n"
    "       revisit_server_bench --only pace [--streams N]\n"
    "           [--poses-per-second N] [--seconds S] [--rounds N]\n"
    "           [--directory DIR] [--batch-poses N]\n"
    "           [--form messages|columns]\n"
    "       revisit_server_bench --only watch [--streams N] [--watchers N]\n"
    "           [--poses-per-second N] [--seconds S] [--rounds N]\n"
    "           [--directory DIR] [--batch-poses N]\n";

// Returns whether there is such a flag.
bool SetOption(const std::string& flag, const std::string& value,
               Options* options) {
  const std::map<std::string, std::string*> texts = {
      {"--directory", &options->directory},
      {"--errors", &options->errors},
      {"--form", &options->form},
      {"--only", &options->only},
      {"--shared-store", &options->shared_store}};
  const std::map<std::string, double*> numbers = {
      {"--poses-per-second", &options->poses_per_second},
      {"--seconds", &options->seconds}};
  const std::map<std::string, std::int64_t*> sizes = {
      {"--many-nodes", &options->many_nodes}, {"--nodes", &options->nodes}};
  const std::map<std::string, int*> counts = {
      {"--batch-poses", &options->batch_poses},
      {"--rounds", &options->rounds},
      {"--streams", &options->streams},
      {"--vehicles", &options->vehicles},
      {"--watchers", &options->watchers}};
  if (texts.count(flag) > 0) {
    *texts.at(flag) = value;
  } else if (numbers.count(flag) > 0) {
    *numbers.at(flag) = std::strtod(value.c_str(), nullptr);
  } else if (sizes.count(flag) > 0) {
    *sizes.at(flag) = std::strtol(value.c_str(), nullptr, 10);
  } else if (counts.count(flag) > 0) {
    *counts.at(flag) =
        static_cast<int>(std::strtol(value.c_str(), nullptr, 10));
  } else {
    return false;
  }
  return true;
}

int Main(int argc, char** argv) {
  Options options;
  for (int i = 1; i < argc; ++i) {
    const std::string flag = argv[i];
    if (flag == "--empty-server") return RunEmptyServer();
    const char* value = i + 1 < argc ? argv[++i] : nullptr;
    if (value == nullptr || !SetOption(flag, value, &options)) {
      std::fputs(kUsage, stderr);
      return 64;
    }
  }
  // Debian builds Abseil with checks for deadlocks, which look at all mutexes
  // that a thread holds: a third of what a client of 10,000 connections does.
  absl::SetMutexDeadlockDetectionMode(absl::OnDeadlockCycle::kIgnore);
  return Run(options);
}

}  // namespace
}  // namespace revisit::bench

int main(int argc, char** argv) { return revisit::bench::Main(argc, argv); }
