#include "server/storage/store_opening.h"

#include <cstdint>
#include <filesystem>
#include <fstream>
#include <map>
#include <set>
#include <system_error>
#include <utility>
#include <vector>

#include "server/status.h"
#include "server/storage/store_check.h"
#include "server/storage/store_files.h"
#include "server/storage/store_rows.h"
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
// Keep in step: kStoreFormat, the list in sqlite_storage.h, record_checksum.h.
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

// What the head of an SQLite file says of who made it; both 0 in a new one.
struct FileFormat {
  std::int64_t application = 0;
  std::int64_t version = 0;
};

absl::StatusOr<FileFormat> ReadFormat(SqliteDatabase& database) {
  const absl::StatusOr<std::int64_t> application =
      database.QueryInteger("PRAGMA application_id");
  if (!application.ok()) return application.status();
  const absl::StatusOr<std::int64_t> version =
      database.QueryInteger("PRAGMA user_version");
  if (!version.ok()) return version.status();
  return FileFormat{*application, *version};
}

absl::Status CheckKnownFormat(const std::string& path,
                              const FileFormat& format) {
  if (format.application != kApplicationId) {
    return absl::FailedPreconditionError(path +
                                         " is an SQLite file of another "
                                         "program, not a store of revisit");
  }
  if (format.version < 1 || format.version > kStoreFormat) {
    return absl::FailedPreconditionError(
        "the store " + path + " has format " + std::to_string(format.version) +
        ", this server reads formats 1 to " + std::to_string(kStoreFormat) +
        (format.version > kStoreFormat ? ": use a newer server" : ""));
  }
  return absl::OkStatus();
}

// Sets up a new file, or checks one that is there and brings it to this format.
absl::Status CheckFormat(SqliteDatabase& database, const std::string& path) {
  const absl::StatusOr<FileFormat> format = ReadFormat(database);
  if (!format.ok()) return format.status();
  const absl::StatusOr<std::int64_t> tables =
      database.QueryInteger("SELECT count(*) FROM sqlite_schema");
  if (!tables.ok()) return tables.status();
  if (format->application == 0 && format->version == 0 && *tables == 0) {
    const std::string sql =
        "PRAGMA page_size = " + std::to_string(kPageBytes) +
        "; BEGIN IMMEDIATE;" + std::string(kSchema) + kSchemaSince2 +
        "PRAGMA application_id = " + std::to_string(kApplicationId) +
        "; PRAGMA user_version = " + std::to_string(kStoreFormat) + "; COMMIT";
    return database.Execute(sql.c_str());
  }
  const absl::Status known = CheckKnownFormat(path, *format);
  if (!known.ok()) return known;
  if (format->version == kStoreFormat) return absl::OkStatus();
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

// Vehicles with rows in the unreadable part of the log that are nowhere else.
absl::StatusOr<std::set<std::string>> VehiclesBehind(const std::string& store,
                                                     const LogReport& log) {
  absl::StatusOr<std::unique_ptr<SqliteDatabase>> database =
      SqliteDatabase::Open(store, SqliteDatabase::Mode::kReadOnly, "");
  if (!database.ok()) return database.status();
  std::set<std::string> names;
  absl::Status failure;
  const absl::Status visited =
      VisitRowsBehind(LogOf(store), log, [&](const LoggedRow& row) {
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

std::string LostIn(const LogExamination& examination) {
  return examination.vehicles.empty() ? "cannot be told"
                                      : Listed(examination.vehicles);
}

}  // namespace

absl::StatusOr<LogExamination> ExamineLog(
    const std::string& store, const std::optional<LogPosition>& known) {
  const absl::StatusOr<LogReport> log = ReadLog(LogOf(store));
  if (!log.ok()) return log.status();
  LogExamination examination;
  examination.has_unfinished_tail = log->has_unfinished_tail;
  examination.damage = log->damage;
  if (examination.damage.empty()) {
    examination.damage = MissingFrom(*log, known);
  }
  if (examination.damage.empty()) return examination;
  absl::StatusOr<std::set<std::string>> vehicles = VehiclesBehind(store, *log);
  if (vehicles.ok()) examination.vehicles = *std::move(vehicles);
  return examination;
}

std::string DamageText(const std::string& store,
                       const LogExamination& examination) {
  return "the log " + LogOf(store) + " is damaged: " + examination.damage +
         "; vehicles with lost changes: " + LostIn(examination);
}

absl::Status CheckLog(const std::string& store, bool drop_damaged_log,
                      const std::function<void(const std::string&)>& warn,
                      DurableMark* mark) {
  const auto tell = [&](const std::string& message) {
    if (warn) warn(message);
  };
  const absl::StatusOr<LogExamination> log = ExamineLog(store, mark->Read());
  if (!log.ok()) return log.status();
  if (log->damage.empty()) {
    if (log->has_unfinished_tail) {
      tell("the log " + LogOf(store) +
           " ends in an unfinished write, which was not acknowledged; it is "
           "left out");
    }
    return absl::OkStatus();
  }
  const std::string message = DamageText(store, *log);
  if (drop_damaged_log) {
    tell(message + "; dropped as told");
    return mark->Clear();
  }
  return Corrupt(message, {{"vehicles", LostIn(*log)}});
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

absl::StatusOr<std::unique_ptr<SqliteDatabase>> OpenAnchor(
    const std::string& store, const std::string& vfs) {
  absl::StatusOr<std::unique_ptr<SqliteDatabase>> anchor =
      SqliteDatabase::Open(store, SqliteDatabase::Mode::kReadOnly, vfs);
  if (!anchor.ok()) return anchor;
  const absl::Status readable = CheckReadable(**anchor, store);
  if (!readable.ok()) return readable;
  return anchor;
}

absl::Status CheckFile(SqliteDatabase& database, const std::string& store,
                       std::int64_t max_checked_bytes) {
  std::error_code error;
  const std::uintmax_t bytes = std::filesystem::file_size(store, error);
  if (error || bytes > static_cast<std::uintmax_t>(max_checked_bytes)) {
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

absl::StatusOr<std::unique_ptr<SqliteDatabase>> OpenDatabaseToRead(
    const std::string& path) {
  absl::StatusOr<std::unique_ptr<SqliteDatabase>> database =
      OpenAnchor(path, "");
  if (!database.ok()) return database;
  const absl::StatusOr<FileFormat> format = ReadFormat(**database);
  if (!format.ok()) return format.status();
  const absl::Status known = CheckKnownFormat(path, *format);
  if (!known.ok()) return known;
  if (format->version != kStoreFormat) {
    return absl::FailedPreconditionError(
        "the store " + path + " has format " + std::to_string(format->version) +
        ": a server that is started on it brings it to format " +
        std::to_string(kStoreFormat));
  }
  const absl::Status schema = CheckSchema(**database, path);
  if (!schema.ok()) return schema;
  return database;
}

}  // namespace revisit::server
