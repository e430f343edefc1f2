#include "server/storage/sqlite/sqlite_reader.h"

#include <filesystem>
#include <system_error>

#include "server/storage/free_space.h"
#include "server/storage/read_only_storage.h"
#include "server/storage/sqlite/batch_rows.h"
#include "server/storage/sqlite/check_rows.h"
#include "server/storage/sqlite/pair_rows.h"
#include "server/storage/sqlite/snapshot_rows.h"
#include "server/storage/sqlite/store_files.h"
#include "server/storage/sqlite/store_reading.h"
#include "server/storage/sqlite/vehicle_rows.h"

namespace revisit::server {

absl::StatusOr<VehicleRecord> SqliteReader::GetVehicle(const std::string& id) {
  return Read<VehicleRecord>(
      [&](SqliteDatabase& database) { return FindVehicle(database, id); });
}

absl::StatusOr<std::vector<VehicleRecord>> SqliteReader::GetVehicles(
    const std::set<std::string>& ids) {
  return Read<std::vector<VehicleRecord>>(
      [&](SqliteDatabase& database) { return FindVehiclesOf(database, ids); });
}

absl::StatusOr<std::vector<VehicleRecord>> SqliteReader::ListVehicles(
    const std::string& after_id, const std::string& prefix, int limit) {
  return Read<std::vector<VehicleRecord>>([&](SqliteDatabase& database) {
    return FindVehicles(database, after_id, prefix, limit);
  });
}

absl::StatusOr<std::vector<VehicleRecord>> SqliteReader::ListVehicleRows(
    VehicleKey after_key, int limit) {
  return Read<std::vector<VehicleRecord>>([&](SqliteDatabase& database) {
    return FindVehicleRows(database, after_key, limit);
  });
}

absl::Status SqliteReader::ReadBatches(
    VehicleKey key, std::uint64_t first_sequence, std::uint64_t last_sequence,
    BatchVersion version, const std::function<bool(BatchRecord)>& visit) {
  return readers_.Read([&](SqliteDatabase& database) {
    return VisitBatches(database, key, first_sequence, last_sequence, version,
                        visit);
  });
}

absl::StatusOr<std::vector<PosePairRecord>> SqliteReader::ListPosePairs(
    VehicleKey key, PairKind kind, const std::string& after_id, int limit) {
  return Read<std::vector<PosePairRecord>>([&](SqliteDatabase& database) {
    return FindPosePairs(database, key, kind, after_id, limit);
  });
}

absl::StatusOr<std::vector<DeletedPairRecord>> SqliteReader::ListDeletedPairs(
    VehicleKey key) {
  return Read<std::vector<DeletedPairRecord>>([&](SqliteDatabase& database) {
    return FindDeletedPairs(database, key);
  });
}

absl::StatusOr<std::vector<CheckRecord>> SqliteReader::ListChecks(
    VehicleKey key, std::uint64_t first_sequence, std::uint64_t last_sequence,
    bool open_only, int limit) {
  return Read<std::vector<CheckRecord>>([&](SqliteDatabase& database) {
    return FindChecks(database, key, first_sequence, last_sequence, open_only,
                      limit);
  });
}

absl::StatusOr<std::vector<VehicleRecord>> SqliteReader::ListUnchecked(
    VehicleKey after_key, int limit) {
  return Read<std::vector<VehicleRecord>>([&](SqliteDatabase& database) {
    return FindUnchecked(database, after_key, limit);
  });
}

absl::StatusOr<std::vector<EventRecord>> SqliteReader::ReadEvents(
    const EventPosition& after, int limit) {
  return Read<std::vector<EventRecord>>([&](SqliteDatabase& database) {
    return FindEvents(database, after, limit);
  });
}

absl::StatusOr<EventPosition> SqliteReader::LastEvent() {
  return Read<EventPosition>(
      [&](SqliteDatabase& database) { return FindLastEvent(database); });
}

absl::StatusOr<std::optional<SnapshotRecord>> SqliteReader::GetSnapshot(
    VehicleKey key) {
  return Read<std::optional<SnapshotRecord>>(
      [&](SqliteDatabase& database) { return FindSnapshot(database, key); });
}

absl::Status SqliteReader::ReadSnapshotParts(
    VehicleKey key, std::uint32_t first, std::uint32_t end,
    const std::function<bool(absl::string_view)>& visit) {
  return readers_.Read([&](SqliteDatabase& database) {
    return VisitSnapshotParts(database, key, first, end, visit);
  });
}

absl::StatusOr<std::optional<std::string>> SqliteReader::GetMarks(
    VehicleKey key) {
  return Read<std::optional<std::string>>(
      [&](SqliteDatabase& database) { return FindMarks(database, key); });
}

std::optional<StorageRoom> SqliteReader::GetRoom() const {
  StorageRoom room;
  for (const std::string& file : {path_, LogOf(path_)}) {
    std::error_code error;
    const std::uintmax_t bytes = std::filesystem::file_size(file, error);
    if (!error) room.bytes += static_cast<std::int64_t>(bytes);
  }
  const absl::StatusOr<std::int64_t> free =
      FreeBytes(std::filesystem::path(path_).parent_path());
  if (!free.ok()) return std::nullopt;
  room.free_bytes = *free;
  return room;
}

absl::StatusOr<std::unique_ptr<Storage>> OpenSqliteStorageToRead(
    const std::string& path, SqliteDatabase::Mode mode) {
  absl::StatusOr<std::unique_ptr<SqliteDatabase>> anchor =
      OpenDatabaseToRead(path, mode);
  if (!anchor.ok()) return anchor.status();
  return std::unique_ptr<Storage>(new ReadOnlyStorage<SqliteReader>(
      path, *std::move(anchor), mode, /*vfs=*/""));
}

}  // namespace revisit::server
