// The statements that append batches. An append is one statement, which commits
// by itself, so that a server that is stopped in the middle of it holds
// nothing. It compares owner, epoch, revision and sequence of the vehicle's
// head, and writes nothing where they differ: ABORTED (EPOCH_FENCED) or
// FAILED_PRECONDITION (SEQUENCE_GAP). Other errors are those of connection.h.
#ifndef REVISIT_SERVER_STORAGE_POSTGRES_POSTGRES_APPENDS_H_
#define REVISIT_SERVER_STORAGE_POSTGRES_POSTGRES_APPENDS_H_

#include <string>
#include <vector>

#include "absl/status/status.h"
#include "server/storage/postgres/connection.h"
#include "server/storage/postgres/postgres_fence.h"
#include "server/storage/records.h"
#include "server/storage/write_queue.h"

namespace revisit::server {

// Appends of one vehicle that follow each other, submitted under one claim.
using AppendRun = std::vector<const PendingWrite*>;

// Appends runs, at most one per vehicle, in one statement. OK if the statement
// was run: then `results` has the outcome of each run, which is written whole
// or not at all. Otherwise nothing was written, or the connection is in doubt.
absl::Status AppendRuns(PostgresConnection& connection,
                        const std::vector<AppendRun>& runs,
                        std::vector<absl::Status>* results);
absl::Status AppendWithVehicle(PostgresConnection& connection,
                               const Fence& fence,
                               const std::vector<BatchRecord>& batches,
                               const std::string& vehicle_payload);

// The statement of AppendRuns(), for tests of its plan.
const char* AppendSql();

}  // namespace revisit::server

#endif  // REVISIT_SERVER_STORAGE_POSTGRES_POSTGRES_APPENDS_H_
