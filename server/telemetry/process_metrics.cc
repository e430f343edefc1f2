#include "server/telemetry/process_metrics.h"

#include <dirent.h>
#include <sys/resource.h>
#include <sys/time.h>
#include <unistd.h>

#include <algorithm>
#include <cstdint>
#include <cstdlib>
#include <fstream>
#include <sstream>
#include <string>

#include "core/base/build_info.h"
#include "server/base/metrics.h"
#include "server/base/process_memory.h"

namespace revisit::server {
namespace {

double CpuSeconds() {
  rusage usage{};
  getrusage(RUSAGE_SELF, &usage);
  const auto seconds = [](const timeval& time) {
    return static_cast<double>(time.tv_sec) +
           1e-6 * static_cast<double>(time.tv_usec);
  };
  return seconds(usage.ru_utime) + seconds(usage.ru_stime);
}

std::int64_t OpenDescriptors() {
  DIR* const directory = opendir("/proc/self/fd");
  if (directory == nullptr) return 0;
  // The two names that every directory has, and the directory itself.
  std::int64_t count = -3;
  while (readdir(directory) != nullptr) ++count;
  closedir(directory);
  return count;
}

// Since the epoch; 0 if the system does not say.
double StartTime() {
  std::ifstream stat("/proc/self/stat");
  std::string text;
  std::getline(stat, text);
  // Field 22; the second one, a name, may hold spaces and ends at the last ')'.
  std::istringstream fields(
      text.substr(std::min(text.size(), text.rfind(')'))));
  std::string field;
  for (int i = 2; i <= 22; ++i) fields >> field;
  std::ifstream system("/proc/stat");
  double boot = 0.0;
  for (std::string name; system >> name;) {
    if (name == "btime") {
      system >> boot;
      break;
    }
    std::getline(system, text);
  }
  const double ticks = std::strtod(field.c_str(), nullptr);
  return boot == 0.0 ? 0.0
                     : boot + ticks / static_cast<double>(sysconf(_SC_CLK_TCK));
}

}  // namespace

void CollectProcessMetrics(Metrics* metrics) {
  metrics->Gauge("revisit_build_info", "The build that runs; always 1.")
      .Add(1, {{"version", kVersion}, {"build", kVersionText}});
  static const double start = StartTime();
  metrics
      ->Gauge("process_start_time_seconds",
              "When the process started, since the Unix epoch.")
      .Add(start);
  metrics
      ->Counter("process_cpu_seconds_total",
                "Processor time of the process, user and system.")
      .Add(CpuSeconds());
  metrics->Gauge("process_resident_memory_bytes", "Resident memory.")
      .Add(ResidentBytes());
  metrics->Gauge("process_open_fds", "Descriptors that are open.")
      .Add(OpenDescriptors());
  rlimit limit{};
  getrlimit(RLIMIT_NOFILE, &limit);
  metrics->Gauge("process_max_fds", "Descriptors that may be open.")
      .Add(limit.rlim_cur);
}

}  // namespace revisit::server
