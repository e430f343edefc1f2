#include "tests/bench/ingest_round.h"

#include <algorithm>
#include <chrono>
#include <cmath>
#include <cstdint>
#include <vector>

#include "tests/bench/child_process.h"
#include "tests/bench/measured_server.h"
#include "tests/bench/sqlite_loop.h"
#include "tests/bench/stream_load.h"

namespace revisit::bench {
namespace {

using Clock = std::chrono::steady_clock;
using nlohmann::json;

// Many vehicles together have at most so many poses under way, so that these
// bound neither memory nor the time until the first is acknowledged.
constexpr int kMostPosesUnderWay = 65'536;
// A vehicle that sends at its pace has as many poses a message, unless
// `--batch-poses` says otherwise.
constexpr int kPacedPoses = 10;

LoadOptions Load(const Options& options, int vehicles, int batch_poses) {
  LoadOptions load;
  load.batch_poses = batch_poses;
  load.as_columns = options.form == "columns";
  load.window_poses =
      std::min(load.window_poses, kMostPosesUnderWay / vehicles);
  return load;
}

json MeasureStreams(Kind kind, const Options& options, int vehicles,
                    int batch_poses) {
  const int a_connection = VehiclesAConnection(vehicles);
  Server server(kind, options);
  const LoadOptions load = Load(options, vehicles, batch_poses);
  Streams streams(server, server.AddVehicles(vehicles), a_connection, load);
  streams.Start();
  // Until caches and windows are as they stay.
  SleepFor(std::min(0.5, options.seconds / 4.0));
  while (streams.acked_poses() < static_cast<std::uint64_t>(batch_poses) *
                                     static_cast<std::uint64_t>(vehicles)) {
    SleepFor(0.01);
  }
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
  result["vehicles_a_connection"] = a_connection;
  streams.Stop();
  result["server_peak_bytes"] = server.peak_bytes();
  server.Stop();
  if (kind != Kind::kEmpty) result["writes_a_commit"] = server.WritesACommit();
  return result;
}

json MeasureLoop(const Options& options, int batch_poses, int rows_a_commit) {
  // For its store.
  Server server(Kind::kRevisit, options);
  server.Stop();
  return {{"rows_a_commit", rows_a_commit},
          {"poses_per_second", SqliteLoop(server.store(), batch_poses,
                                          rows_a_commit, options.seconds)}};
}

json MeasureIngest(const Options& options, int vehicles, int batch_poses) {
  json entry = {{"vehicles", vehicles}, {"batch_poses", batch_poses}};
  for (const Kind kind : {Kind::kEmpty, Kind::kRevisit, Kind::kShared}) {
    if (kind == Kind::kShared && options.shared_store.empty()) continue;
    entry[NameOf(kind)] = MeasureStreams(kind, options, vehicles, batch_poses);
  }
  const auto group = static_cast<int>(std::lround(
      std::max(1.0, entry["revisit"]["writes_a_commit"].get<double>())));
  entry["sqlite"] = MeasureLoop(options, batch_poses, group);
  entry["sqlite_row_a_commit"] = MeasureLoop(options, batch_poses, 1);
  return entry;
}

}  // namespace

json IngestRound(const Options& options) {
  json round = json::array();
  std::vector<int> fleets = {1, 8};
  std::vector<int> batches = {64, 1};
  if (options.vehicles != 0) fleets = {options.vehicles};
  if (options.batch_poses != 0) batches = {options.batch_poses};
  for (const int vehicles : fleets) {
    for (const int batch_poses : batches) {
      round.push_back(MeasureIngest(options, vehicles, batch_poses));
    }
  }
  return round;
}

json PaceRound(const Options& options) {
  if (options.streams < 1 || options.poses_per_second <= 0.0) {
    Die("--streams and --poses-per-second have to be positive");
  }
  const int batch_poses =
      options.batch_poses == 0 ? kPacedPoses : options.batch_poses;
  const int a_connection = VehiclesAConnection(options.streams);
  Server server(Kind::kRevisit, options);
  const double started_bytes = SettledBytes(server);
  Streams streams(server, server.AddVehicles(options.streams), a_connection,
                  Load(options, options.streams, batch_poses));
  const double opened_bytes = SettledBytes(server);
  // Each vehicle sends once before, when more is done than later.
  streams.SendAtRate(options.poses_per_second,
                     options.streams * batch_poses / options.poses_per_second);
  streams.WaitUntilAcked();
  streams.TakeLatencies();
  const std::uint64_t before = streams.acked_poses();
  const double cpu = server.cpu_seconds();
  const Clock::time_point start = Clock::now();
  streams.SendAtRate(options.poses_per_second, options.seconds);
  streams.WaitUntilAcked();
  const std::chrono::duration<double> spent = Clock::now() - start;
  json result = Latencies(streams.TakeLatencies());
  result["vehicles"] = options.streams;
  result["vehicles_a_connection"] = a_connection;
  result["batch_poses"] = batch_poses;
  result["wanted_poses_per_second"] = options.poses_per_second;
  result["poses_per_second"] =
      static_cast<double>(streams.acked_poses() - before) / spent.count();
  // A vehicle whose stream has sent nothing takes this, with its connection.
  result["idle_bytes_per_vehicle"] =
      (opened_bytes - started_bytes) / options.streams;
  result["server_cores"] = (server.cpu_seconds() - cpu) / spent.count();
  streams.Stop();
  return result;
}

}  // namespace revisit::bench
