#include "server/storage/sqlite/sqlite_database.h"

#include <cstring>

#include "server/base/status.h"
#include "server/storage/free_space.h"
#include "server/storage/record_check.h"
#include "sqlite3.h"

namespace revisit::server {
namespace {

// Another process (an operator's shell) may hold the database for a moment.
constexpr int kBusyTimeoutMilliseconds = 5000;

// The log is copied into the database after a commit that leaves it longer than
// this, as SQLite does by itself.
constexpr int kFramesBeforeCopy = 1000;

// Pages that one step of a copy takes: 8 MiB.
constexpr int kPagesPerStep = 1024;

// The URI that tells SQLite how to open the file.
std::string UriOf(const std::string& path) {
  std::string uri = "file:";
  for (const char c : path) {
    if (c == '%') {
      uri += "%25";
    } else if (c == '?') {
      uri += "%3f";
    } else if (c == '#') {
      uri += "%23";
    } else {
      uri += c;
    }
  }
  return uri + "?immutable=1";
}

absl::Status ToStatus(sqlite3* database, int code, const char* doing) {
  std::string message = "store: ";
  message += sqlite3_errstr(code);
  const char* detail = database == nullptr ? nullptr : sqlite3_errmsg(database);
  if (detail != nullptr && std::strcmp(detail, sqlite3_errstr(code)) != 0) {
    message += " (" + Printable(detail) + ")";
  }
  message += std::string(", in: ") + doing;
  switch (code) {
    case SQLITE_IOERR_FSYNC:
    case SQLITE_IOERR_DIR_FSYNC:
      return Error(absl::StatusCode::kUnavailable, "STORE_SYNC_FAILED",
                   message);
    // The index of the log, in shared memory, takes room too.
    case SQLITE_IOERR_SHMSIZE:
      return StorageFull(message);
    default:
      break;
  }
  switch (code & 0xff) {
    case SQLITE_FULL:
      return StorageFull(message);
    case SQLITE_CORRUPT:
    case SQLITE_NOTADB:
      return Error(absl::StatusCode::kDataLoss, "STORE_CORRUPT", message);
    // Defects of this program.
    case SQLITE_ERROR:
    case SQLITE_MISUSE:
    case SQLITE_RANGE:
    case SQLITE_CONSTRAINT:
    case SQLITE_MISMATCH:
      return Error(absl::StatusCode::kInternal, "INTERNAL", message);
    default:
      return Error(absl::StatusCode::kUnavailable, "STORE_UNAVAILABLE",
                   message);
  }
}

}  // namespace

SqliteStatement::SqliteStatement(sqlite3* database, sqlite3_stmt* statement,
                                 int prepare_code, const char* sql)
    : database_(database),
      statement_(statement),
      code_(prepare_code),
      sql_(sql) {}

SqliteStatement::~SqliteStatement() {
  if (statement_ == nullptr) return;
  sqlite3_reset(statement_);
  sqlite3_clear_bindings(statement_);
}

SqliteStatement& SqliteStatement::Bind(int parameter, std::int64_t value) {
  if (code_ == SQLITE_OK) {
    code_ = sqlite3_bind_int64(statement_, parameter, value);
  }
  return *this;
}

SqliteStatement& SqliteStatement::BindText(int parameter,
                                           const std::string& text) {
  if (code_ == SQLITE_OK) {
    code_ = sqlite3_bind_text64(statement_, parameter, text.data(), text.size(),
                                SQLITE_STATIC, SQLITE_UTF8);
  }
  return *this;
}

SqliteStatement& SqliteStatement::BindBlob(int parameter,
                                           const std::string& bytes) {
  if (code_ == SQLITE_OK) {
    code_ = sqlite3_bind_blob64(statement_, parameter, bytes.data(),
                                bytes.size(), SQLITE_STATIC);
  }
  return *this;
}

absl::StatusOr<bool> SqliteStatement::Step() {
  if (code_ != SQLITE_OK) return ToStatus(database_, code_, sql_);
  const int code = sqlite3_step(statement_);
  if (code == SQLITE_ROW) return true;
  if (code == SQLITE_DONE) return false;
  return ToStatus(database_, code, sql_);
}

absl::Status SqliteStatement::Run() {
  while (true) {
    const absl::StatusOr<bool> row = Step();
    if (!row.ok()) return row.status();
    if (!*row) return absl::OkStatus();
  }
}

std::int64_t SqliteStatement::Integer(int column) const {
  return sqlite3_column_int64(statement_, column);
}

bool SqliteStatement::IsNull(int column) const {
  return sqlite3_column_type(statement_, column) == SQLITE_NULL;
}

absl::string_view SqliteStatement::View(int column) const {
  // The pointer is taken first: that may convert the value and change its size.
  const void* data = sqlite3_column_blob(statement_, column);
  const int size = sqlite3_column_bytes(statement_, column);
  if (data == nullptr || size <= 0) return "";
  return {static_cast<const char*>(data), static_cast<std::size_t>(size)};
}

absl::StatusOr<std::unique_ptr<SqliteDatabase>> SqliteDatabase::Open(
    const std::string& path, Mode mode, const std::string& vfs) {
  // SQLite needs no mutex: a connection is used by one thread at a time.
  const int flags = (mode == Mode::kReadWrite ? SQLITE_OPEN_READWRITE
                                              : SQLITE_OPEN_READONLY) |
                    (mode == Mode::kFileOnly ? SQLITE_OPEN_URI : 0) |
                    SQLITE_OPEN_NOMUTEX | SQLITE_OPEN_EXRESCODE;
  sqlite3* database = nullptr;
  const int code =
      sqlite3_open_v2((mode == Mode::kFileOnly ? UriOf(path) : path).c_str(),
                      &database, flags, vfs.empty() ? nullptr : vfs.c_str());
  if (code != SQLITE_OK) {
    const absl::Status status =
        ToStatus(database, code, ("open " + path).c_str());
    sqlite3_close(database);
    return status;
  }
  sqlite3_busy_timeout(database, kBusyTimeoutMilliseconds);
  auto opened = std::unique_ptr<SqliteDatabase>(new SqliteDatabase(database));
  if (mode == Mode::kReadWrite) {
    // Replaces SQLite's own hook, which does not report failures.
    sqlite3_wal_hook(database, OnCommit, opened.get());
  }
  return opened;
}

int SqliteDatabase::OnCommit(void* self, sqlite3* /*database*/,
                             const char* /*name*/, int frames) {
  auto* const connection = static_cast<SqliteDatabase*>(self);
  connection->copy_failure_ = absl::OkStatus();
  // A reader may keep the log from being copied whole; then a later commit
  // tries again.
  if (frames >= kFramesBeforeCopy) {
    connection->copy_failure_ = connection->CopyLog().status();
  }
  return SQLITE_OK;
}

SqliteDatabase::~SqliteDatabase() {
  for (const auto& [sql, statement] : statements_) sqlite3_finalize(statement);
  sqlite3_close(database_);
}

SqliteStatement SqliteDatabase::Prepare(const char* sql) {
  const auto found = statements_.find(sql);
  if (found != statements_.end()) {
    return SqliteStatement(database_, found->second, SQLITE_OK, sql);
  }
  sqlite3_stmt* statement = nullptr;
  const int code = sqlite3_prepare_v3(
      database_, sql, -1, SQLITE_PREPARE_PERSISTENT, &statement, nullptr);
  if (code == SQLITE_OK) statements_.emplace(sql, statement);
  return SqliteStatement(database_, statement, code, sql);
}

absl::Status SqliteDatabase::Execute(const char* sql) {
  const int code = sqlite3_exec(database_, sql, nullptr, nullptr, nullptr);
  if (code != SQLITE_OK) return ToStatus(database_, code, sql);
  return absl::OkStatus();
}

absl::StatusOr<std::int64_t> SqliteDatabase::QueryInteger(const char* sql) {
  SqliteStatement statement = Prepare(sql);
  const absl::StatusOr<bool> row = statement.Step();
  if (!row.ok()) return row.status();
  if (!*row) return ToStatus(database_, SQLITE_ERROR, sql);
  return statement.Integer(0);
}

bool SqliteDatabase::InTransaction() const {
  return sqlite3_get_autocommit(database_) == 0;
}

std::int64_t SqliteDatabase::LastInsertedKey() const {
  return sqlite3_last_insert_rowid(database_);
}

int SqliteDatabase::Changes() const { return sqlite3_changes(database_); }

void SqliteDatabase::KeepLogOnClose(bool keep) {
  sqlite3_db_config(database_, SQLITE_DBCONFIG_NO_CKPT_ON_CLOSE, keep ? 1 : 0,
                    nullptr);
}

absl::StatusOr<bool> SqliteDatabase::CopyLog() {
  int frames = 0;
  int copied = 0;
  const int code = sqlite3_wal_checkpoint_v2(
      database_, "main", SQLITE_CHECKPOINT_PASSIVE, &frames, &copied);
  if ((code & 0xff) == SQLITE_BUSY) return false;
  if (code != SQLITE_OK) {
    return ToStatus(database_, code, "copying the log into the database");
  }
  return copied == frames;
}

absl::Status SqliteDatabase::EmptyLog() {
  sqlite3_busy_timeout(database_, 0);
  const int code = sqlite3_wal_checkpoint_v2(
      database_, "main", SQLITE_CHECKPOINT_TRUNCATE, nullptr, nullptr);
  sqlite3_busy_timeout(database_, kBusyTimeoutMilliseconds);
  if (code == SQLITE_OK || (code & 0xff) == SQLITE_BUSY) {
    return absl::OkStatus();
  }
  return ToStatus(database_, code, "emptying the log");
}

absl::Status SqliteDatabase::CopyTo(
    SqliteDatabase* destination, const std::function<absl::Status()>& go_on) {
  constexpr char kDoing[] = "copying the database";
  // The transaction fixes one moment: without it, the steps would begin again
  // whenever the store has changed, possibly for ever.
  absl::Status status = Execute("BEGIN; SELECT 1 FROM sqlite_schema");
  if (!status.ok()) return status;
  sqlite3_backup* const copy =
      sqlite3_backup_init(destination->database_, "main", database_, "main");
  if (copy == nullptr) {
    return ToStatus(destination->database_,
                    sqlite3_extended_errcode(destination->database_), kDoing);
  }
  int code = SQLITE_OK;
  while (code == SQLITE_OK && status.ok()) {
    status = go_on();
    if (status.ok()) code = sqlite3_backup_step(copy, kPagesPerStep);
  }
  const int finished = sqlite3_backup_finish(copy);
  const absl::Status ended = Execute("COMMIT");
  if (code != SQLITE_DONE && code != SQLITE_OK) {
    return ToStatus(nullptr, code, kDoing);
  }
  if (!status.ok()) return status;
  if (finished != SQLITE_OK) return ToStatus(nullptr, finished, kDoing);
  return ended;
}

bool IsCorruption(const absl::Status& status) {
  return status.code() == absl::StatusCode::kDataLoss;
}

bool IsFailedFlush(const absl::Status& status) {
  return !status.ok() && ReasonOf(status) == "STORE_SYNC_FAILED";
}

bool IsStorageFull(const absl::Status& status) {
  return status.code() == absl::StatusCode::kResourceExhausted;
}

}  // namespace revisit::server
