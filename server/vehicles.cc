#include "server/vehicles.h"

#include <algorithm>
#include <chrono>
#include <cstdint>
#include <optional>
#include <thread>

#include "server/base/process_memory.h"

namespace revisit::server {
namespace {

// A node of a snapshot takes about as many bytes as a stored pose, so up to
// here a snapshot is hardly larger than the poses that it stands for.
constexpr double kMostNodesPerPoseInDatabase = 1.25;
// How long after the rows of all vehicles were read to count them those of a
// store that others change too are read again.
constexpr std::chrono::minutes kCensusAgain{10};

// The part of the memory limit that histories of groups take by default: one
// in so many bytes.
constexpr std::int64_t kPartForGroups = 4;
// How often histories are let go that no search in a group has asked for.
constexpr std::chrono::seconds kUnloadGroupsPeriod{30};

int Processors() {
  return static_cast<int>(std::max(1U, std::thread::hardware_concurrency()));
}

int SearchThreads(const ServerSettings& settings) {
  return settings.search_threads > 0 ? settings.search_threads
                                     : std::max(2, Processors());
}

Limits LimitsOf(const ServerSettings& settings) {
  Limits limits = settings.limits;
  if (limits.max_memory_bytes == 0) {
    limits.max_memory_bytes = DefaultMemoryLimit();
  }
  return limits;
}

// Logs poses that a vehicle no longer keeps.
void LogDrop(const Log& log, const RetentionMonitor::Drop& drop) {
  log.Write(
      LogLevel::kInfo, "poses_dropped",
      {{"vehicle", drop.vehicle_id},
       {"poses", static_cast<std::int64_t>(drop.poses)},
       {"first_kept_sequence",
        static_cast<std::int64_t>(drop.first_kept_sequence)},
       {"nodes_too_old", drop.nodes_too_old},
       {"nodes_covered", drop.nodes_covered},
       {"duration_ms",
        std::chrono::duration<double, std::milli>(drop.duration).count()}});
}

Fleet::Options FleetOptionsOf(const ServerSettings& settings,
                              bool store_is_shared, const Log* log) {
  Fleet::Options options;
  options.idle_unload = Milliseconds(settings.idle_unload_minutes * 60.0);
  if (settings.memory_budget_mebibytes > 0) {
    options.memory_budget_bytes = settings.memory_budget_mebibytes << 20;
  }
  options.session.max_pending_appends = settings.limits.max_pending_appends;
  options.snapshots.poses = static_cast<std::uint64_t>(settings.snapshot_poses);
  if (store_is_shared) {
    options.snapshots.most_nodes_per_pose = kMostNodesPerPoseInDatabase;
  }
  options.snapshots.warn = [log](const std::string& message) {
    log->Write(LogLevel::kWarning, "snapshot", {{"message", message}});
  };
  options.retention.drop = [log](const RetentionMonitor::Drop& drop) {
    LogDrop(*log, drop);
  };
  options.retention.withheld = [log](const std::string& vehicle_id,
                                     const absl::Status& status) {
    log->Write(
        LogLevel::kWarning, "poses_kept",
        {{"vehicle", vehicle_id}, {"message", std::string(status.message())}});
  };
  return options;
}

GroupSearches::Options GroupOptionsOf(const ServerSettings& settings) {
  GroupSearches::Options options;
  options.most_bytes =
      settings.group_memory_mebibytes > 0
          ? settings.group_memory_mebibytes << 20
          : LimitsOf(settings).max_memory_bytes / kPartForGroups;
  return options;
}

}  // namespace

Vehicles::Vehicles(const ServerSettings& settings, Storage* storage,
                   bool is_shared, const Log* log)
    : feed_(storage, EventFeed::Options()),
      admission_(LimitsOf(settings),
                 std::min(SearchThreads(settings), Processors()),
                 ResidentBytes),
      executor_("vehicles", settings.worker_threads > 0
                                ? settings.worker_threads
                                : Processors()),
      // With one thread alone, the loading of every vehicle would wait for each
      // long read.
      read_executor_("reads", std::max(2, Processors())),
      search_executor_("searches", SearchThreads(settings)),
      groups_(storage, &read_executor_),
      census_(std::make_shared<VehicleCensus>(
          storage, &codec_,
          is_shared ? std::optional<std::chrono::milliseconds>(kCensusAgain)
                    : std::nullopt)) {
  Fleet::Options options = FleetOptionsOf(settings, is_shared, log);
  options.census = census_;
  options.checks.codec = &check_codec_;
  options.checks.scopes = &check_scopes_;
  options.checks.max_search_steps = settings.limits.max_search_steps;
  options.checks.monitor = std::make_shared<CheckMonitor>();
  fleet_ = std::make_unique<Fleet>(
      storage, &codec_, Lanes(&executor_, &read_executor_, &search_executor_),
      options);
  group_searches_ = std::make_unique<GroupSearches>(fleet_.get(), storage,
                                                    &codec_, &read_executor_,
                                                    GroupOptionsOf(settings));
  check_scopes_.Use(group_searches_.get());
  group_upkeep_ = std::make_unique<Periodic>(kUnloadGroupsPeriod, [this] {
    group_searches_->UnloadIdle(std::chrono::steady_clock::now());
  });
  upkeep_ = std::make_unique<Upkeep>(
      fleet_.get(), census_.get(), options,
      [this] { return admission_.UnderMemoryPressure(); });
}

}  // namespace revisit::server
