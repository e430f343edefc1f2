// A connection to PostgreSQL: statements that are prepared once, with binary
// parameters and results, and for each failure whether it left a write in
// doubt.
//
// Errors are UNAVAILABLE (STORE_UNAVAILABLE), besides RESOURCE_EXHAUSTED
// (STORAGE_FULL) for a full disk, DATA_LOSS (STORE_CORRUPT) for damage that the
// database has found, and INTERNAL for defects of this program. The messages
// give no password away.
#ifndef REVISIT_SERVER_STORAGE_POSTGRES_CONNECTION_H_
#define REVISIT_SERVER_STORAGE_POSTGRES_CONNECTION_H_

#include <libpq-fe.h>

#include <array>
#include <atomic>
#include <cstdint>
#include <functional>
#include <memory>
#include <set>
#include <string>
#include <vector>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "absl/strings/string_view.h"
#include "server/storage/storage_facts.h"

namespace revisit::server {

using Uuid = std::array<char, 16>;
std::string ToText(const Uuid& uuid);

// Host, port, database and user of the URL, without what is secret.
std::string WithoutSecrets(const std::string& conninfo);

// SQL whose values are binary parameters. It is prepared under its name, which
// is unique in the program, when a connection runs it first.
struct Statement {
  const char* name;
  const char* sql;
};

// The values of $1, $2, ..., in their order. What a value is cast to in the SQL
// must be its type here.
class Parameters {
 public:
  Parameters& Add(std::int64_t value);                       // int8
  Parameters& AddText(const std::string& text);              // text, bytea
  Parameters& Add(const Uuid& uuid);                         // uuid
  Parameters& Add(const std::vector<std::int64_t>& values);  // int8[]
  Parameters& Add(const std::vector<Uuid>& values);          // uuid[]
  Parameters& AddBytes(
      const std::vector<const std::string*>& values);  // bytea[]
  Parameters& AddTexts(
      const std::vector<const std::string*>& values);  // text[]

 private:
  friend class PostgresConnection;
  std::vector<std::string> values_;
};

// The rows of an answer.
class PostgresRows {
 public:
  explicit PostgresRows(PGresult* result) : result_(result) {}

  int size() const { return PQntuples(result_.get()); }
  bool IsNull(int row, int column) const {
    return PQgetisnull(result_.get(), row, column) != 0;
  }
  // A number of any width; a boolean as 0 or 1; NULL as 0.
  std::int64_t Integer(int row, int column) const;
  // A text or bytea; empty if NULL.
  std::string Bytes(int row, int column) const {
    return std::string(View(row, column));
  }
  // As Bytes(), while these rows live.
  absl::string_view View(int row, int column) const;
  Uuid GetUuid(int row, int column) const;
  // Such as "COMMIT".
  std::string Tag() const { return PQcmdStatus(result_.get()); }

 private:
  struct Clear {
    void operator()(PGresult* result) const { PQclear(result); }
  };
  std::unique_ptr<PGresult, Clear> result_;
};

// For one thread at a time.
class PostgresConnection {
 public:
  struct Options {
    std::string conninfo;
    // Whether to plan for writes (see Open()), rather than for reads.
    bool writes = false;
    // If given and true, waiting for the database ends: for a thread that has
    // to stop although the database does not answer. It outlives the
    // connection.
    const std::atomic<bool>* give_up = nullptr;
  };

  // Connects to a database that takes writes. INVALID_ARGUMENT for a malformed
  // conninfo. Session settings: statements are planned once, for any values,
  // and by their indexes; a lock is awaited for two seconds; a transaction that
  // is left alone ends after five, so that a server that is stopped in it does
  // not hold a vehicle; and a commit returns after it was flushed, even where
  // the database says otherwise.
  static absl::StatusOr<std::unique_ptr<PostgresConnection>> Open(
      const Options& options);

  PostgresConnection(const PostgresConnection&) = delete;
  PostgresConnection& operator=(const PostgresConnection&) = delete;

  // Waits for the answer. A warning of the database makes an error of it: the
  // one that can come is that a commit was not replicated as it should be.
  absl::StatusOr<PostgresRows> Run(const Statement& statement,
                                   const Parameters& parameters = {});
  // Runs statements without parameters, separated by semicolons.
  absl::StatusOr<PostgresRows> RunText(const std::string& sql);

  // Whether the last statement, which failed, may have been committed all the
  // same.
  bool IsInDoubt() const { return in_doubt_; }
  // Whether it can be used, as far as can be told without asking the database.
  bool IsAlive();

  const Durability& durability() const { return durability_; }
  // Asks again: the settings of a database can change while it runs.
  absl::Status ReadDurability();

 private:
  PostgresConnection(PGconn* connection, const std::atomic<bool>* give_up);

  static void TakeNotice(void* self, const PGresult* notice);
  absl::StatusOr<PostgresRows> Answer(const char* doing);
  absl::Status Prepare(const Statement& statement);
  // Waits until the socket can be read, or written too.
  bool WaitForSocket(bool to_write);
  bool Flush();
  absl::Status Failure(const PGresult* result, const char* doing);

  struct Finish {
    void operator()(PGconn* connection) const { PQfinish(connection); }
  };
  const std::unique_ptr<PGconn, Finish> connection_;
  const std::atomic<bool>* const give_up_;
  std::set<std::string> prepared_;
  std::string warning_;
  std::string sqlstate_;
  bool in_doubt_ = false;
  Durability durability_;
};

// Does some work in a transaction, of which each statement sees what was
// committed before it. The transaction is committed if the work is OK, else
// rolled back; on a connection that is then in doubt, it ends with that.
absl::Status InTransaction(PostgresConnection& connection,
                           const std::function<absl::Status()>& work);

}  // namespace revisit::server

#endif  // REVISIT_SERVER_STORAGE_POSTGRES_CONNECTION_H_
