// The counts of a storage, whatever engine it is.
#ifndef REVISIT_SERVER_STORAGE_STORAGE_METRICS_H_
#define REVISIT_SERVER_STORAGE_STORAGE_METRICS_H_

#include "server/storage/storage.h"

namespace revisit::server {

class Metrics;

// Commits, room, and what comes of sharing: as far as the storage can tell.
// Thread-safe.
void CollectStorageMetrics(Storage* storage, Metrics* metrics);

}  // namespace revisit::server

#endif  // REVISIT_SERVER_STORAGE_STORAGE_METRICS_H_
