#include "tests/bench/sqlite_loop.h"

#include <chrono>
#include <cstdint>

#include "revisit/v1/pose_graph_service.pb.h"
#include "sqlite3.h"
#include "tests/bench/child_process.h"
#include "tests/bench/stream_load.h"

namespace revisit::bench {
namespace {

// A vehicle that the store has none of.
constexpr std::int64_t kKey = 1'000'000;

class Connection {
 public:
  explicit Connection(const std::string& path) {
    Check(sqlite3_open_v2(path.c_str(), &database_,
                          SQLITE_OPEN_READWRITE | SQLITE_OPEN_NOMUTEX,
                          nullptr));
    // As the server's own connection.
    Check(sqlite3_exec(database_,
                       "PRAGMA journal_mode = WAL; PRAGMA synchronous = FULL;"
                       "PRAGMA temp_store = MEMORY;"
                       "PRAGMA journal_size_limit = 67108864",
                       nullptr, nullptr, nullptr));
    begin_ = Prepare("BEGIN IMMEDIATE");
    commit_ = Prepare("COMMIT");
    insert_ = Prepare(
        "INSERT INTO batches (vehicle_key, first_sequence, count, format, "
        "revision, checksum, payload) VALUES (?1, ?2, ?3, ?4, ?5, ?6, ?7)");
  }
  ~Connection() {
    for (sqlite3_stmt* statement : {begin_, commit_, insert_}) {
      sqlite3_finalize(statement);
    }
    sqlite3_close(database_);
  }

  Connection(const Connection&) = delete;
  Connection& operator=(const Connection&) = delete;

  void Begin() { Run(begin_); }
  void Commit() { Run(commit_); }

  void Insert(std::int64_t first_sequence, std::int64_t count,
              std::int64_t revision, const std::string& payload) {
    sqlite3_bind_int64(insert_, 1, kKey);
    sqlite3_bind_int64(insert_, 2, first_sequence);
    sqlite3_bind_int64(insert_, 3, count);
    sqlite3_bind_int64(insert_, 4, 1);
    sqlite3_bind_int64(insert_, 5, revision);
    // Any number of that size.
    sqlite3_bind_int64(insert_, 6, 0x0123456789abcdef - revision);
    sqlite3_bind_blob64(insert_, 7, payload.data(), payload.size(),
                        SQLITE_STATIC);
    Run(insert_);
  }

 private:
  void Check(int code) {
    if (code != SQLITE_OK && code != SQLITE_DONE) {
      Die(std::string("SQLite: ") + sqlite3_errmsg(database_));
    }
  }

  sqlite3_stmt* Prepare(const char* sql) {
    sqlite3_stmt* statement = nullptr;
    Check(sqlite3_prepare_v3(database_, sql, -1, SQLITE_PREPARE_PERSISTENT,
                             &statement, nullptr));
    return statement;
  }

  void Run(sqlite3_stmt* statement) {
    Check(sqlite3_step(statement));
    Check(sqlite3_reset(statement));
  }

  sqlite3* database_ = nullptr;
  sqlite3_stmt* begin_ = nullptr;
  sqlite3_stmt* commit_ = nullptr;
  sqlite3_stmt* insert_ = nullptr;
};

}  // namespace

double SqliteLoop(const std::string& store, int batch_poses, int rows_a_commit,
                  double seconds) {
  v1::PoseBatch batch;
  for (int i = 0; i < batch_poses; ++i) {
    SetPose(static_cast<std::uint64_t>(i) + 100'000, batch.add_poses());
  }
  const std::string payload = batch.SerializeAsString();
  Connection connection(store);
  using Clock = std::chrono::steady_clock;
  const Clock::time_point start = Clock::now();
  std::chrono::duration<double> spent{0};
  std::int64_t rows = 0;
  while (spent.count() < seconds) {
    connection.Begin();
    for (int i = 0; i < rows_a_commit; ++i, ++rows) {
      connection.Insert(1 + rows * batch_poses, batch_poses, rows + 2, payload);
    }
    connection.Commit();
    spent = Clock::now() - start;
  }
  return static_cast<double>(rows * batch_poses) / spent.count();
}

}  // namespace revisit::bench
