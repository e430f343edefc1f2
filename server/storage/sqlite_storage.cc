#include "server/storage/sqlite_storage.h"

#include <pthread.h>

#include <algorithm>
#include <atomic>
#include <chrono>
#include <cstdio>
#include <deque>
#include <filesystem>
#include <fstream>
#include <limits>
#include <map>
#include <set>
#include <system_error>
#include <thread>
#include <unordered_map>
#include <utility>

#include "server/mutex.h"
#include "server/status.h"
#include "server/storage/durable_mark.h"
#include "server/storage/free_space.h"
#include "server/storage/record_checksum.h"
#include "server/storage/sqlite_database.h"
#include "server/storage/store_check.h"
#include "server/storage/store_files.h"
#include "server/storage/store_lock.h"
#include "server/storage/write_ahead_log.h"

namespace revisit::server {
namespace {

using absl::StatusCode;

// "RVST": tells a store from other SQLite files.
constexpr std::int64_t kApplicationId = 0x52565354;

// Of a new store. A batch of 64 poses has some 12 kB: measured with those, the
// store takes in a quarter more than with SQLite's own 4096, and with 16384 the
// file grows by a third.
constexpr int kPageBytes = 8192;

// Payloads come last, so that the columns before them are read without them.
// Keep in step: kStoreFormat, the table list of the header, record_checksum.h.
constexpr char kSchema[] = R"sql(
CREATE TABLE vehicles (
  key INTEGER PRIMARY KEY AUTOINCREMENT,
  id TEXT NOT NULL UNIQUE,
  format INTEGER NOT NULL,
  revision INTEGER NOT NULL,
  checksum INTEGER NOT NULL,
  payload BLOB NOT NULL
);
CREATE TABLE batches (
  vehicle_key INTEGER NOT NULL,
  first_sequence INTEGER NOT NULL,
  count INTEGER NOT NULL,
  format INTEGER NOT NULL,
  revision INTEGER NOT NULL,
  checksum INTEGER NOT NULL,
  payload BLOB NOT NULL,
  PRIMARY KEY (vehicle_key, first_sequence)
);
CREATE TABLE revised_batches (
  vehicle_key INTEGER NOT NULL,
  first_sequence INTEGER NOT NULL,
  count INTEGER NOT NULL,
  format INTEGER NOT NULL,
  revision INTEGER NOT NULL,
  checksum INTEGER NOT NULL,
  payload BLOB NOT NULL,
  PRIMARY KEY (vehicle_key, first_sequence)
);
CREATE TABLE loop_closures (
  vehicle_key INTEGER NOT NULL,
  id TEXT NOT NULL,
  format INTEGER NOT NULL,
  query_sequence INTEGER NOT NULL,
  matched_sequence INTEGER NOT NULL,
  create_time_ns INTEGER NOT NULL,
  checksum INTEGER NOT NULL,
  PRIMARY KEY (vehicle_key, id)
) WITHOUT ROWID;
CREATE TABLE deleted_vehicles (
  key INTEGER PRIMARY KEY
);
)sql";

// What format 2 has beyond format 1.
constexpr char kSchemaSince2[] = R"sql(
CREATE TABLE rejected_candidates (
  vehicle_key INTEGER NOT NULL,
  id TEXT NOT NULL,
  format INTEGER NOT NULL,
  query_sequence INTEGER NOT NULL,
  matched_sequence INTEGER NOT NULL,
  create_time_ns INTEGER NOT NULL,
  checksum INTEGER NOT NULL,
  PRIMARY KEY (vehicle_key, id)
) WITHOUT ROWID;
)sql";

// The statements on the table of a kind of pairs.
struct PairStatements {
  const std::string count;
  const std::string find;
  const std::string insert;
  const std::string remove;
  const std::string remove_all;
  const std::string list;

  explicit PairStatements(const std::string& table)
      : count("SELECT count(*) FROM " + table + " WHERE vehicle_key = ?1"),
        find("SELECT 1 FROM " + table + " WHERE vehicle_key = ?1 AND id = ?2"),
        insert("INSERT INTO " + table +
               " (vehicle_key, id, format, query_sequence, matched_sequence, "
               "create_time_ns, checksum) VALUES (?1, ?2, ?3, ?4, ?5, ?6, ?7)"),
        remove("DELETE FROM " + table + " WHERE vehicle_key = ?1 AND id = ?2"),
        remove_all("DELETE FROM " + table + " WHERE vehicle_key = ?1"),
        list(
            "SELECT id, format, query_sequence, matched_sequence, "
            "create_time_ns, checksum FROM " +
            table +
            " WHERE vehicle_key = ?1 AND id > ?2 ORDER BY id LIMIT "
            "?3") {}
};

// For the life of the program, since connections know statements by address.
const PairStatements& StatementsOf(PairKind kind) {
  static const auto& closures = *new PairStatements("loop_closures");
  static const auto& rejections = *new PairStatements("rejected_candidates");
  return kind == PairKind::kLoopClosure ? closures : rejections;
}

// Read-only connections that are kept open while nobody uses them.
constexpr std::size_t kIdleReaders = 4;

// Vehicles of which the writer remembers the sequence that comes next.
constexpr std::size_t kMaxKnownSequences = 100'000;

// Batches of deleted vehicles that one transaction removes.
constexpr int kPurgedBatches = 32;

std::int64_t Signed(std::uint64_t value) {
  return static_cast<std::int64_t>(
      std::min<std::uint64_t>(value, std::numeric_limits<std::int64_t>::max()));
}

std::uint64_t Unsigned(std::int64_t value) {
  return static_cast<std::uint64_t>(value);
}

std::string Range(const BatchRecord& batch) {
  return std::to_string(batch.first_sequence) + " to " +
         std::to_string(batch.first_sequence + batch.count - 1);
}

absl::Status Corrupt(const std::string& what, const ErrorMetadata& metadata) {
  return Error(StatusCode::kDataLoss, "STORE_CORRUPT", what, metadata);
}

absl::Status UnknownVehicle(const std::string& which) {
  return Error(StatusCode::kNotFound, "VEHICLE_NOT_FOUND",
               "no such vehicle: " + which);
}

// A row is right if its checksum is, and if it is of a format known here.
absl::Status CheckRow(std::int64_t format, std::int64_t stored_checksum,
                      std::int64_t computed_checksum, const std::string& what,
                      const ErrorMetadata& metadata) {
  if (stored_checksum != computed_checksum) {
    return Corrupt(what + " fails its checksum", metadata);
  }
  if (format < 1 || format > kStoreFormat) {
    return Corrupt(what + " has format " + std::to_string(format) +
                       "; known are 1 to " + std::to_string(kStoreFormat),
                   metadata);
  }
  return absl::OkStatus();
}

// Columns: key, id, format, revision, checksum, payload.
absl::StatusOr<VehicleRecord> ReadVehicleRow(const SqliteStatement& row) {
  VehicleRecord record;
  record.key = row.Integer(0);
  record.id = row.Bytes(1);
  const std::int64_t format = row.Integer(2);
  record.revision = Unsigned(row.Integer(3));
  record.payload = row.Bytes(5);
  const absl::Status status =
      CheckRow(format, row.Integer(4), ChecksumOfVehicle(format, record),
               "stored vehicle '" + Printable(record.id) + "'",
               {{"vehicle", Printable(record.id)}});
  if (!status.ok()) return status;
  return record;
}

// Columns from `column` on: format, revision, checksum, payload.
absl::StatusOr<BatchRecord> ReadBatchRow(const SqliteStatement& row, int column,
                                         std::int64_t first_sequence,
                                         std::int64_t count, VehicleKey key,
                                         const std::string& vehicle_id,
                                         BatchVersion version) {
  BatchRecord batch;
  batch.first_sequence = Unsigned(first_sequence);
  batch.count = static_cast<std::uint32_t>(count);
  const std::int64_t format = row.Integer(column);
  batch.revision = Unsigned(row.Integer(column + 1));
  batch.payload = row.Bytes(column + 3);
  const std::int64_t checksum = ChecksumOfBatch(format, key, version, batch);
  const absl::Status status =
      CheckRow(format, row.Integer(column + 2), checksum,
               std::string("stored batch of vehicle '") + vehicle_id +
                   "', sequences " + Range(batch) +
                   (version == BatchVersion::kCurrent ? ", revised," : ""),
               {{"vehicle", vehicle_id},
                {"first_sequence", std::to_string(batch.first_sequence)}});
  if (!status.ok()) return status;
  if (count < 1 || count != batch.count) {
    return Corrupt("stored batch of vehicle '" + vehicle_id + "' has " +
                       std::to_string(count) + " poses",
                   {{"vehicle", vehicle_id}});
  }
  return batch;
}

absl::StatusOr<std::optional<BatchRecord>> ReadLastBatch(
    SqliteDatabase& database, VehicleKey key, const std::string& vehicle_id) {
  SqliteStatement row = database.Prepare(
      "SELECT first_sequence, count, format, revision, checksum, payload "
      "FROM batches WHERE vehicle_key = ?1 ORDER BY first_sequence DESC LIMIT "
      "1");
  row.Bind(1, key);
  const absl::StatusOr<bool> found = row.Step();
  if (!found.ok()) return found.status();
  if (!*found) return std::optional<BatchRecord>();
  absl::StatusOr<BatchRecord> batch =
      ReadBatchRow(row, 2, row.Integer(0), row.Integer(1), key, vehicle_id,
                   BatchVersion::kAsSent);
  if (!batch.ok()) return batch.status();
  return std::optional<BatchRecord>(*std::move(batch));
}

// Adds to a row of `vehicles` what other tables know.
absl::Status CompleteVehicle(SqliteDatabase& database, VehicleRecord* record) {
  const absl::StatusOr<std::optional<BatchRecord>> last =
      ReadLastBatch(database, record->key, record->id);
  if (!last.ok()) return last.status();
  if (last->has_value()) {
    record->durable_sequence = (*last)->first_sequence + (*last)->count - 1;
    record->revision = std::max(record->revision, (*last)->revision);
  }
  for (const PairKind kind : kPairKinds) {
    SqliteStatement pairs = database.Prepare(StatementsOf(kind).count.c_str());
    const absl::StatusOr<bool> counted = pairs.Bind(1, record->key).Step();
    if (!counted.ok()) return counted.status();
    (kind == PairKind::kLoopClosure ? record->loop_closure_count
                                    : record->rejected_candidate_count) =
        pairs.Integer(0);
  }
  return absl::OkStatus();
}

// The id of a vehicle, not checked: to tell whether it is there, and for
// messages.
absl::StatusOr<std::string> VehicleId(SqliteDatabase& database,
                                      VehicleKey key) {
  SqliteStatement row =
      database.Prepare("SELECT id FROM vehicles WHERE key = ?1");
  row.Bind(1, key);
  const absl::StatusOr<bool> found = row.Step();
  if (!found.ok()) return found.status();
  if (!*found) return UnknownVehicle("key " + std::to_string(key));
  return Printable(row.Bytes(0));
}

absl::Status WriteVehicleRow(SqliteDatabase& database,
                             const VehicleRecord& record) {
  return database
      .Prepare(
          "UPDATE vehicles SET format = ?2, revision = ?3, checksum = ?4, "
          "payload = ?5 WHERE key = ?1")
      .Bind(1, record.key)
      .Bind(2, kStoreFormat)
      .Bind(3, Signed(record.revision))
      .Bind(4, ChecksumOfVehicle(kStoreFormat, record))
      .BindBlob(5, record.payload)
      .Run();
}

absl::StatusOr<VehicleKey> InsertVehicle(SqliteDatabase& database,
                                         VehicleRecord record) {
  {
    SqliteStatement taken =
        database.Prepare("SELECT 1 FROM vehicles WHERE id = ?1");
    const absl::StatusOr<bool> found = taken.BindText(1, record.id).Step();
    if (!found.ok()) return found.status();
    if (*found) {
      return Error(StatusCode::kAlreadyExists, "VEHICLE_EXISTS",
                   "vehicle '" + record.id + "' exists already");
    }
  }
  // The checksum covers the key, which is known only now.
  absl::Status status =
      database
          .Prepare(
              "INSERT INTO vehicles (id, format, revision, checksum, payload) "
              "VALUES (?1, 0, 0, 0, x'')")
          .BindText(1, record.id)
          .Run();
  if (!status.ok()) return status;
  record.key = database.LastInsertedKey();
  status = WriteVehicleRow(database, record);
  if (!status.ok()) return status;
  return record.key;
}

// Replaces the payload, if given, and raises the revision.
absl::Status ChangeVehicle(SqliteDatabase& database, VehicleKey key,
                           const std::optional<std::string>& payload,
                           std::uint64_t revision) {
  absl::StatusOr<VehicleRecord> record =
      [&]() -> absl::StatusOr<VehicleRecord> {
    SqliteStatement row = database.Prepare(
        "SELECT key, id, format, revision, checksum, payload FROM vehicles "
        "WHERE key = ?1");
    const absl::StatusOr<bool> found = row.Bind(1, key).Step();
    if (!found.ok()) return found.status();
    if (!*found) return UnknownVehicle("key " + std::to_string(key));
    return ReadVehicleRow(row);
  }();
  if (!record.ok()) return record.status();
  if (payload.has_value()) record->payload = *payload;
  record->revision = std::max(record->revision, revision);
  return WriteVehicleRow(database, *record);
}

absl::Status RemoveVehicle(SqliteDatabase& database, VehicleKey key) {
  absl::Status status = database.Prepare("DELETE FROM vehicles WHERE key = ?1")
                            .Bind(1, key)
                            .Run();
  if (!status.ok()) return status;
  if (database.Changes() == 0) {
    return UnknownVehicle("key " + std::to_string(key));
  }
  for (const PairKind kind : kPairKinds) {
    status = database.Prepare(StatementsOf(kind).remove_all.c_str())
                 .Bind(1, key)
                 .Run();
    if (!status.ok()) return status;
  }
  return database.Prepare("INSERT INTO deleted_vehicles (key) VALUES (?1)")
      .Bind(1, key)
      .Run();
}

absl::Status Gap(const std::string& vehicle_id, std::uint64_t expected,
                 const BatchRecord& batch) {
  return Error(StatusCode::kFailedPrecondition, "SEQUENCE_GAP",
               "vehicle '" + vehicle_id + "': got a batch from sequence " +
                   std::to_string(batch.first_sequence) + ", expected " +
                   std::to_string(expected),
               {{"expected_sequence", std::to_string(expected)}});
}

// `expected` is the sequence that comes next, where it is known: then it is not
// read. It is set to the one after the batch.
absl::Status InsertBatch(SqliteDatabase& database, VehicleKey key,
                         const BatchRecord& batch, std::uint64_t* expected) {
  if (*expected == 0) {
    const absl::StatusOr<std::string> id = VehicleId(database, key);
    if (!id.ok()) return id.status();
    const absl::StatusOr<std::optional<BatchRecord>> last =
        ReadLastBatch(database, key, *id);
    if (!last.ok()) return last.status();
    *expected =
        last->has_value() ? (*last)->first_sequence + (*last)->count : 1;
  }
  if (batch.first_sequence != *expected) {
    const absl::StatusOr<std::string> id = VehicleId(database, key);
    return id.ok() ? Gap(*id, *expected, batch) : id.status();
  }
  const absl::Status status =
      database
          .Prepare(
              "INSERT INTO batches (vehicle_key, first_sequence, count, "
              "format, revision, checksum, payload) "
              "VALUES (?1, ?2, ?3, ?4, ?5, ?6, ?7)")
          .Bind(1, key)
          .Bind(2, Signed(batch.first_sequence))
          .Bind(3, batch.count)
          .Bind(4, kStoreFormat)
          .Bind(5, Signed(batch.revision))
          .Bind(6, ChecksumOfBatch(kStoreFormat, key, BatchVersion::kAsSent,
                                   batch))
          .BindBlob(7, batch.payload)
          .Run();
  if (status.ok()) *expected += batch.count;
  return status;
}

absl::Status ReviseBatchRows(SqliteDatabase& database, VehicleKey key,
                             const std::vector<BatchRecord>& batches,
                             std::uint64_t revision) {
  absl::Status status = ChangeVehicle(database, key, std::nullopt, revision);
  for (const BatchRecord& batch : batches) {
    if (!status.ok()) break;
    {
      SqliteStatement row = database.Prepare(
          "SELECT count FROM batches WHERE vehicle_key = ?1 AND "
          "first_sequence = ?2");
      row.Bind(1, key).Bind(2, Signed(batch.first_sequence));
      const absl::StatusOr<bool> found = row.Step();
      if (!found.ok()) return found.status();
      if (!*found || row.Integer(0) != batch.count) {
        return Error(StatusCode::kFailedPrecondition, "INTERNAL",
                     "no batch with sequences " + Range(batch) +
                         " is stored that could be revised");
      }
    }
    BatchRecord revised = batch;
    revised.revision = revision;
    status = database
                 .Prepare(
                     "INSERT OR REPLACE INTO revised_batches (vehicle_key, "
                     "first_sequence, count, format, revision, checksum, "
                     "payload) VALUES (?1, ?2, ?3, ?4, ?5, ?6, ?7)")
                 .Bind(1, key)
                 .Bind(2, Signed(revised.first_sequence))
                 .Bind(3, revised.count)
                 .Bind(4, kStoreFormat)
                 .Bind(5, Signed(revised.revision))
                 .Bind(6, ChecksumOfBatch(kStoreFormat, key,
                                          BatchVersion::kCurrent, revised))
                 .BindBlob(7, revised.payload)
                 .Run();
  }
  return status;
}

absl::Status InsertPosePair(SqliteDatabase& database, VehicleKey key,
                            PairKind kind, const PosePairRecord& pair,
                            std::uint64_t revision) {
  const absl::Status status =
      ChangeVehicle(database, key, std::nullopt, revision);
  if (!status.ok()) return status;
  {
    SqliteStatement taken = database.Prepare(StatementsOf(kind).find.c_str());
    const absl::StatusOr<bool> found =
        taken.Bind(1, key).BindText(2, pair.id).Step();
    if (!found.ok()) return found.status();
    if (*found) {
      const PairWords words = WordsOf(kind);
      return Error(
          StatusCode::kAlreadyExists, words.exists,
          std::string(words.noun) + " '" + pair.id + "' exists already");
    }
  }
  return database.Prepare(StatementsOf(kind).insert.c_str())
      .Bind(1, key)
      .BindText(2, pair.id)
      .Bind(3, kStoreFormat)
      .Bind(4, Signed(pair.query_sequence))
      .Bind(5, Signed(pair.matched_sequence))
      .Bind(6, pair.create_time_ns)
      .Bind(7, ChecksumOfPosePair(kStoreFormat, key, kind, pair))
      .Run();
}

absl::Status RemovePosePair(SqliteDatabase& database, VehicleKey key,
                            PairKind kind, const std::string& id,
                            std::uint64_t revision) {
  absl::Status status = ChangeVehicle(database, key, std::nullopt, revision);
  if (!status.ok()) return status;
  status = database.Prepare(StatementsOf(kind).remove.c_str())
               .Bind(1, key)
               .BindText(2, id)
               .Run();
  if (!status.ok()) return status;
  if (database.Changes() == 0) {
    const PairWords words = WordsOf(kind);
    return Error(StatusCode::kNotFound, words.not_found,
                 "no such " + std::string(words.noun) + ": '" + id + "'");
  }
  return absl::OkStatus();
}

// Removes some rows of deleted vehicles; answers whether more may be left.
absl::StatusOr<bool> PurgeSome(SqliteDatabase& database) {
  VehicleKey key = 0;
  {
    SqliteStatement row =
        database.Prepare("SELECT key FROM deleted_vehicles LIMIT 1");
    const absl::StatusOr<bool> found = row.Step();
    if (!found.ok()) return found.status();
    if (!*found) return false;
    key = row.Integer(0);
  }
  int removed = 0;
  for (const char* sql :
       {"DELETE FROM batches WHERE rowid IN (SELECT rowid FROM batches WHERE "
        "vehicle_key = ?1 LIMIT ?2)",
        "DELETE FROM revised_batches WHERE rowid IN (SELECT rowid FROM "
        "revised_batches WHERE vehicle_key = ?1 LIMIT ?2)"}) {
    const absl::Status status =
        database.Prepare(sql).Bind(1, key).Bind(2, kPurgedBatches).Run();
    if (!status.ok()) return status;
    removed += database.Changes();
  }
  if (removed == 0) {
    const absl::Status status =
        database.Prepare("DELETE FROM deleted_vehicles WHERE key = ?1")
            .Bind(1, key)
            .Run();
    if (!status.ok()) return status;
  }
  return true;
}

absl::Status CheckKnownFormat(const std::string& path, std::int64_t application,
                              std::int64_t format) {
  if (application != kApplicationId) {
    return absl::FailedPreconditionError(path +
                                         " is an SQLite file of another "
                                         "program, not a store of revisit");
  }
  if (format < 1 || format > kStoreFormat) {
    return absl::FailedPreconditionError(
        "the store " + path + " has format " + std::to_string(format) +
        ", this server reads formats 1 to " + std::to_string(kStoreFormat) +
        (format > kStoreFormat ? ": use a newer server" : ""));
  }
  return absl::OkStatus();
}

// Sets up a new file, or checks one that is there and brings it to this format.
absl::Status CheckFormat(SqliteDatabase& database, const std::string& path) {
  const absl::StatusOr<std::int64_t> application =
      database.QueryInteger("PRAGMA application_id");
  if (!application.ok()) return application.status();
  const absl::StatusOr<std::int64_t> format =
      database.QueryInteger("PRAGMA user_version");
  if (!format.ok()) return format.status();
  const absl::StatusOr<std::int64_t> tables =
      database.QueryInteger("SELECT count(*) FROM sqlite_schema");
  if (!tables.ok()) return tables.status();
  if (*application == 0 && *format == 0 && *tables == 0) {
    const std::string sql =
        "PRAGMA page_size = " + std::to_string(kPageBytes) +
        "; BEGIN IMMEDIATE;" + std::string(kSchema) + kSchemaSince2 +
        "PRAGMA application_id = " + std::to_string(kApplicationId) +
        "; PRAGMA user_version = " + std::to_string(kStoreFormat) + "; COMMIT";
    return database.Execute(sql.c_str());
  }
  const absl::Status known = CheckKnownFormat(path, *application, *format);
  if (!known.ok()) return known;
  if (*format == kStoreFormat) return absl::OkStatus();
  // Not done until committed: a failure closes the connection, and that rolls
  // back.
  const std::string sql =
      "BEGIN IMMEDIATE;" + std::string(kSchemaSince2) +
      "PRAGMA user_version = " + std::to_string(kStoreFormat) + "; COMMIT";
  return database.Execute(sql.c_str());
}

// SQLite takes any table for ours that has its name. The words it was made with
// are stored: damage to them would show as a defect of the server, later.
absl::Status CheckSchema(SqliteDatabase& database, const std::string& path) {
  const absl::StatusOr<std::unique_ptr<SqliteDatabase>> expected =
      SqliteDatabase::Open(":memory:", SqliteDatabase::Mode::kReadWrite, "");
  if (!expected.ok()) return expected.status();
  const absl::Status made =
      (*expected)->Execute((std::string(kSchema) + kSchemaSince2).c_str());
  if (!made.ok()) return made;
  static constexpr char kTables[] =
      "SELECT name, sql FROM sqlite_schema WHERE type = 'table'";
  const auto read =
      [](SqliteDatabase& from,
         std::map<std::string, std::string>* tables) -> absl::Status {
    SqliteStatement row = from.Prepare(kTables);
    while (true) {
      const absl::StatusOr<bool> found = row.Step();
      if (!found.ok()) return found.status();
      if (!*found) return absl::OkStatus();
      (*tables)[row.Bytes(0)] = row.Bytes(1);
    }
  };
  std::map<std::string, std::string> ours;
  std::map<std::string, std::string> theirs;
  absl::Status status = read(**expected, &ours);
  if (status.ok()) status = read(database, &theirs);
  if (!status.ok()) return status;
  for (const auto& [name, sql] : ours) {
    const auto found = theirs.find(name);
    if (found == theirs.end() || found->second != sql) {
      return Corrupt("the store " + path + " is damaged: its table " + name +
                         " is not as it was made",
                     {});
    }
  }
  return absl::OkStatus();
}

// Whether the file begins as every SQLite file does.
bool BeginsAsDatabase(const std::string& path) {
  const std::string expected("SQLite format 3\0", 16);
  std::string found(expected.size(), ' ');
  std::ifstream file(path, std::ios::binary);
  file.read(found.data(), static_cast<std::streamsize>(found.size()));
  return file.gcount() == static_cast<std::streamsize>(found.size()) &&
         found == expected;
}

// Whether there is anything to read at all.
absl::Status CheckReadable(SqliteDatabase& database, const std::string& path) {
  const absl::Status status =
      database.QueryInteger("PRAGMA schema_version").status();
  if (!IsCorruption(status)) return status;
  const std::string what(status.message());
  if (!BeginsAsDatabase(path)) {
    return absl::FailedPreconditionError(path +
                                         " is not a store of revisit: " + what);
  }
  return Corrupt("the store " + path + " is damaged: " + what, {});
}

// Copies the log into the database, flushes that, and empties the log.
absl::Status EmptyLog(SqliteDatabase& database, DurableMark* mark) {
  const auto checkpoint = [&](const char* sql) -> absl::Status {
    SqliteStatement statement = database.Prepare(sql);
    const absl::StatusOr<bool> row = statement.Step();
    if (!row.ok()) return row.status();
    if (*row && statement.Integer(0) == 0) return absl::OkStatus();
    return Error(StatusCode::kUnavailable, "STORE_UNAVAILABLE",
                 "store: other readers keep the log from being copied");
  };
  absl::Status status = checkpoint("PRAGMA wal_checkpoint(FULL)");
  // All is in the database: an empty log is right from here on.
  if (status.ok()) status = mark->Clear();
  if (status.ok()) status = checkpoint("PRAGMA wal_checkpoint(TRUNCATE)");
  return status;
}

absl::StatusOr<std::unique_ptr<SqliteDatabase>> OpenWriter(
    const std::string& path, const std::string& vfs, DurableMark* mark) {
  absl::StatusOr<std::unique_ptr<SqliteDatabase>> database =
      SqliteDatabase::Open(path, SqliteDatabase::Mode::kReadWrite, vfs);
  if (!database.ok()) return database;
  // Else a failure below would remove a log that the mark speaks of.
  (*database)->KeepLogOnClose(true);
  // Before anything is changed in a file that may not be ours.
  absl::Status status = CheckReadable(**database, path);
  if (!status.ok()) return status;
  status = CheckFormat(**database, path);
  if (!status.ok()) return status;
  status = CheckSchema(**database, path);
  if (!status.ok()) return status;
  {
    SqliteStatement wal = (*database)->Prepare("PRAGMA journal_mode = WAL");
    const absl::StatusOr<bool> row = wal.Step();
    if (!row.ok()) return row.status();
    if (!*row || wal.Bytes(0) != "wal") {
      return absl::FailedPreconditionError(
          "the file system of " + path +
          " does not support SQLite's write-ahead log");
    }
  }
  status = (*database)->Execute(
      "PRAGMA synchronous = FULL;"
      "PRAGMA cell_size_check = ON;"
      "PRAGMA trusted_schema = OFF;"
      "PRAGMA temp_store = MEMORY;"
      "PRAGMA journal_size_limit = 67108864");
  if (!status.ok()) return status;
  // What the log holds may never have been flushed: the server before may have
  // been killed, or its device have failed, just then. From here on it counts
  // as durable, so it is made durable.
  status = EmptyLog(**database, mark);
  if (!status.ok()) return status;
  return database;
}

// Vehicles with rows in the unreadable part of the log that are nowhere else.
absl::StatusOr<std::set<std::string>> VehiclesBehind(const std::string& store,
                                                     const LogReport& log) {
  absl::StatusOr<std::unique_ptr<SqliteDatabase>> database =
      SqliteDatabase::Open(store, SqliteDatabase::Mode::kReadOnly, "");
  if (!database.ok()) return database.status();
  std::set<std::string> names;
  absl::Status failure;
  const absl::Status visited =
      VisitRowsBehind(store + "-wal", log, [&](const LoggedRow& row) {
        SqliteStatement found =
            row.table == LoggedRow::Table::kVehicles
                ? (*database)->Prepare(
                      "SELECT 1 FROM vehicles WHERE id = ?2 AND checksum = ?4")
            : row.table == LoggedRow::Table::kBatches
                ? (*database)->Prepare(
                      "SELECT 1 FROM batches WHERE vehicle_key = ?1 AND "
                      "first_sequence = ?3 AND checksum = ?4 UNION ALL "
                      "SELECT 1 FROM revised_batches WHERE vehicle_key = ?1 "
                      "AND first_sequence = ?3 AND checksum = ?4")
                : (*database)->Prepare(
                      "SELECT 1 FROM loop_closures WHERE vehicle_key = ?1 AND "
                      "id = ?2 AND checksum = ?4 UNION ALL SELECT 1 FROM "
                      "rejected_candidates WHERE vehicle_key = ?1 AND id = ?2 "
                      "AND checksum = ?4");
        if (row.table != LoggedRow::Table::kVehicles) {
          found.Bind(1, row.vehicle_key);
        }
        if (row.table != LoggedRow::Table::kBatches) found.BindText(2, row.id);
        if (row.table == LoggedRow::Table::kBatches) {
          found.Bind(3, row.first_sequence);
        }
        const absl::StatusOr<bool> is_there =
            found.Bind(4, row.checksum).Step();
        if (!is_there.ok()) {
          failure = is_there.status();
        } else if (!*is_there && row.table == LoggedRow::Table::kVehicles) {
          names.insert(Printable(row.id));
        } else if (!*is_there) {
          const absl::StatusOr<std::string> id =
              VehicleId(**database, row.vehicle_key);
          // One that was created only there names itself by its own row.
          if (id.ok()) names.insert(*id);
        }
      });
  if (!visited.ok()) return visited;
  if (!failure.ok() && names.empty()) return failure;
  return names;
}

// Whether the log holds all that it should; see write_ahead_log.h.
absl::Status CheckLog(const std::string& store, const SqliteOptions& options,
                      DurableMark* mark) {
  const auto warn = [&](const std::string& message) {
    if (options.warn) options.warn(message);
  };
  const std::string path = store + "-wal";
  const absl::StatusOr<LogReport> log = ReadLog(path);
  if (!log.ok()) return log.status();
  std::string what = log->damage;
  if (what.empty()) what = MissingFrom(*log, mark->Read());
  if (what.empty()) {
    if (log->has_unfinished_tail) {
      warn("the log " + path +
           " ends in an unfinished write, which was not acknowledged; it is "
           "left out");
    }
    return absl::OkStatus();
  }
  const absl::StatusOr<std::set<std::string>> vehicles =
      VehiclesBehind(store, *log);
  const std::string names = vehicles.ok() && !vehicles->empty()
                                ? Listed(*vehicles)
                                : "cannot be told";
  const std::string message = "the log " + path + " is damaged: " + what +
                              "; vehicles with lost changes: " + names;
  if (options.drop_damaged_log) {
    warn(message + "; dropped as told");
    return mark->Clear();
  }
  return Corrupt(message, {{"vehicles", names}});
}

// Whether a file that is not too large can be trusted to hide nothing.
absl::Status CheckFile(SqliteDatabase& database, const std::string& store,
                       const SqliteOptions& options) {
  std::error_code error;
  const std::uintmax_t bytes = std::filesystem::file_size(store, error);
  if (error || bytes > Unsigned(options.max_checked_bytes)) {
    return absl::OkStatus();
  }
  const absl::StatusOr<std::vector<std::string>> problems =
      FindStructuralDamage(database, StoreUse::kIdle, store);
  if (!problems.ok() && !IsCorruption(problems.status())) {
    return problems.status();
  }
  if (problems.ok() && problems->empty()) return absl::OkStatus();
  const std::string what = problems.ok()
                               ? problems->front()
                               : std::string(problems.status().message());
  const absl::StatusOr<StoreReport> report = CheckStore(store, StoreUse::kIdle);
  const std::string names = report.ok() && !report->damaged_vehicles.empty()
                                ? Listed(report->damaged_vehicles)
                                : "cannot be told";
  return Corrupt("the store " + store + " is damaged: " + what +
                     "; vehicles that cannot be read whole: " + names,
                 {{"vehicles", names}});
}

class SqliteStorage : public Storage {
 public:
  SqliteStorage(std::string path, const SqliteOptions& options,
                std::unique_ptr<StoreLock> lock,
                std::unique_ptr<DurableMark> mark,
                std::unique_ptr<SqliteDatabase> writer,
                std::unique_ptr<SqliteDatabase> anchor)
      : path_(std::move(path)),
        options_(options),
        lock_(std::move(lock)),
        mark_(std::move(mark)),
        space_(options.min_free_bytes,
               [file = path_] {
                 return FreeBytes(std::filesystem::path(file).parent_path());
               }),
        writer_(std::move(writer)),
        anchor_(std::move(anchor)),
        thread_([this] { Write(); }) {
    // For tools that list threads.
    pthread_setname_np(thread_.native_handle(), "store-writer");
  }

  ~SqliteStorage() override {
    {
      const MutexLock guard(&mutex_);
      stopping_ = true;
    }
    wake_.NotifyOne();
    thread_.join();
    // An orderly end leaves no log.
    if (writer_ != nullptr && mark_->Clear().ok()) {
      writer_->KeepLogOnClose(false);
    }
  }

  void CreateVehicle(
      VehicleRecord record,
      std::function<void(absl::StatusOr<VehicleKey>)> done) override {
    const std::size_t bytes = record.payload.size();
    auto key = std::make_shared<VehicleKey>(0);
    Submit(
        bytes,
        [record = std::move(record), key](SqliteDatabase& database) {
          const absl::StatusOr<VehicleKey> inserted =
              InsertVehicle(database, record);
          if (inserted.ok()) *key = *inserted;
          return inserted.status();
        },
        [key, done = std::move(done)](absl::Status status) {
          if (!status.ok()) {
            done(std::move(status));
          } else {
            done(*key);
          }
        });
  }

  void UpdateVehicle(VehicleKey key, std::string payload,
                     std::uint64_t revision, Done done) override {
    const std::size_t bytes = payload.size();
    Submit(
        bytes,
        [key, payload = std::move(payload),
         revision](SqliteDatabase& database) {
          return ChangeVehicle(database, key, payload, revision);
        },
        std::move(done));
  }

  void DeleteVehicle(VehicleKey key, Done done) override {
    Submit(
        0,
        [this, key](SqliteDatabase& database) {
          const absl::Status status = RemoveVehicle(database, key);
          if (status.ok()) purge_ = true;
          next_sequences_.erase(key);
          return status;
        },
        std::move(done), Need::kLittle);
  }

  void AppendBatch(VehicleKey key, BatchRecord batch,
                   std::optional<std::string> vehicle_payload,
                   Done done) override {
    PendingWrite write;
    write.bytes = batch.payload.size();
    write.done.push_back(std::move(done));
    if (!vehicle_payload.has_value()) {
      write.key = key;
      write.batch = std::move(batch);
      SubmitAppend(std::move(write));
      return;
    }
    write.apply = [this, key, batch = std::move(batch),
                   payload =
                       std::move(vehicle_payload)](SqliteDatabase& database) {
      const absl::Status status = Append(database, key, batch);
      if (!status.ok()) return status;
      return ChangeVehicle(database, key, payload, batch.revision);
    };
    Submit(std::move(write));
  }

  void ReviseBatches(VehicleKey key, std::vector<BatchRecord> batches,
                     std::uint64_t revision, Done done) override {
    std::size_t bytes = 0;
    for (const BatchRecord& batch : batches) bytes += batch.payload.size();
    Submit(
        bytes,
        [key, batches = std::move(batches),
         revision](SqliteDatabase& database) {
          return ReviseBatchRows(database, key, batches, revision);
        },
        std::move(done));
  }

  void AddPosePair(VehicleKey key, PairKind kind, PosePairRecord pair,
                   std::uint64_t revision, Done done) override {
    Submit(
        0,
        [key, kind, pair = std::move(pair),
         revision](SqliteDatabase& database) {
          return InsertPosePair(database, key, kind, pair, revision);
        },
        std::move(done));
  }

  void DeletePosePair(VehicleKey key, PairKind kind, std::string id,
                      std::uint64_t revision, Done done) override {
    Submit(
        0,
        [key, kind, id = std::move(id), revision](SqliteDatabase& database) {
          return RemovePosePair(database, key, kind, id, revision);
        },
        std::move(done));
  }

  absl::StatusOr<VehicleRecord> GetVehicle(const std::string& id) override {
    VehicleRecord record;
    const absl::Status status = Read([&](SqliteDatabase& database) {
      SqliteStatement row = database.Prepare(
          "SELECT key, id, format, revision, checksum, payload FROM vehicles "
          "WHERE id = ?1");
      const absl::StatusOr<bool> found = row.BindText(1, id).Step();
      if (!found.ok()) return found.status();
      if (!*found) return UnknownVehicle("'" + id + "'");
      absl::StatusOr<VehicleRecord> read = ReadVehicleRow(row);
      if (!read.ok()) return read.status();
      record = *std::move(read);
      return CompleteVehicle(database, &record);
    });
    if (!status.ok()) return status;
    return record;
  }

  absl::StatusOr<std::vector<VehicleRecord>> ListVehicles(
      const std::string& after_id, const std::string& prefix,
      int limit) override {
    std::vector<VehicleRecord> records;
    // Ids are ASCII.
    const std::string beyond = prefix + "\x7f";
    const absl::Status status = Read([&](SqliteDatabase& database) {
      SqliteStatement row = database.Prepare(
          "SELECT key, id, format, revision, checksum, payload FROM vehicles "
          "WHERE id > ?1 AND id >= ?2 AND id < ?3 ORDER BY id LIMIT ?4");
      row.BindText(1, after_id).BindText(2, prefix).BindText(3, beyond);
      row.Bind(4, std::max(limit, 0));
      while (true) {
        const absl::StatusOr<bool> found = row.Step();
        if (!found.ok()) return found.status();
        if (!*found) return absl::OkStatus();
        absl::StatusOr<VehicleRecord> record = ReadVehicleRow(row);
        if (!record.ok()) return record.status();
        const absl::Status completed = CompleteVehicle(database, &*record);
        if (!completed.ok()) return completed;
        records.push_back(*std::move(record));
      }
    });
    if (!status.ok()) return status;
    return records;
  }

  absl::Status ReadBatches(
      VehicleKey key, std::uint64_t first_sequence, std::uint64_t last_sequence,
      BatchVersion version,
      const std::function<bool(BatchRecord)>& visit) override {
    return Read([&](SqliteDatabase& database) {
      return VisitBatches(database, key, first_sequence, last_sequence, version,
                          visit);
    });
  }

  absl::StatusOr<std::vector<PosePairRecord>> ListPosePairs(
      VehicleKey key, PairKind kind, const std::string& after_id,
      int limit) override {
    std::vector<PosePairRecord> pairs;
    const absl::Status status = Read([&](SqliteDatabase& database) {
      const absl::StatusOr<std::string> vehicle_id = VehicleId(database, key);
      if (!vehicle_id.ok()) return vehicle_id.status();
      SqliteStatement row = database.Prepare(StatementsOf(kind).list.c_str());
      row.Bind(1, key).BindText(2, after_id).Bind(3, std::max(limit, 0));
      while (true) {
        const absl::StatusOr<bool> found = row.Step();
        if (!found.ok()) return found.status();
        if (!*found) return absl::OkStatus();
        PosePairRecord pair;
        pair.id = row.Bytes(0);
        const std::int64_t format = row.Integer(1);
        pair.query_sequence = Unsigned(row.Integer(2));
        pair.matched_sequence = Unsigned(row.Integer(3));
        pair.create_time_ns = row.Integer(4);
        const PairWords words = WordsOf(kind);
        const absl::Status checked = CheckRow(
            format, row.Integer(5), ChecksumOfPosePair(format, key, kind, pair),
            "stored " + std::string(words.noun) + " '" + Printable(pair.id) +
                "' of vehicle '" + *vehicle_id + "'",
            {{"vehicle", *vehicle_id}, {words.field, Printable(pair.id)}});
        if (!checked.ok()) return checked;
        pairs.push_back(std::move(pair));
      }
    });
    if (!status.ok()) return status;
    return pairs;
  }

  CommitCounts Counts() const override { return {commits_, writes_}; }

 private:
  using Clock = std::chrono::steady_clock;

  // Whether a write may be taken on where there is little room.
  enum class Need { kRoom, kLittle };

  // One row of `batches`, or something else.
  struct PendingWrite {
    std::size_t bytes = 0;
    // Of a row: one append, or several of a vehicle that follow each other.
    VehicleKey key = 0;
    BatchRecord batch;
    // Of something else: may be called again after it was rolled back.
    std::function<absl::Status(SqliteDatabase&)> apply;
    // Of everything that this is.
    std::vector<Done> done;
    Need need = Need::kRoom;
  };

  static absl::Status VisitBatches(
      SqliteDatabase& database, VehicleKey key, std::uint64_t first_sequence,
      std::uint64_t last_sequence, BatchVersion version,
      const std::function<bool(BatchRecord)>& visit) {
    const absl::StatusOr<std::string> vehicle_id = VehicleId(database, key);
    if (!vehicle_id.ok()) return vehicle_id.status();
    if (first_sequence > last_sequence) return absl::OkStatus();
    SqliteStatement row =
        version == BatchVersion::kAsSent
            ? database.Prepare(
                  "SELECT first_sequence, count, format, revision, checksum, "
                  "payload FROM batches WHERE vehicle_key = ?1 AND "
                  "first_sequence >= (SELECT max(first_sequence) FROM batches "
                  "WHERE vehicle_key = ?1 AND first_sequence <= ?2) AND "
                  "first_sequence <= ?3 ORDER BY first_sequence")
            : database.Prepare(
                  "SELECT b.first_sequence, b.count, b.format, b.revision, "
                  "b.checksum, b.payload, r.count, r.format, r.revision, "
                  "r.checksum, r.payload FROM batches AS b LEFT JOIN "
                  "revised_batches AS r ON r.vehicle_key = b.vehicle_key AND "
                  "r.first_sequence = b.first_sequence WHERE b.vehicle_key = "
                  "?1 AND b.first_sequence >= (SELECT max(first_sequence) FROM "
                  "batches WHERE vehicle_key = ?1 AND first_sequence <= ?2) "
                  "AND b.first_sequence <= ?3 ORDER BY b.first_sequence");
    row.Bind(1, key).Bind(2, Signed(first_sequence));
    row.Bind(3, Signed(last_sequence));
    std::uint64_t expected = first_sequence;
    while (expected <= last_sequence) {
      const absl::StatusOr<bool> found = row.Step();
      if (!found.ok()) return found.status();
      const bool revised =
          *found && version == BatchVersion::kCurrent && !row.IsNull(6);
      absl::StatusOr<BatchRecord> batch = BatchRecord();
      if (*found) {
        batch = revised ? ReadBatchRow(row, 7, row.Integer(0), row.Integer(6),
                                       key, *vehicle_id, BatchVersion::kCurrent)
                        : ReadBatchRow(row, 2, row.Integer(0), row.Integer(1),
                                       key, *vehicle_id, BatchVersion::kAsSent);
        if (!batch.ok()) return batch.status();
      }
      // The first may begin before the range, all others follow each other.
      const bool fits =
          *found &&
          (expected == first_sequence ? batch->first_sequence <= expected
                                      : batch->first_sequence == expected) &&
          batch->first_sequence + batch->count > expected;
      if (!fits) {
        return Corrupt(
            "vehicle '" + *vehicle_id + "': sequence " +
                std::to_string(expected) + " is not in the store",
            {{"vehicle", *vehicle_id}, {"sequence", std::to_string(expected)}});
      }
      expected = batch->first_sequence + batch->count;
      if (!visit(*std::move(batch))) break;
    }
    return absl::OkStatus();
  }

  void Submit(std::size_t bytes,
              std::function<absl::Status(SqliteDatabase&)> apply, Done done,
              Need need = Need::kRoom) {
    PendingWrite write;
    write.bytes = bytes;
    write.apply = std::move(apply);
    write.done.push_back(std::move(done));
    write.need = need;
    Submit(std::move(write));
  }

  void Submit(PendingWrite write) {
    {
      const MutexLock guard(&mutex_);
      // What comes later of any vehicle must not get before it.
      open_rows_.clear();
      Enqueue(std::move(write));
    }
    wake_.NotifyOne();
  }

  void SubmitAppend(PendingWrite write) {
    bool wake;
    {
      const MutexLock guard(&mutex_);
      wake = queue_.empty();
      const auto open = open_rows_.find(write.key);
      if (open != open_rows_.end() && Join(open->second, &write)) {
        ++waiting_writes_;
      } else {
        Enqueue(std::move(write));
        open_rows_[queue_.back().key] = &queue_.back();
      }
      // One that is busy looks by itself.
      wake = wake || (gathering_ && waiting_writes_ >= last_group_writes_);
    }
    if (wake) wake_.NotifyOne();
  }

  void Enqueue(PendingWrite write) ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_) {
    if (queue_.empty()) oldest_submission_ = Clock::now();
    ++waiting_writes_;
    queue_.push_back(std::move(write));
  }

  // Makes an append part of a row that waits, if it follows and fits.
  bool Join(PendingWrite* row, PendingWrite* append) const {
    if (append->batch.first_sequence !=
            row->batch.first_sequence + row->batch.count ||
        row->batch.count + append->batch.count > options_.max_joined_poses ||
        row->bytes + append->bytes > options_.max_joined_bytes) {
      return false;
    }
    row->batch.payload += append->batch.payload;
    row->batch.count += append->batch.count;
    row->batch.revision = append->batch.revision;
    row->bytes += append->bytes;
    row->done.push_back(std::move(append->done.front()));
    return true;
  }

  // The writer's thread.
  void Write() {
    MutexLock lock(&mutex_);
    while (true) {
      // A rest of deleted rows is removed when there is nothing better to do,
      // and left for the next start if the server stops.
      while (!stopping_ && !purge_ && queue_.empty()) wake_.Wait(&mutex_);
      if (queue_.empty() && stopping_) break;
      Gather();
      std::vector<PendingWrite> group;
      std::size_t bytes = 0;
      std::size_t writes = 0;
      while (!queue_.empty() && group.size() < options_.max_group_writes &&
             (group.empty() ||
              bytes + queue_.front().bytes <= options_.max_group_bytes)) {
        bytes += queue_.front().bytes;
        writes += queue_.front().done.size();
        group.push_back(std::move(queue_.front()));
        queue_.pop_front();
      }
      open_rows_.clear();
      waiting_writes_ -= writes;
      last_group_writes_ = writes;
      // Of those that are left behind, near enough.
      oldest_submission_ = Clock::now();
      lock.Unlock();
      const std::vector<absl::Status> results = CommitOrRefuse(group);
      for (std::size_t i = 0; i < group.size(); ++i) {
        for (const Done& done : group[i].done) done(results[i]);
      }
      // What the callbacks hold goes before others are taken on.
      group.clear();
      lock.Lock();
    }
    // Rids the log of a transaction that failed last.
    if (lock_ != nullptr) EnsureWriter().IgnoreError();
  }

  // Waits for more, see SqliteOptions::latency_target.
  void Gather() ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_) {
    if (options_.latency_target <= commit_time_) return;
    gathering_ = true;
    while (!stopping_ && !queue_.empty() &&
           waiting_writes_ < last_group_writes_) {
      const Clock::time_point latest =
          oldest_submission_ + options_.latency_target - commit_time_;
      if (wake_.WaitUntil(&mutex_, latest)) break;
    }
    gathering_ = false;
  }

  // What became of each write of a group, for all that it is made of.
  std::vector<absl::Status> CommitOrRefuse(
      const std::vector<PendingWrite>& group) {
    const absl::Status room = lock_ != nullptr ? space_.Check() : ReadOnly();
    const bool is_pointless =
        !room.ok() &&
        std::none_of(group.begin(), group.end(), [](const PendingWrite& write) {
          return write.need == Need::kLittle;
        });
    if (is_pointless || lock_ == nullptr) {
      purge_ = false;
      return std::vector<absl::Status>(group.size(), room);
    }
    const Clock::time_point start = Clock::now();
    std::vector<absl::Status> results = Commit(group, room);
    // Follows the device, and forgets a single slow flush soon.
    commit_time_ += (Clock::now() - start - commit_time_) / 8;
    return results;
  }

  // Writes a group in one transaction, without `room` what needs little of it.
  std::vector<absl::Status> Commit(const std::vector<PendingWrite>& group,
                                   const absl::Status& room) {
    std::vector<absl::Status> results;
    absl::Status status = EnsureWriter();
    if (status.ok()) status = writer_->Prepare("BEGIN IMMEDIATE").Run();
    const bool begun = status.ok();
    // Rows are inserted without a savepoint each, which costs more than the
    // insertion. Should one of them damage the transaction, which takes a
    // damaged file or a full disk, all is begun again with savepoints.
    if (begun && !ApplyAll(group, room, /*careful=*/false, &results, &status)) {
      next_sequences_.clear();
      status = writer_->Prepare("ROLLBACK").Run();
      if (status.ok()) status = writer_->Prepare("BEGIN IMMEDIATE").Run();
      if (status.ok()) {
        ApplyAll(group, room, /*careful=*/true, &results, &status);
      }
    }
    bool purged = false;
    if (status.ok() && purge_) {
      const absl::StatusOr<bool> more = PurgeSome(*writer_);
      status = more.status();
      purged = more.ok() && *more;
      purge_ = purged;
    }
    if (status.ok()) status = writer_->Prepare("COMMIT").Run();
    if (status.ok()) {
      Count(group, results);
      // Where all was refused there was nothing to flush, and the log may have
      // been begun anew without a commit in it.
      if (purged ||
          std::any_of(results.begin(), results.end(),
                      [](const absl::Status& result) { return result.ok(); })) {
        const absl::StatusOr<LogPosition> flushed = writer_->LogEnd();
        if (flushed.ok()) mark_->Write(*flushed);
      }
      if (IsFailedFlush(writer_->copy_failure())) {
        GiveUp(writer_->copy_failure());
      }
      return results;
    }

    // Whatever is left is in doubt; see the header. Where not even BEGIN
    // succeeded, nothing was touched.
    if (begun) writer_.reset();
    next_sequences_.clear();
    // Else a full disk would be asked again and again. Taken up after the next
    // delete or start.
    purge_ = false;
    const std::string message =
        "nothing was written: " + std::string(status.message());
    absl::Status failure =
        Error(StatusCode::kUnavailable, "STORE_UNAVAILABLE", message);
    if (IsStorageFull(status)) failure = StorageFull(message);
    if (IsFailedFlush(status)) {
      GiveUp(status);
      failure = given_up_;
    }
    return std::vector<absl::Status>(group.size(), failure);
  }

  // What a transaction that was committed held.
  void Count(const std::vector<PendingWrite>& group,
             const std::vector<absl::Status>& results) {
    std::uint64_t writes = 0;
    for (std::size_t i = 0; i < group.size(); ++i) {
      if (results[i].ok()) writes += group[i].done.size();
    }
    if (writes > 0) ++commits_;
    writes_ += writes;
  }

  static absl::Status ReadOnly() {
    return Error(StatusCode::kFailedPrecondition, "INTERNAL",
                 "this store was opened for reading");
  }

  // After a failed flush; see the header.
  void GiveUp(const absl::Status& cause) {
    if (!given_up_.ok()) return;
    given_up_ = Error(StatusCode::kUnavailable, "STORE_SYNC_FAILED",
                      "the store takes no more writes, since a flush failed: " +
                          std::string(cause.message()));
    if (options_.on_failed_flush) options_.on_failed_flush(given_up_);
  }

  // Answers whether all writes could be applied or refused; `status` is not OK
  // if the transaction cannot go on.
  bool ApplyAll(const std::vector<PendingWrite>& group,
                const absl::Status& room, bool careful,
                std::vector<absl::Status>* results, absl::Status* status) {
    results->clear();
    for (const PendingWrite& write : group) {
      if (!room.ok() && write.need == Need::kRoom) {
        // Nothing was touched: what comes next of its vehicle is as it was.
        results->push_back(room);
        continue;
      }
      if (careful || write.apply) {
        results->emplace_back();
        *status = ApplyAlone(write, &results->back());
        if (!status->ok()) return true;
        continue;
      }
      absl::Status result = Append(*writer_, write.key, write.batch);
      // SQLite gives up the whole transaction after some errors.
      if (result.code() == StatusCode::kUnavailable ||
          !writer_->InTransaction()) {
        *status = std::move(result);
        return true;
      }
      // A row that does not follow was refused before anything was touched.
      if (!result.ok() && result.code() != StatusCode::kFailedPrecondition &&
          result.code() != StatusCode::kNotFound) {
        return false;
      }
      results->push_back(std::move(result));
    }
    return true;
  }

  absl::Status Apply(SqliteDatabase& database, const PendingWrite& write) {
    return write.apply ? write.apply(database)
                       : Append(database, write.key, write.batch);
  }

  absl::Status Append(SqliteDatabase& database, VehicleKey key,
                      const BatchRecord& batch) {
    if (next_sequences_.size() >= kMaxKnownSequences) next_sequences_.clear();
    std::uint64_t& next = next_sequences_[key];
    const absl::Status status = InsertBatch(database, key, batch, &next);
    // What a refused write did is rolled back.
    if (!status.ok()) next_sequences_.erase(key);
    return status;
  }

  // Applies one write so that, refused, it leaves nothing behind. Answers not
  // OK if the transaction cannot go on.
  absl::Status ApplyAlone(const PendingWrite& write, absl::Status* result) {
    absl::Status status = writer_->Prepare("SAVEPOINT one").Run();
    if (!status.ok()) return status;
    *result = Apply(*writer_, write);
    if (result->code() == StatusCode::kUnavailable) return *result;
    // SQLite gives up the whole transaction after some errors.
    if (!writer_->InTransaction()) return *result;
    if (!result->ok()) {
      next_sequences_.clear();
      status = writer_->Prepare("ROLLBACK TO one").Run();
      if (!status.ok()) return status;
    }
    return writer_->Prepare("RELEASE one").Run();
  }

  absl::Status EnsureWriter() {
    if (!given_up_.ok()) return given_up_;
    if (writer_ != nullptr) return absl::OkStatus();
    absl::StatusOr<std::unique_ptr<SqliteDatabase>> opened =
        OpenWriter(path_, options_.vfs, mark_.get());
    if (!opened.ok()) return opened.status();
    writer_ = *std::move(opened);
    return absl::OkStatus();
  }

  // Runs `read` on a connection of its own, all of it at one moment.
  template <typename Function>
  absl::Status Read(const Function& read) {
    std::unique_ptr<SqliteDatabase> reader;
    {
      const MutexLock guard(&readers_mutex_);
      if (!idle_readers_.empty()) {
        reader = std::move(idle_readers_.back());
        idle_readers_.pop_back();
      }
    }
    if (reader == nullptr) {
      absl::StatusOr<std::unique_ptr<SqliteDatabase>> opened =
          SqliteDatabase::Open(path_, SqliteDatabase::Mode::kReadOnly,
                               options_.vfs);
      if (!opened.ok()) return opened.status();
      reader = *std::move(opened);
    }
    absl::Status status = reader->Prepare("BEGIN").Run();
    if (status.ok()) {
      status = read(*reader);
      // Nothing to commit, but the moment must end.
      const absl::Status ended = reader->Prepare("COMMIT").Run();
      if (status.ok()) status = ended;
    }
    const bool usable = !reader->InTransaction();
    const MutexLock guard(&readers_mutex_);
    if (usable && idle_readers_.size() < kIdleReaders) {
      idle_readers_.push_back(std::move(reader));
    }
    return status;
  }

  const std::string path_;
  const SqliteOptions options_;
  // Nothing if opened for reading; so is the mark.
  const std::unique_ptr<StoreLock> lock_;
  const std::unique_ptr<DurableMark> mark_;

  // The writer's thread only, once it runs.
  FreeSpaceGuard space_;
  // Why no write is taken on any more.
  absl::Status given_up_;
  // Nothing after a failure.
  std::unique_ptr<SqliteDatabase> writer_;
  bool purge_ = true;
  // The sequence that comes next of vehicles that were written to, as the
  // transaction under way would have it. Forgotten when that is in doubt.
  std::unordered_map<VehicleKey, std::uint64_t> next_sequences_;
  // What a commit takes.
  Clock::duration commit_time_{0};
  // Written by that thread.
  std::atomic<std::uint64_t> commits_{0};
  std::atomic<std::uint64_t> writes_{0};

  // Keeps the log's index in shared memory while the writer is opened anew: it
  // would otherwise be made from the log, failed transactions included.
  const std::unique_ptr<SqliteDatabase> anchor_;

  Mutex mutex_;
  CondVar wake_;
  std::deque<PendingWrite> queue_ ABSL_GUARDED_BY(mutex_);
  // By vehicle, the row in the queue that appends may still join.
  std::unordered_map<VehicleKey, PendingWrite*> open_rows_
      ABSL_GUARDED_BY(mutex_);
  bool stopping_ ABSL_GUARDED_BY(mutex_) = false;
  // In the queue, each batch of a row counted.
  std::size_t waiting_writes_ ABSL_GUARDED_BY(mutex_) = 0;
  std::size_t last_group_writes_ ABSL_GUARDED_BY(mutex_) = 0;
  // Of the first in the queue, or when the last group was taken.
  Clock::time_point oldest_submission_ ABSL_GUARDED_BY(mutex_);
  bool gathering_ ABSL_GUARDED_BY(mutex_) = false;

  Mutex readers_mutex_;
  std::vector<std::unique_ptr<SqliteDatabase>> idle_readers_
      ABSL_GUARDED_BY(readers_mutex_);

  std::thread thread_;
};

// A connection that reads, and so holds the log and its index.
absl::StatusOr<std::unique_ptr<SqliteDatabase>> OpenAnchor(
    const std::string& store, const std::string& vfs) {
  absl::StatusOr<std::unique_ptr<SqliteDatabase>> anchor =
      SqliteDatabase::Open(store, SqliteDatabase::Mode::kReadOnly, vfs);
  if (!anchor.ok()) return anchor;
  const absl::Status readable = CheckReadable(**anchor, store);
  if (!readable.ok()) return readable;
  return anchor;
}

// Two names of one file must find the same lock.
std::string Canonical(const std::string& path) {
  std::error_code error;
  const std::filesystem::path canonical =
      std::filesystem::weakly_canonical(std::filesystem::path(path), error);
  return error ? path : canonical.string();
}

}  // namespace

absl::StatusOr<std::unique_ptr<Storage>> OpenSqliteStorage(
    const std::string& path, const SqliteOptions& options) {
  const std::string store = Canonical(path);
  absl::StatusOr<std::unique_ptr<StoreLock>> lock = StoreLock::Acquire(store);
  if (!lock.ok()) return lock.status();
  absl::StatusOr<std::unique_ptr<DurableMark>> mark = DurableMark::Open(store);
  if (!mark.ok()) return mark.status();
  const absl::Status whole = CheckLog(store, options, mark->get());
  if (!whole.ok()) return whole;
  absl::StatusOr<std::unique_ptr<SqliteDatabase>> writer =
      OpenWriter(store, options.vfs, mark->get());
  if (IsStorageFull(writer.status()) && GiveUpReserve(store)) {
    writer = OpenWriter(store, options.vfs, mark->get());
  }
  if (!writer.ok() && !IsStorageFull(writer.status())) return writer.status();
  if (!writer.ok()) {
    // What is told to be durable from here on must be, at least as far as the
    // log goes.
    const absl::Status flushed = FlushFile(store + "-wal");
    if (!flushed.ok()) return flushed;
    if (options.warn) {
      options.warn("nothing can be written until there is room: " +
                   std::string(writer.status().message()));
    }
  }
  absl::StatusOr<std::unique_ptr<SqliteDatabase>> anchor =
      OpenAnchor(store, options.vfs);
  if (!anchor.ok()) return anchor.status();
  const absl::Status sound = CheckFile(**anchor, store, options);
  if (!sound.ok()) return sound;
  if (writer.ok()) KeepReserve(store);
  return std::unique_ptr<Storage>(new SqliteStorage(
      store, options, *std::move(lock), *std::move(mark),
      writer.ok() ? *std::move(writer) : nullptr, *std::move(anchor)));
}

absl::StatusOr<std::unique_ptr<SqliteDatabase>> OpenDatabaseToRead(
    const std::string& path) {
  absl::StatusOr<std::unique_ptr<SqliteDatabase>> database =
      OpenAnchor(path, "");
  if (!database.ok()) return database;
  const absl::StatusOr<std::int64_t> application =
      (*database)->QueryInteger("PRAGMA application_id");
  if (!application.ok()) return application.status();
  const absl::StatusOr<std::int64_t> format =
      (*database)->QueryInteger("PRAGMA user_version");
  if (!format.ok()) return format.status();
  const absl::Status known = CheckKnownFormat(path, *application, *format);
  if (!known.ok()) return known;
  if (*format != kStoreFormat) {
    return absl::FailedPreconditionError(
        "the store " + path + " has format " + std::to_string(*format) +
        ": a server that is started on it brings it to format " +
        std::to_string(kStoreFormat));
  }
  const absl::Status schema = CheckSchema(**database, path);
  if (!schema.ok()) return schema;
  return database;
}

absl::StatusOr<std::unique_ptr<Storage>> OpenSqliteStorageToRead(
    const std::string& path) {
  absl::StatusOr<std::unique_ptr<SqliteDatabase>> anchor =
      OpenDatabaseToRead(path);
  if (!anchor.ok()) return anchor.status();
  return std::unique_ptr<Storage>(new SqliteStorage(
      path, SqliteOptions(), nullptr, nullptr, nullptr, *std::move(anchor)));
}

}  // namespace revisit::server
