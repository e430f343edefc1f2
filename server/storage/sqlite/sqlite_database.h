// A connection to SQLite and its statements, with errors as absl::Status.
//
// A connection and its statements belong to one thread at a time.
#ifndef REVISIT_SERVER_STORAGE_SQLITE_SQLITE_DATABASE_H_
#define REVISIT_SERVER_STORAGE_SQLITE_SQLITE_DATABASE_H_

#include <cstdint>
#include <functional>
#include <memory>
#include <string>
#include <unordered_map>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "absl/strings/string_view.h"

struct sqlite3;
struct sqlite3_stmt;

namespace revisit::server {

// A prepared statement in use. Its destructor gives it back to the connection.
// Parameters are numbered from 1 and columns from 0, as in SQLite. Bound values
// must stay unchanged as long as this lives.
class SqliteStatement {
 public:
  SqliteStatement(sqlite3* database, sqlite3_stmt* statement, int prepare_code,
                  const char* sql);
  ~SqliteStatement();

  SqliteStatement(const SqliteStatement&) = delete;
  SqliteStatement& operator=(const SqliteStatement&) = delete;

  SqliteStatement& Bind(int parameter, std::int64_t value);
  SqliteStatement& BindText(int parameter, const std::string& text);
  SqliteStatement& BindBlob(int parameter, const std::string& bytes);

  // Moves to the next row; false if there is none.
  absl::StatusOr<bool> Step();
  // Runs a statement without rows, or whose rows do not matter.
  absl::Status Run();

  std::int64_t Integer(int column) const;
  bool IsNull(int column) const;
  // The bytes of a text or a blob; View() until the next step.
  std::string Bytes(int column) const { return std::string(View(column)); }
  absl::string_view View(int column) const;

 private:
  sqlite3* database_;
  sqlite3_stmt* statement_;
  int code_;
  const char* sql_;
};

class SqliteDatabase {
 public:
  // kFileOnly reads the database as if it had no log, and makes, writes or
  // locks no file. REQUIRES for that: there is no log, and nobody writes.
  enum class Mode { kReadWrite, kReadOnly, kFileOnly };

  // Opens a file that exists. `vfs` is the name of SQLite's layer to the
  // operating system; empty for the usual one.
  static absl::StatusOr<std::unique_ptr<SqliteDatabase>> Open(
      const std::string& path, Mode mode, const std::string& vfs);
  ~SqliteDatabase();

  SqliteDatabase(const SqliteDatabase&) = delete;
  SqliteDatabase& operator=(const SqliteDatabase&) = delete;

  // `sql` must outlive the connection, as a literal does: statements are cached
  // by its address. Each can be in use only once at a time. A failure shows at
  // the first step.
  SqliteStatement Prepare(const char* sql);
  // Runs statements once, separated by semicolons.
  absl::Status Execute(const char* sql);
  // Runs a query that answers a single number.
  absl::StatusOr<std::int64_t> QueryInteger(const char* sql);

  bool InTransaction() const;
  std::int64_t LastInsertedKey() const;
  // Number of rows changed by the last statement.
  int Changes() const;

  // Why the log could not be copied into the database after the last commit of
  // this connection. The commit itself is flushed.
  const absl::Status& copy_failure() const { return copy_failure_; }

  // Sets whether closing the last connection leaves the log as it is, rather
  // than copying and removing it.
  void KeepLogOnClose(bool keep);

  // Copies the log into the database, as far as readers that began earlier
  // allow, and flushes both; returns whether all of it was copied. Waits for
  // nobody. REQUIRES: something was read, because SQLite opens the log only
  // then.
  absl::StatusOr<bool> CopyLog();
  // Empties a log that was copied whole, unless somebody reads.
  absl::Status EmptyLog();

  // Copies everything committed into another database, as of one moment.
  // `go_on` is called between pieces of a few megabytes; if it fails, the
  // copying ends with its status.
  absl::Status CopyTo(SqliteDatabase* destination,
                      const std::function<absl::Status()>& go_on);

 private:
  explicit SqliteDatabase(sqlite3* database) : database_(database) {}

  // Called by SQLite after each commit.
  static int OnCommit(void* self, sqlite3* database, const char* name,
                      int frames);

  sqlite3* const database_;
  absl::Status copy_failure_;
  std::unordered_map<const char*, sqlite3_stmt*> statements_;
};

// Whether a status comes from a damaged file, rather than from one that cannot
// be read or written now.
bool IsCorruption(const absl::Status& status);

// Whether a status comes from a failed flush: earlier writes may or may not be
// on the device, and flushing again does not show which.
bool IsFailedFlush(const absl::Status& status);

// Whether a status comes from a file system without room.
bool IsStorageFull(const absl::Status& status);

}  // namespace revisit::server

#endif  // REVISIT_SERVER_STORAGE_SQLITE_SQLITE_DATABASE_H_
