#include "tests/bench/watch_round.h"

#include <algorithm>
#include <chrono>
#include <cmath>
#include <cstdint>
#include <memory>
#include <string>
#include <vector>

#include "revisit/v1/pose_graph_service.pb.h"
#include "tests/bench/measured_server.h"
#include "tests/bench/stream_load.h"
#include "tests/bench/watchers.h"

namespace revisit::bench {
namespace {

using Clock = std::chrono::steady_clock;
using nlohmann::json;

constexpr char kFeedThread[] = "event-feed";
// A thousand calls come over ten connections, each of which has far fewer than
// the server takes (--max-concurrent-streams).
constexpr int kCallsAConnection = 100;
// A vehicle sends as many poses a message, unless `--batch-poses` says
// otherwise: four messages a second at the rate by default.
constexpr int kBatchPoses = 10;
// Vehicles have driven a lap and a half before, so that each check that is
// measured finds places of the lap before it.
constexpr int kPosesBefore = 3 * kLapPoses / 2;
// Between looks at what is owed: each takes some of what pays it.
constexpr double kLookSeconds = 0.25;
// Checks that are owed for longer than this are not waited for.
constexpr double kMostSecondsOwed = 600.0;

double SecondsSince(Clock::time_point start) {
  return std::chrono::duration<double>(Clock::now() - start).count();
}

// Returns after how many seconds no check is owed.
double WaitUntilChecked(const Server& server) {
  const Clock::time_point start = Clock::now();
  while (server.Metric("revisit_check_debt") > 0.0) {
    if (SecondsSince(start) > kMostSecondsOwed) Die("checks are still owed");
    SleepFor(kLookSeconds);
  }
  return SecondsSince(start);
}

// Drives what comes before the measurement. Vehicles differ in how far they
// are, so that their checks do not fall due all at once.
void DriveFirstLap(const Server& server, const LoadOptions& load,
                   std::size_t vehicles, Streams* streams) {
  const int batches = (kPosesBefore + load.batch_poses - 1) / load.batch_poses;
  for (std::size_t i = 0; i < vehicles; ++i) {
    streams->SendBatches(i, batches + static_cast<int>(i % 5));
  }
  streams->WaitUntilAcked();
  WaitUntilChecked(server);
}

std::vector<v1::WatchCandidatesRequest> Requests(
    const std::string& name, int watchers,
    const std::vector<std::string>& ids) {
  std::vector<v1::WatchCandidatesRequest> requests;
  if (name == "alone") return requests;
  requests.resize(static_cast<std::size_t>(watchers));
  for (std::size_t i = 0; i < requests.size(); ++i) {
    v1::CandidateFilter* filter = requests[i].mutable_filter();
    if (name == "own") {
      filter->add_vehicles("vehicles/" + ids[i % ids.size()]);
    } else {
      // Nothing withdraws a candidate here.
      filter->set_least_probability(1.0);
      filter->add_states(v1::CANDIDATE_STATE_WITHDRAWN);
    }
  }
  return requests;
}

// Waits until no more is told for some periods in which the server looks for
// what is new.
void WaitUntilTold(const Watchers& watchers) {
  std::uint64_t before = 0;
  do {
    before = watchers.told();
    SleepFor(1.0);
  } while (watchers.told() != before);
}

json Load(const Options& options, const Server& server,
          const Watchers& watchers, Streams* streams) {
  const ChildProcess& process = server.process();
  streams->SendAtRate(options.poses_per_second,
                      std::min(0.5, options.seconds / 4.0));
  streams->TakeLatencies();
  const std::uint64_t before = streams->acked_poses();
  const double checks = server.Metric("revisit_stored_checks_total");
  const double feed_cpu = process.thread_cpu_seconds(kFeedThread);
  const double cpu = process.cpu_seconds();
  const Clock::time_point start = Clock::now();
  streams->SendAtRate(options.poses_per_second, options.seconds);
  streams->WaitUntilAcked();
  const double spent = SecondsSince(start);
  json result = Latencies(streams->TakeLatencies());
  result["poses_per_second"] =
      static_cast<double>(streams->acked_poses() - before) / spent;
  result["resident_end_bytes"] = process.resident_bytes();
  result["feed_cpu_share"] =
      (process.thread_cpu_seconds(kFeedThread) - feed_cpu) / spent;
  result["check_debt"] = server.Metric("revisit_check_debt");
  result["debt_seconds"] = WaitUntilChecked(server);
  WaitUntilTold(watchers);
  result["feed_cpu_seconds"] =
      process.thread_cpu_seconds(kFeedThread) - feed_cpu;
  result["server_cpu_seconds"] = process.cpu_seconds() - cpu;
  result["checks"] = server.Metric("revisit_stored_checks_total") - checks;
  result["told"] = watchers.told();
  result["resident_told_bytes"] = SettledBytes(server);
  return result;
}

json MeasureWatched(const std::string& name, const Options& options) {
  Server server(Kind::kScraped, options);
  LoadOptions load;
  load.batch_poses =
      options.batch_poses == 0 ? kBatchPoses : options.batch_poses;
  load.set_pose = SetLapPose;
  v1::VehicleSettings settings;
  settings.set_checks(v1::STORED_CHECKS_STORED);
  const std::vector<std::string> ids =
      server.AddVehicles(options.streams, settings);
  Streams streams(server, ids, kCallsAConnection, load);
  DriveFirstLap(server, load, ids.size(), &streams);
  const double resident = SettledBytes(server);
  const double candidates = server.Metric("revisit_stored_candidates_total");
  json result;
  {
    const Watchers watchers(server.address(),
                            Requests(name, options.watchers, ids),
                            kCallsAConnection);
    const double watched = SettledBytes(server);
    result = Load(options, server, watchers, &streams);
    result["resident_bytes"] = resident;
    result["resident_watched_bytes"] = watched;
  }
  result["candidates"] =
      server.Metric("revisit_stored_candidates_total") - candidates;
  if (result["candidates"] == 0.0) Die("the laps brought no candidate");
  if ((result["told"] > 0) != (name == "own")) {
    Die("what was told does not fit the filter of the case " + name);
  }
  streams.Stop();
  server.Stop();
  return result;
}

}  // namespace

json WatchRound(const Options& options, int round) {
  if (options.streams < 1 || options.watchers < 0 ||
      options.poses_per_second <= 0.0) {
    Die("--streams and --poses-per-second have to be positive, and --watchers "
        "not negative");
  }
  std::vector<std::string> names = {"alone"};
  if (options.watchers > 0) {
    names = {"alone", "unwanted", "own"};
    std::rotate(names.begin(), names.begin() + round % 3, names.end());
  }
  json result = {{"streams", options.streams},
                 {"watchers", options.watchers},
                 {"wanted_poses_per_second", options.poses_per_second}};
  for (const std::string& name : names) {
    result[name] = MeasureWatched(name, options);
  }
  return result;
}

}  // namespace revisit::bench
