// A connection to SQLite and its statements, with errors as absl::Status.
//
// A connection and its statements belong to one thread at a time.
#ifndef REVISIT_SERVER_STORAGE_SQLITE_DATABASE_H_
#define REVISIT_SERVER_STORAGE_SQLITE_DATABASE_H_

#include <cstdint>
#include <functional>
#include <memory>
#include <string>
#include <unordered_map>

#include "absl/status/status.h"
#include "absl/status/statusor.h"

struct sqlite3;
struct sqlite3_stmt;

namespace revisit::server {

// A prepared statement in use; gives it back to its connection when it goes.
// Parameters and columns are numbered as SQLite does: from 1 and from 0. What
// is bound must stay as it is until the statement has gone.
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

  // Whether there is a row.
  absl::StatusOr<bool> Step();
  // For a statement that returns no rows, or whose rows are of no interest.
  absl::Status Run();

  std::int64_t Integer(int column) const;
  bool IsNull(int column) const;
  // Text or blob.
  std::string Bytes(int column) const;

 private:
  sqlite3* database_;
  sqlite3_stmt* statement_;
  int code_;
  const char* sql_;
};

class SqliteDatabase {
 public:
  // kFileOnly reads the database as if it had no log, which is right where it
  // has none and nobody writes: then no file is made, written or locked.
  enum class Mode { kReadWrite, kReadOnly, kFileOnly };

  // The file must be there. `vfs`: name of SQLite's layer to the operating
  // system; empty for the usual.
  static absl::StatusOr<std::unique_ptr<SqliteDatabase>> Open(
      const std::string& path, Mode mode, const std::string& vfs);
  ~SqliteDatabase();

  SqliteDatabase(const SqliteDatabase&) = delete;
  SqliteDatabase& operator=(const SqliteDatabase&) = delete;

  // `sql` must stay, such as a literal does: its address names the prepared
  // statement, which is kept. One can be in use only once at a time. A failure
  // shows at the first step.
  SqliteStatement Prepare(const char* sql);
  // Statements that are run once, separated by semicolons.
  absl::Status Execute(const char* sql);
  // The single number that a query answers.
  absl::StatusOr<std::int64_t> QueryInteger(const char* sql);

  bool InTransaction() const;
  std::int64_t LastInsertedKey() const;
  // Rows changed by the last statement.
  int Changes() const;

  // Of a connection that writes: why the log could not be copied into the
  // database after the last commit, which itself is flushed.
  const absl::Status& copy_failure() const { return copy_failure_; }

  // Whether closing, if this is the last connection, leaves the log as it is,
  // rather than copies and removes it.
  void KeepLogOnClose(bool keep);

  // Copies what the log holds into the database, as far as readers that began
  // before let it, and flushes both; answers whether that was all. Waits for
  // nobody. REQUIRES: something was read, for SQLite opens the log only then.
  absl::StatusOr<bool> CopyLog();
  // Empties a log that was copied whole, unless somebody reads.
  absl::Status EmptyLog();

  // Copies all that is committed into another database, as of one moment.
  // `go_on` is asked between pieces of a few megabytes; a failure of its ends
  // the copying.
  absl::Status CopyTo(SqliteDatabase* destination,
                      const std::function<absl::Status()>& go_on);

 private:
  explicit SqliteDatabase(sqlite3* database) : database_(database) {}

  // What SQLite calls after each commit.
  static int OnCommit(void* self, sqlite3* database, const char* name,
                      int frames);

  sqlite3* const database_;
  absl::Status copy_failure_;
  std::unordered_map<const char*, sqlite3_stmt*> statements_;
};

// Text out of a file that may be damaged, fit for a message: what is not
// printable ASCII becomes a question mark. Ids of ours are.
std::string Printable(std::string text);

// Whether a status comes from a damaged file, rather than from one that cannot
// be read or written now.
bool IsCorruption(const absl::Status& status);

// Whether it comes from a flush that failed: what was written before may or may
// not be on the device, and asking again does not tell.
bool IsFailedFlush(const absl::Status& status);

// Whether it comes from a file system without room.
bool IsStorageFull(const absl::Status& status);

}  // namespace revisit::server

#endif  // REVISIT_SERVER_STORAGE_SQLITE_DATABASE_H_
