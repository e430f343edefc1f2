// A server with a store of its own and the streams into it, as benchmarks
// measure them.
#ifndef REVISIT_TESTS_BENCH_MEASURED_SERVER_H_
#define REVISIT_TESTS_BENCH_MEASURED_SERVER_H_

#include <cstdint>
#include <memory>
#include <string>
#include <vector>

#include "nlohmann/json.hpp"
#include "revisit/v1/vehicle.pb.h"
#include "tests/bench/child_process.h"
#include "tests/bench/server_options.h"
#include "tests/bench/stream_load.h"

namespace revisit::bench {

void SleepFor(double seconds);

double Quantile(std::vector<double> values, double share);

// Tells how many there are, and two of their quantiles.
nlohmann::json Latencies(const std::vector<double>& seconds);

// kScraped serves its metrics too.
enum class Kind { kEmpty, kRevisit, kScraped, kShared };

const char* NameOf(Kind kind);

// Vehicles of a shared store outlive the server that made them.
std::string NewVehicleId();

// How many of so many vehicles share a connection: one has its own, unless the
// descriptors of this process or of a server do not suffice, of which the soft
// limit is lifted as far as the hard one.
int VehiclesAConnection(int vehicles);

// A server with a store of its own.
class Server {
 public:
  Server(Kind kind, const Options& options);

  const std::string& address() const { return process_.address(); }
  const ChildProcess& process() const { return process_; }
  double cpu_seconds() const { return process_.cpu_seconds(); }
  double peak_bytes() const { return process_.peak_bytes(); }
  std::string store() const { return directory_.path() + "/revisit.sqlite"; }

  void AddVehicle(const std::string& id,
                  const v1::VehicleSettings& settings = {});
  // Makes so many, several at a time, and returns their ids.
  std::vector<std::string> AddVehicles(
      int count, const v1::VehicleSettings& settings = {});

  void Stop() { process_.Stop(); }

  // After Stop(): writes that the store committed together, in the mean.
  double WritesACommit() const;

  // One page of /metrics. REQUIRES: this is kScraped.
  std::string Scrape() const;
  // The value of a metric without labels. REQUIRES: this is kScraped.
  double Metric(const std::string& name) const;

 private:
  // The line of the log with this event, or an empty object.
  nlohmann::json LogLine(const std::string& event) const;

  const Kind kind_;
  const ScratchDirectory directory_;
  ChildProcess process_;
};

// Waits until resident memory no longer changes by itself, and returns it.
double SettledBytes(const Server& server);

// Streams of many vehicles, one each.
class Streams {
 public:
  // Opens streams of vehicles that are there, so many to a connection, which
  // send what SendBatches() and SendAtRate() say, or all they can once Start()
  // was called.
  Streams(const Server& server, const std::vector<std::string>& ids,
          int a_connection, const LoadOptions& load);

  void Start();
  // This vehicle sends so many batches as soon as its window allows.
  void SendBatches(std::size_t vehicle, int batches);
  // One vehicle after the other sends a batch, evenly in time. Returns once the
  // last is due.
  void SendAtRate(double poses_per_second, double seconds);
  // Waits until all that was to be sent is acknowledged.
  void WaitUntilAcked();

  std::uint64_t acked_poses() const;
  std::vector<double> TakeLatencies();

  void Stop();

 private:
  const LoadOptions load_;
  std::vector<std::unique_ptr<StreamLoad>> loads_;
};

}  // namespace revisit::bench

#endif  // REVISIT_TESTS_BENCH_MEASURED_SERVER_H_
