// The rows of `vehicles`: every statement that reads or writes them, with their
// checks; and the changes that a vehicle's rows in all tables have in common.
// sqlite_storage.h lists the tables, store_format.cc makes them.
//
// All functions of this and the other files of rows run within the transaction,
// if any, of the given connection. Rows that they return have passed their
// checksum; others are DATA_LOSS (STORE_CORRUPT), or a record with `damage`
// set. Other errors are those of the calls of Storage (storage.h) that use
// these functions.
#ifndef REVISIT_SERVER_STORAGE_SQLITE_VEHICLE_ROWS_H_
#define REVISIT_SERVER_STORAGE_SQLITE_VEHICLE_ROWS_H_

#include <cstdint>
#include <optional>
#include <set>
#include <string>
#include <vector>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "server/storage/records.h"
#include "server/storage/sqlite/sqlite_database.h"

namespace revisit::server {

// The id of a vehicle, without a check of its row: to see whether the vehicle
// exists, and for messages.
absl::StatusOr<std::string> VehicleId(SqliteDatabase& database, VehicleKey key);

absl::StatusOr<VehicleRecord> FindVehicle(SqliteDatabase& database,
                                          const std::string& id);
// Implements Storage::GetVehicles().
absl::StatusOr<std::vector<VehicleRecord>> FindVehiclesOf(
    SqliteDatabase& database, const std::set<std::string>& ids);
// Implements Storage::ListVehicles().
absl::StatusOr<std::vector<VehicleRecord>> FindVehicles(
    SqliteDatabase& database, const std::string& after_id,
    const std::string& prefix, int limit);

// Implements Storage::ListVehicleRows().
absl::StatusOr<std::vector<VehicleRecord>> FindVehicleRows(
    SqliteDatabase& database, VehicleKey after_key, int limit);

absl::StatusOr<VehicleKey> InsertVehicle(SqliteDatabase& database,
                                         VehicleRecord record);
// Inserts a vehicle under the key that it has.
absl::Status ImportVehicle(SqliteDatabase& database,
                           const VehicleRecord& record);
// Replaces the payload, if given, and raises the revision.
absl::Status ChangeVehicle(SqliteDatabase& database, VehicleKey key,
                           const std::optional<std::string>& payload,
                           std::uint64_t revision);
// Implements Storage::DropDamaged().
absl::Status DropDamagedRows(SqliteDatabase& database, VehicleKey key,
                             std::uint64_t last_sequence,
                             const std::string& payload,
                             std::uint64_t revision);
// Removes a vehicle. Its batches stay, out of reach, until PurgeSome() has
// removed them. `farewell` is its last event (RemoveChecks()).
absl::Status RemoveVehicle(SqliteDatabase& database, VehicleKey key,
                           const EventRecord& farewell);

}  // namespace revisit::server

#endif  // REVISIT_SERVER_STORAGE_SQLITE_VEHICLE_ROWS_H_
