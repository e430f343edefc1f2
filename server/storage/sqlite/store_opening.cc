#include "server/storage/sqlite/store_opening.h"

#include <fcntl.h>
#include <sys/file.h>
#include <unistd.h>

#include <algorithm>
#include <cerrno>
#include <cstdint>
#include <cstdio>
#include <filesystem>
#include <fstream>
#include <map>
#include <optional>
#include <set>
#include <system_error>
#include <utility>
#include <vector>

#include "server/base/status.h"
#include "server/storage/record_check.h"
#include "server/storage/sqlite/store_check.h"
#include "server/storage/sqlite/store_files.h"
#include "server/storage/sqlite/store_lock.h"
#include "server/storage/sqlite/vehicle_rows.h"
#include "server/storage/sqlite/write_ahead_log.h"

namespace revisit::server {
namespace {

using absl::StatusCode;

// "RVST", which marks an SQLite file as a store.
constexpr std::int64_t kApplicationId = 0x52565354;

// Page size of a new store. A batch of 64 poses has some 12 kB: with such
// batches the store takes in a quarter more than with SQLite's own 4096, and
// with 16384 the file grows by a third.
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

// Tables that format 2 has beyond format 1.
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

// The table that format 3 has beyond format 2, with one row (store_state.h).
constexpr char kSchemaSince3[] = R"sql(
CREATE TABLE store (
  key INTEGER PRIMARY KEY,
  state BLOB NOT NULL
);
)sql";

// The columns that format 4 has beyond format 3. Rows that were there before
// stay as they are, and read as if they had the default.
constexpr char kSchemaSince4[] = R"sql(
ALTER TABLE loop_closures ADD COLUMN payload BLOB NOT NULL DEFAULT x'';
ALTER TABLE rejected_candidates ADD COLUMN payload BLOB NOT NULL DEFAULT x'';
)sql";

// The tables that format 5 has beyond format 4.
constexpr char kSchemaSince5[] = R"sql(
CREATE TABLE snapshots (
  key INTEGER PRIMARY KEY AUTOINCREMENT,
  vehicle_key INTEGER NOT NULL UNIQUE,
  format INTEGER NOT NULL,
  last_sequence INTEGER NOT NULL,
  part_count INTEGER NOT NULL,
  checksum INTEGER NOT NULL,
  payload BLOB NOT NULL
);
CREATE TABLE snapshot_parts (
  snapshot_key INTEGER NOT NULL,
  number INTEGER NOT NULL,
  format INTEGER NOT NULL,
  checksum INTEGER NOT NULL,
  payload BLOB NOT NULL,
  PRIMARY KEY (snapshot_key, number)
);
CREATE TABLE deleted_snapshots (
  key INTEGER PRIMARY KEY
);
)sql";

// Lets pages of deleted rows be given back to the file system. Works only for a
// file without tables.
constexpr char kVacuum[] = "PRAGMA auto_vacuum = INCREMENTAL";

// The program and the format that the head of an SQLite file names; both are 0
// in a new file.
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

// Brings a store to this format.
absl::Status CheckFormat(SqliteDatabase& database, const std::string& path,
                         std::uint64_t run) {
  const absl::StatusOr<FileFormat> format = ReadFormat(database);
  if (!format.ok()) return format.status();
  const absl::Status known = CheckKnownFormat(path, *format);
  if (!known.ok()) return known;
  if (format->version == kStoreFormat) return absl::OkStatus();
  // Nothing is changed before the commit: a failure closes the connection,
  // which rolls back.
  std::string sql = "BEGIN IMMEDIATE;";
  if (format->version < 2) sql += kSchemaSince2;
  if (format->version < 3) sql += kSchemaSince3;
  if (format->version < 4) sql += kSchemaSince4;
  sql += kSchemaSince5;
  sql += "PRAGMA user_version = " + std::to_string(kStoreFormat);
  absl::Status status = database.Execute(sql.c_str());
  if (!status.ok()) return status;
  StoreState state = FirstState(run);
  if (format->version >= 3) {
    const absl::StatusOr<StoreState> stored = ReadState(database);
    if (!stored.ok()) return stored.status();
    state = NextState(*stored, run, /*is_closed=*/false);
  }
  state.is_closed = false;
  status = WriteState(database, state);
  if (!status.ok()) return status;
  return database.Execute("COMMIT");
}

// Compares the stored statements that made the tables with ours: SQLite goes by
// the names of tables alone, and damage to a statement would later look like a
// defect of the server.
absl::Status CheckSchema(SqliteDatabase& database, const std::string& path) {
  const absl::StatusOr<std::unique_ptr<SqliteDatabase>> expected =
      SqliteDatabase::Open(":memory:", SqliteDatabase::Mode::kReadWrite, "");
  if (!expected.ok()) return expected.status();
  const absl::Status made =
      (*expected)->Execute((std::string(kSchema) + kSchemaSince2 +
                            kSchemaSince3 + kSchemaSince4 + kSchemaSince5)
                               .c_str());
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

// Checks that the database can be read at all.
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

// The content of a database without its log.
struct FileContent {
  // Whether it could be read as a store; if not, nothing is known.
  bool is_readable = false;
  // Absent in formats 1 and 2.
  std::optional<StoreState> state;
};

FileContent ReadFileAlone(const std::string& store) {
  FileContent content;
  const absl::StatusOr<std::unique_ptr<SqliteDatabase>> database =
      SqliteDatabase::Open(store, SqliteDatabase::Mode::kFileOnly, "");
  if (!database.ok()) return content;
  const absl::StatusOr<FileFormat> format = ReadFormat(**database);
  if (!format.ok() || !CheckKnownFormat(store, *format).ok()) return content;
  content.is_readable = format->version < 3;
  if (content.is_readable) return content;
  const absl::StatusOr<StoreState> state = ReadState(**database);
  content.is_readable = state.ok();
  if (state.ok()) content.state = *state;
  return content;
}

// Makes other servers wait that make a store in the same directory. On a file
// system without such locks nobody waits.
class DirectoryLock {
 public:
  explicit DirectoryLock(const std::string& directory)
      : file_(open(directory.empty() ? "." : directory.c_str(),
                   O_RDONLY | O_DIRECTORY | O_CLOEXEC)) {
    if (file_ >= 0) static_cast<void>(flock(file_, LOCK_EX));
  }
  ~DirectoryLock() {
    if (file_ >= 0) close(file_);
  }

  DirectoryLock(const DirectoryLock&) = delete;
  DirectoryLock& operator=(const DirectoryLock&) = delete;

 private:
  const int file_;
};

// Compares the states that the files of a store hold.
class Comparison {
 public:
  Comparison(std::string store, const LogReport& log)
      : store_(std::move(store)),
        log_(log),
        file_(ReadFileAlone(store_)),
        mark_(DurableMark::Read(store_)),
        lock_(StoreLock::Read(store_)) {}

  // Looks for damage that cannot be dropped first.
  StoreExamination Compare() const {
    StoreExamination result;
    result.damage = FindStranger();
    if (result.damage.empty()) result.damage = FindGap();
    if (!result.damage.empty()) return result;
    result.can_be_dropped = true;
    result.damage = FindMissing();
    return result;
  }

 private:
  bool log_is_used() const { return log_.end.frames > 0; }
  // The last commit that SQLite will see.
  std::optional<StoreState> end() const {
    return log_.states.empty() ? file_.state : log_.states.back();
  }

  std::string FindStranger() const {
    struct Known {
      std::string file;
      std::optional<StoreState> state;
    };
    const std::vector<Known> all = {
        {store_, file_.state},
        {LogOf(store_), log_.states.empty()
                            ? std::nullopt
                            : std::optional(log_.states.front())},
        {store_ + ".mark", mark_.state},
        {store_ + ".lock", lock_}};
    const Known* first = nullptr;
    for (const Known& known : all) {
      if (!known.state) continue;
      if (first == nullptr) first = &known;
      if (known.state->id != first->state->id) {
        return known.file + " is of another store than " + first->file + ": " +
               ToText(*known.state) + " and " + ToText(*first->state);
      }
    }
    return "";
  }

  // Whether the log, if there is one, goes on from the database's last commit.
  std::string FindGap() const {
    if (!file_.is_readable || !log_is_used()) return "";
    if (log_.states.empty()) {
      if (!file_.state) return "";
      return "the log " + LogOf(store_) +
             " is of another store, or older than the database";
    }
    const StoreState& first = log_.states.front();
    const StoreState& last = log_.states.back();
    const std::uint64_t reached = file_.state ? file_.state->commit : 0;
    const std::string but = ": the database holds commits up to " +
                            std::to_string(reached) + ", the log " +
                            std::to_string(first.commit) + " to " +
                            std::to_string(last.commit);
    if (reached + 1 < first.commit) {
      return "the database " + store_ + " is older than its log" + but;
    }
    if (reached > last.commit) {
      return "the log " + LogOf(store_) + " is older than the database" + but;
    }
    const bool fits =
        reached + 1 == first.commit
            ? first.previous_run == (file_.state ? file_.state->run : 0)
            : std::any_of(log_.states.begin(), log_.states.end(),
                          [&](const StoreState& state) {
                            return IsSameCommit(state, *file_.state);
                          });
    if (fits) return "";
    return "the log " + LogOf(store_) +
           " is of a copy of the store that went its own way" + but;
  }

  // Whether the files hold everything that was flushed.
  std::string FindMissing() const {
    if (mark_.position) {
      const std::string missing = MissingFrom(log_, *mark_.position);
      if (!missing.empty()) {
        return "the log " + LogOf(store_) + " is damaged: " + missing;
      }
    }
    if (!file_.is_readable && log_.states.empty()) return "";
    const std::uint64_t reached = end() ? end()->commit : 0;
    for (const std::optional<StoreState>& known : {mark_.state, lock_}) {
      if (!known) continue;
      if (known->commit > reached) {
        return "the log " + LogOf(store_) +
               (log_is_used() ? " is damaged: it ends with commit "
                              : " is missing, or the database is older: that "
                                "ends with commit ") +
               std::to_string(reached) + ", but commit " +
               std::to_string(known->commit) + " was flushed";
      }
      if (known->commit == reached && known->run != end()->run) {
        return "the log " + LogOf(store_) +
               " is of a copy of the store that went its own way from commit " +
               std::to_string(reached) + " on";
      }
    }
    // A database in use has a log, except for a moment in which the mark says
    // that none is needed.
    if (!log_.has_header && file_.state && !file_.state->is_closed &&
        !(mark_.state && IsSameCommit(*mark_.state, *file_.state))) {
      return "the log " + LogOf(store_) +
             " is missing or empty, but the database was in use";
    }
    return "";
  }

  const std::string store_;
  const LogReport& log_;
  const FileContent file_;
  const Mark mark_;
  const std::optional<StoreState> lock_;
};

// Vehicles with rows that are only in the unreadable part of the log.
absl::StatusOr<std::set<std::string>> VehiclesBehind(const std::string& store,
                                                     const LogReport& log) {
  absl::StatusOr<std::unique_ptr<SqliteDatabase>> database =
      SqliteDatabase::Open(store, ReadingMode(log.end.frames == 0), "");
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
          // A vehicle that was created there is named by its own row.
          if (id.ok()) names.insert(*id);
        }
      });
  if (!visited.ok()) return visited;
  if (!failure.ok() && names.empty()) return failure;
  return names;
}

std::string LostIn(const StoreExamination& examination) {
  return examination.vehicles.empty() ? "cannot be told"
                                      : Listed(examination.vehicles);
}

}  // namespace

absl::Status CheckDatabaseIsThere(const std::string& store) {
  std::error_code error;
  const std::uintmax_t bytes = std::filesystem::file_size(store, error);
  if (!error && bytes > 0) return absl::OkStatus();
  const bool is_there = std::filesystem::exists(store, error);
  const std::vector<std::string> others = FilesBeside(store);
  if (!is_there && others.empty()) {
    return absl::NotFoundError(("there is no store at " + store).c_str());
  }
  std::string beside;
  for (const std::string& file : others) {
    beside += (beside.empty() ? ", beside " : " and ") + file;
  }
  return Corrupt("the database " + store + " is " +
                     (is_there ? "empty" : "missing") + beside +
                     ": put it back, or restore a backup into a new directory",
                 {});
}

absl::StatusOr<StoreExamination> ExamineStore(const std::string& store) {
  const absl::Status is_there = CheckDatabaseIsThere(store);
  if (!is_there.ok()) return is_there;
  const absl::StatusOr<LogReport> log = ReadLog(LogOf(store));
  if (!log.ok()) return log.status();
  StoreExamination examination = Comparison(store, *log).Compare();
  examination.has_unfinished_tail = log->has_unfinished_tail;
  examination.has_no_log = log->end.frames == 0;
  if (!log->damage.empty() &&
      (examination.damage.empty() || examination.can_be_dropped)) {
    examination.damage =
        "the log " + LogOf(store) + " is damaged: " + log->damage;
    examination.can_be_dropped = true;
  }
  if (examination.damage.empty() || !examination.can_be_dropped) {
    return examination;
  }
  absl::StatusOr<std::set<std::string>> vehicles = VehiclesBehind(store, *log);
  if (vehicles.ok()) examination.vehicles = *std::move(vehicles);
  return examination;
}

absl::Status DamageOf(const StoreExamination& examination) {
  return Corrupt(examination.damage +
                     "; vehicles with lost changes: " + LostIn(examination),
                 {{"vehicles", LostIn(examination)}});
}

absl::Status CheckStoreFiles(
    const std::string& store, bool drop_damaged_log,
    const std::function<void(const std::string&)>& warn, DurableMark* mark) {
  const auto tell = [&](const std::string& message) {
    if (warn) warn(message);
  };
  const absl::StatusOr<StoreExamination> found = ExamineStore(store);
  if (!found.ok()) return found.status();
  if (found->damage.empty()) {
    if (found->has_unfinished_tail) {
      tell("the log " + LogOf(store) +
           " ends in an unfinished write, which was not acknowledged; it is "
           "left out");
    }
    return absl::OkStatus();
  }
  const absl::Status damage = DamageOf(*found);
  if (!drop_damaged_log || !found->can_be_dropped) return damage;
  tell(std::string(damage.message()) + "; dropped as told");
  return mark->Clear();
}

absl::Status MakeStore(const std::string& store, const std::string& vfs,
                       std::uint64_t run) {
  const std::string directory =
      std::filesystem::path(store).parent_path().string();
  const DirectoryLock lock(directory);
  std::error_code error;
  if (std::filesystem::exists(store, error)) return absl::OkStatus();
  // The file has another name until it is whole: a kill leaves no half a store.
  const std::string made = store + ".new";
  for (const char* suffix : {"", "-journal", "-wal", "-shm"}) {
    std::filesystem::remove(made + suffix, error);
  }
  absl::Status status = MakePrivateFile(made);
  if (!status.ok()) return status;
  {
    const absl::StatusOr<std::unique_ptr<SqliteDatabase>> database =
        SqliteDatabase::Open(made, SqliteDatabase::Mode::kReadWrite, vfs);
    if (!database.ok()) return database.status();
    status = (*database)->Execute(
        ("PRAGMA page_size = " + std::to_string(kPageBytes) + ";" + kVacuum +
         "; BEGIN IMMEDIATE;" + kSchema + kSchemaSince2 + kSchemaSince3 +
         kSchemaSince4 + kSchemaSince5 +
         "PRAGMA application_id = " + std::to_string(kApplicationId) +
         "; PRAGMA user_version = " + std::to_string(kStoreFormat))
            .c_str());
    if (status.ok()) status = WriteState(**database, FirstState(run));
    if (status.ok()) {
      status = (*database)->Execute("COMMIT; PRAGMA journal_mode = WAL");
    }
  }
  if (status.ok()) status = FlushFile(made);
  if (!status.ok()) return status;
  if (std::rename(made.c_str(), store.c_str()) != 0) {
    return Error(StatusCode::kUnavailable, "STORE_UNAVAILABLE",
                 "cannot name " + absl::ErrnoToStatus(errno, store).ToString());
  }
  return FlushFile(directory);
}

absl::StatusOr<OpenedWriter> OpenWriter(const std::string& path,
                                        const std::string& vfs,
                                        std::uint64_t run, DurableMark* mark,
                                        bool copies_log) {
  absl::StatusOr<std::unique_ptr<SqliteDatabase>> database =
      SqliteDatabase::Open(path, SqliteDatabase::Mode::kReadWrite, vfs);
  if (!database.ok()) return database.status();
  // Otherwise a failure below would remove a log that the mark names.
  (*database)->KeepLogOnClose(true);
  // Checked before anything is changed in a file that may not be a store.
  absl::Status status = CheckReadable(**database, path);
  if (!status.ok()) return status;
  status = CheckFormat(**database, path, run);
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
  const absl::StatusOr<StoreState> state = ReadState(**database);
  if (!state.ok()) return state.status();
  const absl::StatusOr<bool> copied =
      copies_log ? (*database)->CopyLog() : false;
  if (!copied.ok() && !IsStorageFull(copied.status())) return copied.status();
  OpenedWriter opened;
  opened.state = *state;
  opened.is_copied = copied.ok() && *copied;
  if (opened.is_copied) {
    // Everything is in the database, so the log may be emptied, which removes
    // what a failed transaction left in it.
    status = mark->Flush(*state);
    if (status.ok()) status = (*database)->EmptyLog();
    if (!status.ok() && !IsStorageFull(status)) return status;
  }
  opened.database = *std::move(database);
  return opened;
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
  // Read as served, because this process has it open; the files beside it were
  // examined before.
  const absl::StatusOr<StoreReport> report =
      CheckStore(store, StoreUse::kServed);
  const std::string names = report.ok() && !report->damaged_vehicles.empty()
                                ? Listed(report->damaged_vehicles)
                                : "cannot be told";
  return Corrupt("the store " + store + " is damaged: " + what +
                     "; vehicles that cannot be read whole: " + names,
                 {{"vehicles", names}});
}

absl::StatusOr<std::unique_ptr<SqliteDatabase>> OpenDatabaseToRead(
    const std::string& path, SqliteDatabase::Mode mode) {
  absl::StatusOr<std::unique_ptr<SqliteDatabase>> database =
      SqliteDatabase::Open(path, mode, "");
  if (!database.ok()) return database;
  const absl::Status readable = CheckReadable(**database, path);
  if (!readable.ok()) return readable;
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
