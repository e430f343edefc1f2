// Storage in one SQLite file, for one server on one machine.
//
// The file is in WAL mode with synchronous=FULL: a commit returns after the log
// was flushed to the device. One thread writes: it takes all writes that wait,
// commits them as one transaction, and then answers each. Writes that come
// meanwhile wait for the next transaction: an idle store commits at once, a
// busy one many together. A write that is refused (a gap, an id that is taken)
// is rolled back alone; a transaction that fails is rolled back whole, and all
// its writes fail. Reads have connections of their own and never wait for the
// writer.
//
// After a failed transaction the connection is closed, and no write is taken
// until it has been opened anew and the log has been copied into the database
// file and emptied; if somebody reads, or there is no room, the log is
// continued behind its last commit instead. After a failed flush no write is
// taken at all until a new process has copied the log, or written it anew, and
// flushed that: the system's memory may no longer show what is on the device.
// Nor is any write taken once the files were removed or replaced.
//
// Opening checks that database, log, mark and lock belong together and hold all
// that was flushed (store_state.h, durable_mark.h, write_ahead_log.h), and, if
// the file is not too large, that tables and indexes agree, so that no row is
// missed. Rows are checked as they are read. A store on a full disk opens too.
//
// Rows of deleted vehicles are removed, and pages that no row uses are given
// back to the file system, some at a time while there is nothing better to do,
// or no room.
//
// Tables (store_format.cc makes them; the file's user_version is
// kStoreFormat):
//   vehicles             a row per vehicle; keys are never used again
//   batches              a row per batch, or per some small ones that were
//                        committed together, as sent; never rewritten
//   revised_batches      a row per batch whose poses were revised: its current
//                        version
//   loop_closures        a row per loop closure; payloads since format 4
//   rejected_candidates  a row per rejected candidate; since format 2, payloads
//                        since format 4
//   snapshots            a row per vehicle with a snapshot, or with one in the
//                        making, which has no payload yet; since format 5
//   snapshot_parts       a row per part of a snapshot, and one with the marks
//                        of the vehicle (kMarksPart); since format 5
//   deleted_snapshots    keys of snapshots whose parts are still to be removed,
//                        a few at a time; since format 5
//   deleted_pose_pairs   a row per loop closure or rejected candidate that was
//                        deleted, the last ones of each vehicle; since format 6
//   check_heads          a row per vehicle that has ever stored checks; since
//                        format 7
//   checks               a row per check that found candidates; since format 7
//   events               a row per change of a candidate, of all vehicles, in
//                        the order in which they were written; those of
//                        vehicles that were deleted have no payload any more,
//                        but for the last one; since format 7
//   dropped_events       at most one row: the last event that was dropped, with
//                        all before it; since format 7
//   vehicle_groups       a row per group; since format 8
//   group_members        a row per vehicle in a group; since format 8
//   group_links          a row per loop closure between members of a group;
//                        since format 8
//   deleted_vehicles     keys whose batches are still to be removed, a few at
//                        a time
//   store                one row: which store this is, and the number of its
//                        last commit; since format 3
// Every row has a format version and a checksum (record_checksum.h), checked
// whenever it is read. The version is that of the store when the row was
// written: opening an older store adds the tables and columns that it lacks, in
// one transaction, and rewrites no row.
#ifndef REVISIT_SERVER_STORAGE_SQLITE_SQLITE_STORAGE_H_
#define REVISIT_SERVER_STORAGE_SQLITE_SQLITE_STORAGE_H_

#include <memory>
#include <string>

#include "absl/status/statusor.h"
#include "server/storage/sqlite/sqlite_options.h"
#include "server/storage/storage.h"

namespace revisit::server {

// Opens the store, or creates it in an existing directory. A store of an older
// format becomes one of this format. FAILED_PRECONDITION if another server has
// it open, or if the file is not a store, or one of a newer format; the message
// says which. DATA_LOSS (STORE_CORRUPT) if it is damaged in a way that could
// make it answer less than was acknowledged; the message names the vehicles,
// where they are known.
absl::StatusOr<std::unique_ptr<Storage>> OpenSqliteStorage(
    const std::string& path, const SqliteOptions& options = {});

}  // namespace revisit::server

#endif  // REVISIT_SERVER_STORAGE_SQLITE_SQLITE_STORAGE_H_
