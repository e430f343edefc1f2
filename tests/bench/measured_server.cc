#include "tests/bench/measured_server.h"

#include <unistd.h>

#include <algorithm>
#include <atomic>
#include <chrono>
#include <cmath>
#include <cstdlib>
#include <filesystem>
#include <sstream>
#include <thread>

#include "boost/asio/ip/tcp.hpp"

namespace revisit::bench {
namespace {

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

Server::Server(Kind kind, const Options& options)
    : kind_(kind),
      directory_(options.directory),
      process_(Command(kind, kind == Kind::kShared ? options.shared_store
                                                   : directory_.path()),
               directory_.path() + "/log") {}

void Server::AddVehicle(const std::string& id) {
  if (kind_ != Kind::kEmpty) CreateVehicle(NewChannel(address()), id);
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

Streams::Streams(Server* server, int vehicles, const LoadOptions& load)
    : load_(load) {
  for (int i = 0; i < vehicles; ++i) {
    const std::string id = NewVehicleId();
    server->AddVehicle(id);
    loads_.push_back(std::make_unique<StreamLoad>(NewChannel(server->address()),
                                                  "vehicles/" + id, load));
  }
  for (const auto& one : loads_) one->Start();
}

Streams::Streams(const Server& server, const std::vector<std::string>& ids,
                 int a_connection, const LoadOptions& load)
    : load_(load) {
  std::shared_ptr<grpc::Channel> channel;
  for (const std::string& id : ids) {
    if (loads_.size() % static_cast<std::size_t>(a_connection) == 0) {
      channel = NewChannel(server.address());
    }
    loads_.push_back(
        std::make_unique<StreamLoad>(channel, "vehicles/" + id, load));
  }
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
  for (const auto& one : loads_) one->Stop();
}

}  // namespace revisit::bench
