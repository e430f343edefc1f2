#include "server/admin/metrics_page.h"

#include <dirent.h>
#include <prometheus/metric_family.h>
#include <prometheus/text_serializer.h>
#include <sys/resource.h>
#include <sys/time.h>
#include <unistd.h>

#include <algorithm>
#include <array>
#include <chrono>
#include <cstddef>
#include <cstdlib>
#include <fstream>
#include <limits>
#include <memory>
#include <optional>
#include <sstream>
#include <string>
#include <utility>
#include <vector>

#include "core/base/build_info.h"
#include "server/base/histogram.h"
#include "server/base/process_memory.h"
#include "server/storage/storage.h"

namespace revisit::server {
namespace {

using prometheus::ClientMetric;
using prometheus::MetricFamily;
using prometheus::MetricType;
using Labels = std::vector<ClientMetric::Label>;

double SecondsOf(std::chrono::system_clock::time_point time) {
  return std::chrono::duration<double>(time.time_since_epoch()).count();
}

// One kind of metric, and its values.
class Family {
 public:
  Family(const char* name, const char* help, MetricType type) {
    family_.name = name;
    family_.help = help;
    family_.type = type;
  }

  void Add(double value, Labels labels = {}) {
    ClientMetric metric;
    metric.label = std::move(labels);
    if (family_.type == MetricType::Counter) {
      metric.counter.value = value;
    } else {
      metric.gauge.value = value;
    }
    family_.metric.push_back(std::move(metric));
  }
  void Add(std::uint64_t value, Labels labels = {}) {
    Add(static_cast<double>(value), std::move(labels));
  }
  void Add(std::int64_t value, Labels labels = {}) {
    Add(static_cast<double>(value), std::move(labels));
  }
  void Add(bool value, Labels labels = {}) {
    Add(value ? 1.0 : 0.0, std::move(labels));
  }

  // Nothing where nothing is counted.
  void Add(const HistogramCounts& counts, Labels labels = {}) {
    if (counts.counts.empty()) return;
    ClientMetric metric;
    metric.label = std::move(labels);
    for (std::size_t i = 0; i < counts.counts.size(); ++i) {
      metric.histogram.sample_count += counts.counts[i];
      metric.histogram.bucket.push_back(
          {metric.histogram.sample_count,
           i < counts.bounds.size() ? counts.bounds[i]
                                    : std::numeric_limits<double>::infinity()});
    }
    metric.histogram.sample_sum = counts.sum;
    family_.metric.push_back(std::move(metric));
  }

  void Add(const ServiceCounters::Labelled& counts, const char* label) {
    for (const auto& [name, count] : counts) Add(count, {{label, name}});
  }

  MetricFamily&& Take() && { return std::move(family_); }
  bool empty() const { return family_.metric.empty(); }

 private:
  MetricFamily family_;
};

// Gathers families; one without values is left out.
class Page {
 public:
  Family* Counter(const char* name, const char* help) {
    return Make(name, help, MetricType::Counter);
  }
  Family* Gauge(const char* name, const char* help) {
    return Make(name, help, MetricType::Gauge);
  }
  Family* Histogram(const char* name, const char* help) {
    return Make(name, help, MetricType::Histogram);
  }

  std::string Text() && {
    std::vector<MetricFamily> families;
    for (const auto& family : families_) {
      if (!family->empty()) families.push_back(std::move(*family).Take());
    }
    return prometheus::TextSerializer().Serialize(families);
  }

 private:
  Family* Make(const char* name, const char* help, MetricType type) {
    families_.push_back(std::make_unique<Family>(name, help, type));
    return families_.back().get();
  }

  std::vector<std::unique_ptr<Family>> families_;
};

// ---- The process, under the names that Prometheus has for every program.

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

void AddProcess(Page* page) {
  page->Gauge("revisit_build_info", "The build that runs; always 1.")
      ->Add(1.0, {{"version", REVISIT_VERSION}, {"build", kVersionText}});
  static const double start = StartTime();
  page->Gauge("process_start_time_seconds",
              "When the process started, since the Unix epoch.")
      ->Add(start);
  page->Counter("process_cpu_seconds_total",
                "Processor time of the process, user and system.")
      ->Add(CpuSeconds());
  page->Gauge("process_resident_memory_bytes", "Resident memory.")
      ->Add(ResidentBytes());
  page->Gauge("process_open_fds", "Descriptors that are open.")
      ->Add(OpenDescriptors());
  rlimit limit{};
  getrlimit(RLIMIT_NOFILE, &limit);
  page->Gauge("process_max_fds", "Descriptors that may be open.")
      ->Add(static_cast<std::uint64_t>(limit.rlim_cur));
}

// ---- Calls

void AddCalls(const ServiceCounters::Counts& counts, Page* page) {
  Family* const ended = page->Counter(
      "revisit_calls_total", "Calls that have ended, by method and code.");
  Family* const open =
      page->Gauge("revisit_calls_open", "Calls and streams that are open.");
  Family* const seconds = page->Histogram(
      "revisit_call_seconds", "Time of unary calls until they had a status.");
  for (const ServiceCounters::Method& method : counts.methods) {
    const std::string name = method.rule->method;
    for (std::size_t code = 0; code < method.ended.size(); ++code) {
      // Codes that did not occur are left out, but for OK: an alert has to see
      // a counter before it rises.
      if (code != 0 && method.ended[code] == 0) continue;
      ended->Add(
          method.ended[code],
          {{"method", name}, {"code", CodeName(static_cast<int>(code))}});
    }
    open->Add(method.open, {{"method", name}});
    seconds->Add(method.seconds, {{"method", name}});
  }
  page->Counter("revisit_call_errors_total",
                "Calls that ended with an error, by its reason.")
      ->Add(counts.errors, "reason");
}

void AddPoses(const ServiceCounters::Counts& counts, Page* page) {
  page->Counter("revisit_poses_accepted_total",
                "New poses that were stored and acknowledged.")
      ->Add(counts.poses_accepted);
  page->Counter("revisit_poses_repeated_total",
                "Poses that came again and were acknowledged again.")
      ->Add(counts.poses_repeated);
  page->Counter("revisit_poses_refused_total",
                "Poses of batches that were read and not stored, by reason.")
      ->Add(counts.poses_refused, "reason");
  page->Histogram("revisit_ack_seconds",
                  "Time from reading a batch to its acknowledgement.")
      ->Add(counts.ack_seconds);
}

void AddSearches(const ServiceCounters::Counts& counts, Page* page) {
  page->Counter("revisit_searches_total",
                "Searches, by the best verdict or why there is none.")
      ->Add(counts.searches, "outcome");
  page->Counter("revisit_candidates_total",
                "Candidates that searches found, by verdict.")
      ->Add(counts.candidates, "verdict");
  page->Histogram("revisit_search_seconds", "Time of searches, without waits.")
      ->Add(counts.search_seconds);
  page->Histogram("revisit_search_nodes",
                  "Nodes of the history that a search considered.")
      ->Add(counts.search_nodes);
}

void AddDecisions(const ServiceCounters::Counts& counts, Page* page) {
  page->Counter("revisit_decisions_total",
                "Changes that people have decided on and that were stored.")
      ->Add(counts.decisions, "decision");
}

// ---- Limits

void AddLimits(const MetricsSources& sources, Page* page) {
  Family* const refusals = page->Counter(
      "revisit_limit_refusals_total",
      "Calls, batches and connections that a limit has refused or cut.");
  std::array<std::uint64_t, kLimitCount> counts =
      sources.admission->refusals().Read();
  if (sources.connection_refusals != nullptr) {
    const auto more = sources.connection_refusals->Read();
    for (std::size_t i = 0; i < kLimitCount; ++i) counts[i] += more[i];
  }
  for (std::size_t i = 0; i < kLimitCount; ++i) {
    refusals->Add(counts[i], {{"limit", kLimitNames[i]}});
  }
  Family* const used = page->Gauge(
      "revisit_limit_used_ratio",
      "Share of a limit of the whole server that is taken; 1 is all of it.");
  Family* const queued = page->Gauge(
      "revisit_queued_bytes", "Bytes of batches that wait to be durable.");
  for (const Admission::Use& use : sources.admission->uses()) {
    used->Add(static_cast<double>(use.taken) / static_cast<double>(use.most),
              {{"limit", use.limit}});
    if (std::string(use.limit) == "max-queued-bytes") queued->Add(use.taken);
  }
  if (sources.accepted_connections) {
    page->Counter("revisit_connections_accepted_total",
                  "Connections that were let in.")
        ->Add(sources.accepted_connections());
  }
}

// ---- The store

void AddStore(const MetricsSources& sources, Page* page) {
  Storage* const storage = sources.storage;
  page->Gauge("revisit_store_writable",
              "Whether the store is likely to take the next write.")
      ->Add(storage->CheckWritable().ok());
  const CommitCounts counts = storage->Counts();
  page->Counter("revisit_store_commits_total", "Transactions committed.")
      ->Add(counts.commits);
  page->Counter("revisit_store_writes_total",
                "Writes that those transactions held.")
      ->Add(counts.writes);
  page->Histogram("revisit_store_commit_seconds",
                  "Time of transactions, from the first statement to the last.")
      ->Add(counts.commit_seconds);
  page->Histogram("revisit_store_flush_seconds",
                  "Time until something written is durable, within a "
                  "transaction; of a database, time of this server's beats.")
      ->Add(counts.flush_seconds);
  if (const std::optional<StorageRoom> room = storage->GetRoom()) {
    page->Gauge("revisit_store_bytes", "Bytes of the store and its log.")
        ->Add(room->bytes);
    if (room->free_bytes.has_value()) {
      page->Gauge("revisit_store_free_bytes",
                  "Bytes free on the file system of the store.")
          ->Add(*room->free_bytes);
      page->Gauge("revisit_store_min_free_bytes",
                  "Bytes free below which writes are refused.")
          ->Add(sources.min_free_bytes);
    }
  }
  if (!sources.store_file.empty()) {
    if (const auto backup = ReadNote(BackupNoteOf(sources.store_file))) {
      page->Gauge("revisit_store_backup_timestamp_seconds",
                  "When the last backup was made, since the Unix epoch.")
          ->Add(SecondsOf(backup->time));
    }
  }
  if (const std::optional<SharingState> sharing = storage->GetSharing()) {
    page->Gauge("revisit_store_owned_vehicles",
                "Vehicles of a shared store that this server owns.")
        ->Add(sharing->owned_vehicles);
    page->Counter("revisit_store_lost_vehicles_total",
                  "Owned vehicles that other servers took without asking.")
        ->Add(sharing->lost_vehicles);
    page->Counter("revisit_store_lost_leases_total",
                  "Times that other servers took this one for dead.")
        ->Add(sharing->lost_leases);
    page->Gauge("revisit_store_lease_held",
                "Whether this server's lease of a shared store holds.")
        ->Add(sharing->lease_holds);
  }
}

// ---- The server before this one, of which a store in a file alone knows

// Values of the label `reason`, by the word of the note.
constexpr std::pair<const char*, const char*> kExitReasons[] = {
    {kStopped, "stopped"},
    {kStoreFailed, "store_failed"},
    {kRunning, "killed"}};

void AddLastExit(const MetricsSources& sources, Page* page) {
  if (sources.store_file.empty()) return;
  Family* const reasons = page->Gauge(
      "revisit_last_exit",
      "How the server of this store before this one ended, by reason.");
  for (const auto& [word, reason] : kExitReasons) {
    reasons->Add(sources.last_exit && sources.last_exit->word == word,
                 {{"reason", reason}});
  }
  // Nobody knows when a server was killed.
  if (!sources.last_exit || sources.last_exit->word == kRunning) return;
  page->Gauge("revisit_last_exit_timestamp_seconds",
              "When that server ended, since the Unix epoch.")
      ->Add(SecondsOf(sources.last_exit->time));
}

void AddVehicles(const VehicleCensus& census, Page* page) {
  const std::optional<VehicleCensus::Counts> counts = census.Read();
  if (!counts) return;
  Family* const vehicles =
      page->Gauge("revisit_vehicles", "Vehicles of the store, by state.");
  vehicles->Add(counts->active, {{"state", "active"}});
  vehicles->Add(counts->data_loss, {{"state", "data_loss"}});
  vehicles->Add(counts->damaged, {{"state", "damaged"}});
}

void AddResidency(const Fleet& fleet, Page* page) {
  const Fleet::Residency residency = fleet.residency();
  page->Gauge("revisit_resident_vehicles", "Vehicles in memory.")
      ->Add(residency.vehicles);
  page->Gauge("revisit_resident_nodes", "Nodes of vehicles in memory.")
      ->Add(residency.nodes);
  page->Gauge("revisit_resident_bytes",
              "Bytes of nodes and edges of vehicles in memory.")
      ->Add(residency.bytes);
}

void AddRetention(const Fleet& fleet, Page* page) {
  const RetentionMonitor::Counts counts = fleet.retention();
  page->Counter("revisit_poses_dropped_total",
                "Poses that vehicles no longer keep.")
      ->Add(counts.poses);
  Family* const nodes = page->Counter(
      "revisit_nodes_dropped_total",
      "Nodes of these poses, by the setting that no longer keeps them.");
  nodes->Add(counts.nodes_too_old, {{"rule", "max_age"}});
  nodes->Add(counts.nodes_covered, {{"rule", "max_passes"}});
  page->Histogram("revisit_drop_seconds",
                  "Time in which a vehicle's appends waited while poses that "
                  "it no longer keeps were dropped.")
      ->Add(counts.seconds);
  page->Gauge("revisit_trimmed_vehicles",
              "Vehicles whose history is looked at for poses to drop, or that "
              "are losing such poses.")
      ->Add(counts.vehicles);
}

// ---- Identities and logs

void AddSecurity(const MetricsSources& sources, Page* page) {
  if (sources.tls_files != nullptr) {
    page->Gauge("revisit_tls_certificate_expiry_timestamp_seconds",
                "When the listener's certificate expires, since the Unix "
                "epoch.")
        ->Add(SecondsOf(sources.tls_files->expires()));
  }
  Family* const loaded =
      page->Gauge("revisit_security_files_loaded_timestamp_seconds",
                  "When the files in use were taken up, since the Unix epoch.");
  Family* const refused = page->Gauge(
      "revisit_security_files_refused",
      "Whether the files have changed since into what was refused.");
  const auto add = [&](const char* files, const FilesState& state) {
    loaded->Add(SecondsOf(state.loaded), {{"files", files}});
    refused->Add(state.refused, {{"files", files}});
  };
  if (sources.tls_files != nullptr) add("tls", sources.tls_files->state());
  if (const auto access = sources.gatekeeper->files()) add("access", *access);
}

void AddLogs(const MetricsSources& sources, Page* page) {
  Family* const dropped =
      page->Counter("revisit_log_lines_dropped_total",
                    "Lines of a log that were lost, for it was not read or "
                    "written as fast as they came.");
  dropped->Add(sources.log->dropped(), {{"log", "server"}});
  if (sources.audit != nullptr) {
    dropped->Add(sources.audit->dropped(), {{"log", "audit"}});
  }
}

}  // namespace

std::string RenderMetrics(const MetricsSources& sources) {
  Page page;
  AddProcess(&page);
  const ServiceCounters::Counts counts = sources.calls->Read();
  AddCalls(counts, &page);
  AddPoses(counts, &page);
  AddSearches(counts, &page);
  AddDecisions(counts, &page);
  AddLimits(sources, &page);
  AddStore(sources, &page);
  AddLastExit(sources, &page);
  AddVehicles(*sources.census, &page);
  AddResidency(*sources.fleet, &page);
  AddRetention(*sources.fleet, &page);
  AddSecurity(sources, &page);
  AddLogs(sources, &page);
  page.Gauge("revisit_draining",
             "Whether the server has been asked to end, and calls go home.")
      ->Add(sources.draining);
  return std::move(page).Text();
}

}  // namespace revisit::server
