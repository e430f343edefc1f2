#include "server/storage/storage_metrics.h"

#include <optional>

#include "server/base/metrics.h"

namespace revisit::server {
namespace {

void CollectCommits(const CommitCounts& counts, Metrics* metrics) {
  metrics->Counter("revisit_store_commits_total", "Transactions committed.")
      .Add(counts.commits);
  metrics
      ->Counter("revisit_store_writes_total",
                "Writes that those transactions held.")
      .Add(counts.writes);
  metrics
      ->Histogram("revisit_store_commit_seconds",
                  "Time of transactions, from the first statement to the last.")
      .Add(counts.commit_seconds);
  metrics
      ->Histogram("revisit_store_flush_seconds",
                  "Time until something written is durable, within a "
                  "transaction; of a database, time of this server's beats.")
      .Add(counts.flush_seconds);
}

void CollectRoom(const StorageRoom& room, Metrics* metrics) {
  metrics->Gauge("revisit_store_bytes", "Bytes of the store and its log.")
      .Add(room.bytes);
  if (!room.free_bytes) return;
  metrics
      ->Gauge("revisit_store_free_bytes",
              "Bytes free on the file system of the store.")
      .Add(*room.free_bytes);
  metrics
      ->Gauge("revisit_store_min_free_bytes",
              "Bytes free below which writes are refused.")
      .Add(room.min_free_bytes);
}

void CollectSharing(const SharingState& sharing, Metrics* metrics) {
  metrics
      ->Gauge("revisit_store_owned_vehicles",
              "Vehicles of a shared store that this server owns.")
      .Add(sharing.owned_vehicles);
  metrics
      ->Counter("revisit_store_lost_vehicles_total",
                "Owned vehicles that other servers took without asking.")
      .Add(sharing.lost_vehicles);
  metrics
      ->Counter("revisit_store_lost_leases_total",
                "Times that other servers took this one for dead.")
      .Add(sharing.lost_leases);
  metrics
      ->Gauge("revisit_store_lease_held",
              "Whether this server's lease of a shared store holds.")
      .Add(sharing.lease_holds);
}

}  // namespace

void CollectStorageMetrics(Storage* storage, Metrics* metrics) {
  metrics
      ->Gauge("revisit_store_writable",
              "Whether the store is likely to take the next write.")
      .Add(storage->CheckWritable().ok());
  CollectCommits(storage->Counts(), metrics);
  if (const std::optional<StorageRoom> room = storage->GetRoom()) {
    CollectRoom(*room, metrics);
  }
  if (const std::optional<SharingState> sharing = storage->GetSharing()) {
    CollectSharing(*sharing, metrics);
  }
}

}  // namespace revisit::server
