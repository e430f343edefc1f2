#include "tests/bench/measured_server.h"

#include <sys/resource.h>
#include <unistd.h>

#include <algorithm>
#include <atomic>
#include <chrono>
#include <cmath>
#include <cstdlib>
#include <filesystem>
#include <functional>
#include <sstream>
#include <thread>

#include "boost/asio/ip/tcp.hpp"

namespace revisit::bench {
namespace {

// The server looks a little more often than this for freed memory that is worth
// giving back.
constexpr double kTrimSeconds = 2.5;
// The measurements need no more vehicles with connections of their own.
constexpr rlim_t kMostConnections = 10'000;

using Clock = std::chrono::steady_clock;
using nlohmann::json;

std::filesystem::path OwnPath() {
  return std::filesystem::read_symlink("/proc/self/exe");
}

std::vector<std::string> Command(Kind kind, const std::string& store) {
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

// Calls work(i) for each i below `count`, several at a time, since each waits
// for a server.
void InParallel(std::size_t count,
                const std::function<void(std::size_t)>& work) {
  constexpr std::size_t kThreads = 32;
  std::atomic<std::size_t> next{0};
  std::vector<std::thread> threads;
  for (std::size_t t = 0; t < std::min(count, kThreads); ++t) {
    threads.emplace_back([&] {
      for (std::size_t i = next++; i < count; i = next++) work(i);
    });
  }
  for (std::thread& thread : threads) thread.join();
}

}  // namespace

void SleepFor(double seconds) {
  std::this_thread::sleep_for(std::chrono::duration<double>(seconds));
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

std::string NewVehicleId() {
  static std::atomic<int> made{0};
  return "load-" + std::to_string(getpid()) + "-" + std::to_string(made++);
}

int VehiclesAConnection(int vehicles) {
  rlimit limit{};
  if (getrlimit(RLIMIT_NOFILE, &limit) != 0) Die("getrlimit failed");
  limit.rlim_cur = limit.rlim_max;
  if (setrlimit(RLIMIT_NOFILE, &limit) != 0) Die("setrlimit failed");
  // A server leaves a quarter of its descriptors for its store and its callers
  // to come.
  const auto most =
      static_cast<int>(std::min<rlim_t>(limit.rlim_max / 2, kMostConnections));
  return (vehicles + most - 1) / most;
}

Server::Server(Kind kind, const Options& options)
    : kind_(kind),
      directory_(options.directory),
      process_(Command(kind, kind == Kind::kShared ? options.shared_store
                                                   : directory_.path()),
               directory_.path() + "/log") {}

void Server::AddVehicle(const std::string& id,
                        const v1::VehicleSettings& settings) {
  if (kind_ != Kind::kEmpty) CreateVehicle(NewChannel(address()), id, settings);
}

std::vector<std::string> Server::AddVehicles(
    int count, const v1::VehicleSettings& settings) {
  std::vector<std::string> ids(static_cast<std::size_t>(count));
  for (std::string& id : ids) id = NewVehicleId();
  if (kind_ == Kind::kEmpty) return ids;
  const auto channel = NewChannel(address());
  InParallel(ids.size(),
             [&](std::size_t i) { CreateVehicle(channel, ids[i], settings); });
  return ids;
}

double Server::WritesACommit() const {
  const json stopped = LogLine("stopped");
  return stopped.value("writes", 0.0) /
         std::max(1.0, stopped.value("commits", 0.0));
}

std::string Server::Scrape() const {
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

double Server::Metric(const std::string& name) const {
  const std::string page = Scrape();
  const std::string line = "\n" + name + " ";
  const std::size_t begin = page.find(line);
  if (begin == std::string::npos) Die("/metrics has no " + name);
  return std::strtod(page.c_str() + begin + line.size(), nullptr);
}

json Server::LogLine(const std::string& event) const {
  std::istringstream log(process_.Log());
  std::string line;
  while (std::getline(log, line)) {
    json entry = json::parse(line, nullptr, false);
    if (entry.is_object() && entry.value("event", "") == event) return entry;
  }
  return json::object();
}

double SettledBytes(const Server& server) {
  double before = 0.0;
  double now = server.process().resident_bytes();
  do {
    before = now;
    SleepFor(kTrimSeconds);
    now = server.process().resident_bytes();
  } while (std::abs(now - before) > 1e-3 * before);
  return now;
}

Streams::Streams(const Server& server, const std::vector<std::string>& ids,
                 int a_connection, const LoadOptions& load)
    : load_(load), loads_(ids.size()) {
  const auto shared_by = static_cast<std::size_t>(a_connection);
  InParallel((ids.size() + shared_by - 1) / shared_by, [&](std::size_t group) {
    const auto channel = NewChannel(server.address());
    const std::size_t end = std::min(ids.size(), (group + 1) * shared_by);
    for (std::size_t i = group * shared_by; i < end; ++i) {
      loads_[i] =
          std::make_unique<StreamLoad>(channel, "vehicles/" + ids[i], load);
    }
  });
}

void Streams::Start() {
  for (const auto& one : loads_) one->Start();
}

void Streams::SendBatches(std::size_t vehicle, int batches) {
  for (int i = 0; i < batches; ++i) loads_[vehicle]->Send(Clock::now());
}

void Streams::SendAtRate(double poses_per_second, double seconds) {
  const Clock::time_point start = Clock::now();
  const double period = load_.batch_poses / poses_per_second;
  const auto batches = static_cast<std::size_t>(std::lround(seconds / period));
  for (std::size_t i = 0; i < batches; ++i) {
    const auto due =
        start +
        std::chrono::duration_cast<Clock::duration>(
            std::chrono::duration<double>(static_cast<double>(i) * period));
    std::this_thread::sleep_until(due);
    loads_[i % loads_.size()]->Send(due);
  }
}

void Streams::WaitUntilAcked() {
  for (const auto& one : loads_) one->WaitUntilAcked();
}

std::uint64_t Streams::acked_poses() const {
  std::uint64_t sum = 0;
  for (const auto& one : loads_) sum += one->acked_poses();
  return sum;
}

std::vector<double> Streams::TakeLatencies() {
  std::vector<double> all;
  for (const auto& one : loads_) {
    const std::vector<double> some = one->TakeLatencies();
    all.insert(all.end(), some.begin(), some.end());
  }
  return all;
}

void Streams::Stop() {
  for (const auto& one : loads_) one->StopSending();
  for (const auto& one : loads_) one->Stop();
}

}  // namespace revisit::bench
