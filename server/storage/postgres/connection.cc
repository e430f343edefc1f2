#include "server/storage/postgres/connection.h"

#include <poll.h>

#include <cerrno>
#include <cstring>
#include <utility>

#include "server/base/status.h"
#include "server/storage/free_space.h"

namespace revisit::server {
namespace {

using absl::StatusCode;

// How often a wait looks whether it is to end.
constexpr int kPollMilliseconds = 200;

// Types of the elements of arrays, as in PostgreSQL's pg_type.dat.
constexpr std::int32_t kBytesType = 17;
constexpr std::int32_t kIntegerType = 20;
constexpr std::int32_t kTextType = 25;
constexpr std::int32_t kUuidType = 2950;

constexpr char kSessionOfAll[] =
    "SET jit = off; SET plan_cache_mode = force_generic_plan; "
    "SET enable_seqscan = off; SET enable_hashjoin = off; "
    "SET enable_mergejoin = off; SET lock_timeout = '2s'; "
    "SET default_transaction_isolation = 'read committed'; "
    "SET client_min_messages = warning; "
    "SELECT set_config('synchronous_commit', 'local', false) "
    "WHERE current_setting('synchronous_commit') = 'off'";
constexpr char kSessionOfWriters[] =
    "SET work_mem = '32MB'; SET statement_timeout = 0; "
    "SET idle_in_transaction_session_timeout = '5s'";

constexpr Statement kDurability = {
    "durability",
    "SELECT current_setting('fsync'), current_setting('synchronous_commit'), "
    "current_setting('synchronous_standby_names')"};

template <typename Integer>
void AppendBigEndian(Integer value, std::string* out) {
  for (int shift = 8 * (static_cast<int>(sizeof(value)) - 1); shift >= 0;
       shift -= 8) {
    out->push_back(static_cast<char>(
        static_cast<std::make_unsigned_t<Integer>>(value) >> shift));
  }
}

std::string ArrayHead(std::int32_t type, std::size_t size) {
  std::string array;
  // An empty array has no dimension.
  AppendBigEndian<std::int32_t>(size == 0 ? 0 : 1, &array);
  AppendBigEndian<std::int32_t>(0, &array);
  AppendBigEndian<std::int32_t>(type, &array);
  if (size > 0) {
    AppendBigEndian<std::int32_t>(static_cast<std::int32_t>(size), &array);
    AppendBigEndian<std::int32_t>(1, &array);
  }
  return array;
}

std::string ArrayOfStrings(std::int32_t type,
                           const std::vector<const std::string*>& values) {
  std::size_t bytes = 20;
  for (const std::string* value : values) bytes += 4 + value->size();
  std::string array = ArrayHead(type, values.size());
  array.reserve(bytes);
  for (const std::string* value : values) {
    AppendBigEndian<std::int32_t>(static_cast<std::int32_t>(value->size()),
                                  &array);
    array += *value;
  }
  return array;
}

std::string OneLine(const char* message) {
  std::string line = message == nullptr ? "" : message;
  while (!line.empty() && line.back() == '\n') line.pop_back();
  for (char& c : line) {
    if (c == '\n' || c == '\t') c = ' ';
  }
  return line;
}

absl::Status Unavailable(const std::string& message) {
  return Error(StatusCode::kUnavailable, "STORE_UNAVAILABLE", message);
}

bool StartsWith(const std::string& text, const char* prefix) {
  return text.rfind(prefix, 0) == 0;
}

using ConninfoOptions =
    std::unique_ptr<PQconninfoOption, void (*)(PQconninfoOption*)>;

Durability::Level LevelOf(const std::string& fsync, const std::string& commit,
                          const std::string& standbys) {
  if (fsync != "on" || commit == "off") return Durability::Level::kNone;
  const bool waits =
      commit == "on" || commit == "remote_apply" || commit == "remote_write";
  return waits && !standbys.empty() ? Durability::Level::kReplicated
                                    : Durability::Level::kLocal;
}

}  // namespace

std::string ToText(const Uuid& uuid) {
  constexpr char kDigits[] = "0123456789abcdef";
  std::string text;
  for (std::size_t i = 0; i < uuid.size(); ++i) {
    if (i == 4 || i == 6 || i == 8 || i == 10) text += '-';
    const auto byte = static_cast<unsigned char>(uuid[i]);
    text += kDigits[byte >> 4];
    text += kDigits[byte & 15];
  }
  return text;
}

std::string WithoutSecrets(const std::string& conninfo) {
  const ConninfoOptions options(PQconninfoParse(conninfo.c_str(), nullptr),
                                PQconninfoFree);
  std::string text = "postgresql";
  for (const PQconninfoOption* option = options.get();
       option != nullptr && option->keyword != nullptr; ++option) {
    const std::string keyword = option->keyword;
    if (option->val != nullptr && (keyword == "host" || keyword == "port" ||
                                   keyword == "dbname" || keyword == "user")) {
      text += " " + keyword + "=" + option->val;
    }
  }
  return text;
}

Parameters& Parameters::Add(std::int64_t value) {
  values_.emplace_back();
  AppendBigEndian(value, &values_.back());
  return *this;
}

Parameters& Parameters::AddText(const std::string& text) {
  values_.push_back(text);
  return *this;
}

Parameters& Parameters::Add(const Uuid& uuid) {
  values_.emplace_back(uuid.data(), uuid.size());
  return *this;
}

Parameters& Parameters::Add(const std::vector<std::int64_t>& values) {
  std::string array = ArrayHead(kIntegerType, values.size());
  array.reserve(20 + 12 * values.size());
  for (const std::int64_t value : values) {
    AppendBigEndian<std::int32_t>(sizeof(value), &array);
    AppendBigEndian(value, &array);
  }
  values_.push_back(std::move(array));
  return *this;
}

Parameters& Parameters::Add(const std::vector<Uuid>& values) {
  std::string array = ArrayHead(kUuidType, values.size());
  for (const Uuid& value : values) {
    AppendBigEndian<std::int32_t>(sizeof(value), &array);
    array.append(value.data(), value.size());
  }
  values_.push_back(std::move(array));
  return *this;
}

Parameters& Parameters::AddBytes(
    const std::vector<const std::string*>& values) {
  values_.push_back(ArrayOfStrings(kBytesType, values));
  return *this;
}

Parameters& Parameters::AddTexts(
    const std::vector<const std::string*>& values) {
  values_.push_back(ArrayOfStrings(kTextType, values));
  return *this;
}

std::int64_t PostgresRows::Integer(int row, int column) const {
  const char* bytes = PQgetvalue(result_.get(), row, column);
  const int size = PQgetlength(result_.get(), row, column);
  std::uint64_t value = 0;
  for (int i = 0; i < size; ++i) {
    value = value << 8 | static_cast<unsigned char>(bytes[i]);
  }
  // Narrow numbers keep their sign.
  if (size == 4) return static_cast<std::int32_t>(value);
  if (size == 2) return static_cast<std::int16_t>(value);
  return static_cast<std::int64_t>(value);
}

absl::string_view PostgresRows::View(int row, int column) const {
  return {PQgetvalue(result_.get(), row, column),
          static_cast<std::size_t>(PQgetlength(result_.get(), row, column))};
}

Uuid PostgresRows::GetUuid(int row, int column) const {
  Uuid uuid{};
  if (PQgetlength(result_.get(), row, column) ==
      static_cast<int>(uuid.size())) {
    std::memcpy(uuid.data(), PQgetvalue(result_.get(), row, column),
                uuid.size());
  }
  return uuid;
}

PostgresConnection::PostgresConnection(PGconn* connection,
                                       const std::atomic<bool>* give_up)
    : connection_(connection), give_up_(give_up) {
  PQsetNoticeReceiver(connection, TakeNotice, this);
}

absl::StatusOr<std::unique_ptr<PostgresConnection>> PostgresConnection::Open(
    const Options& options) {
  char* malformed = nullptr;
  const ConninfoOptions parsed(
      PQconninfoParse(options.conninfo.c_str(), &malformed), PQconninfoFree);
  const std::unique_ptr<char, void (*)(void*)> free_malformed(malformed,
                                                              PQfreemem);
  if (parsed == nullptr) {
    return Error(StatusCode::kInvalidArgument, "INVALID_FIELD",
                 "store: " + OneLine(malformed));
  }
  // What comes before dbname can be set otherwise by the operator.
  const char* const keywords[] = {"connect_timeout",
                                  "keepalives_idle",
                                  "keepalives_interval",
                                  "keepalives_count",
                                  "tcp_user_timeout",
                                  "fallback_application_name",
                                  "dbname",
                                  "target_session_attrs",
                                  "client_encoding",
                                  nullptr};
  const char* const values[] = {"5",
                                "5",
                                "2",
                                "3",
                                "10000",
                                "revisitd",
                                options.conninfo.c_str(),
                                "read-write",
                                "UTF8",
                                nullptr};
  std::unique_ptr<PostgresConnection> connection(new PostgresConnection(
      PQconnectdbParams(keywords, values, /*expand_dbname=*/1),
      options.give_up));
  PGconn* const raw = connection->connection_.get();
  if (raw == nullptr || PQstatus(raw) != CONNECTION_OK) {
    return Unavailable("cannot connect to " + WithoutSecrets(options.conninfo) +
                       ": " + OneLine(raw ? PQerrorMessage(raw) : "no memory"));
  }
  if (PQsetnonblocking(raw, 1) != 0) {
    return Unavailable(OneLine(PQerrorMessage(raw)));
  }
  for (const char* session : {kSessionOfAll, kSessionOfWriters}) {
    if (session == kSessionOfWriters && !options.writes) continue;
    const auto set = connection->RunText(session);
    if (!set.ok()) return set.status();
  }
  absl::Status status = connection->ReadDurability();
  if (!status.ok()) return status;
  return connection;
}

absl::Status PostgresConnection::ReadDurability() {
  const auto rows = Run(kDurability);
  if (!rows.ok()) return rows.status();
  const std::string fsync = rows->Bytes(0, 0);
  const std::string commit = rows->Bytes(0, 1);
  const std::string standbys = rows->Bytes(0, 2);
  durability_.level = LevelOf(fsync, commit, standbys);
  durability_.details = "fsync=" + fsync + " synchronous_commit=" + commit +
                        " synchronous_standby_names='" + standbys + "'";
  return absl::OkStatus();
}

void PostgresConnection::TakeNotice(void* self, const PGresult* notice) {
  const char* severity =
      PQresultErrorField(notice, PG_DIAG_SEVERITY_NONLOCALIZED);
  if (severity == nullptr || std::strcmp(severity, "WARNING") != 0) return;
  static_cast<PostgresConnection*>(self)->warning_ =
      OneLine(PQresultErrorMessage(notice));
}

bool PostgresConnection::IsAlive() {
  PGconn* const raw = connection_.get();
  // An end that the database has announced is found here.
  return PQstatus(raw) == CONNECTION_OK && PQconsumeInput(raw) == 1 &&
         PQstatus(raw) == CONNECTION_OK &&
         PQtransactionStatus(raw) == PQTRANS_IDLE;
}

bool PostgresConnection::WaitForSocket(bool to_write) {
  pollfd socket = {PQsocket(connection_.get()),
                   static_cast<short>(to_write ? POLLIN | POLLOUT : POLLIN), 0};
  while (give_up_ == nullptr || !*give_up_) {
    const int ready = poll(&socket, 1, kPollMilliseconds);
    if (ready > 0) return true;
    if (ready < 0 && errno != EINTR) return false;
  }
  return false;
}

bool PostgresConnection::Flush() {
  while (true) {
    const int left = PQflush(connection_.get());
    if (left <= 0) return left == 0;
    // The database may want to be read before it goes on.
    if (!WaitForSocket(/*to_write=*/true) ||
        PQconsumeInput(connection_.get()) == 0) {
      return false;
    }
  }
}

absl::Status PostgresConnection::Failure(const PGresult* result,
                                         const char* doing) {
  const char* state = result == nullptr
                          ? nullptr
                          : PQresultErrorField(result, PG_DIAG_SQLSTATE);
  sqlstate_ = state == nullptr ? "" : state;
  const char* text = result == nullptr ? PQerrorMessage(connection_.get())
                                       : PQresultErrorMessage(result);
  const std::string message = "database: " + OneLine(text) + ", in: " + doing;
  // The database ends a connection after it may have committed.
  in_doubt_ = sqlstate_.empty() || StartsWith(sqlstate_, "57P") ||
              StartsWith(sqlstate_, "08") ||
              PQstatus(connection_.get()) != CONNECTION_OK;
  if (sqlstate_ == "53100") return StorageFull(message);
  if (StartsWith(sqlstate_, "XX00") && sqlstate_ != "XX000") {
    return Corrupt(message);
  }
  // Rights that the role lacks.
  if (sqlstate_ == "42501") {
    return Error(StatusCode::kFailedPrecondition, "STORE_UNAVAILABLE", message);
  }
  // Values, constraints, syntax.
  if (StartsWith(sqlstate_, "22") || StartsWith(sqlstate_, "23") ||
      StartsWith(sqlstate_, "42") || StartsWith(sqlstate_, "21")) {
    return Error(StatusCode::kInternal, "INTERNAL", message);
  }
  return Unavailable(message);
}

absl::StatusOr<PostgresRows> PostgresConnection::Answer(const char* doing) {
  PGconn* const raw = connection_.get();
  in_doubt_ = true;
  if (!Flush()) return Failure(nullptr, doing);
  std::unique_ptr<PostgresRows> rows;
  absl::Status failure;
  while (true) {
    while (PQisBusy(raw) != 0) {
      if (!WaitForSocket(/*to_write=*/false) || PQconsumeInput(raw) == 0) {
        return Failure(nullptr, doing);
      }
    }
    PGresult* const result = PQgetResult(raw);
    if (result == nullptr) break;
    const ExecStatusType status = PQresultStatus(result);
    auto read = std::make_unique<PostgresRows>(result);
    if (status == PGRES_TUPLES_OK || status == PGRES_COMMAND_OK ||
        status == PGRES_EMPTY_QUERY) {
      rows = std::move(read);
    } else if (failure.ok()) {
      failure = Failure(result, doing);
    }
  }
  if (!failure.ok()) return failure;
  if (rows == nullptr) return Failure(nullptr, doing);
  if (!warning_.empty()) {
    // The write is there, but may be gone after a failover.
    return Unavailable("database: " + std::exchange(warning_, "") +
                       ", in: " + doing);
  }
  in_doubt_ = false;
  return absl::StatusOr<PostgresRows>(std::move(*rows));
}

absl::Status PostgresConnection::Prepare(const Statement& statement) {
  if (prepared_.count(statement.name) > 0) return absl::OkStatus();
  if (PQsendPrepare(connection_.get(), statement.name, statement.sql, 0,
                    nullptr) == 0) {
    return Failure(nullptr, statement.name);
  }
  const absl::Status status = Answer(statement.name).status();
  if (status.ok()) prepared_.insert(statement.name);
  return status;
}

absl::StatusOr<PostgresRows> PostgresConnection::Run(
    const Statement& statement, const Parameters& parameters) {
  warning_.clear();
  if (absl::Status status = Prepare(statement); !status.ok()) return status;
  const std::size_t count = parameters.values_.size();
  std::vector<const char*> values(count);
  std::vector<int> lengths(count);
  const std::vector<int> formats(count, 1);
  for (std::size_t i = 0; i < count; ++i) {
    values[i] = parameters.values_[i].data();
    lengths[i] = static_cast<int>(parameters.values_[i].size());
  }
  if (PQsendQueryPrepared(connection_.get(), statement.name,
                          static_cast<int>(count), values.data(),
                          lengths.data(), formats.data(), 1) == 0) {
    return Failure(nullptr, statement.name);
  }
  return Answer(statement.name);
}

absl::StatusOr<PostgresRows> PostgresConnection::RunText(
    const std::string& sql) {
  warning_.clear();
  if (PQsendQuery(connection_.get(), sql.c_str()) == 0) {
    return Failure(nullptr, "session");
  }
  return Answer("session");
}

absl::Status InTransaction(PostgresConnection& connection,
                           const std::function<absl::Status()>& work) {
  absl::Status status = connection.RunText("BEGIN").status();
  if (!status.ok()) return status;
  status = work();
  if (status.ok()) {
    const auto committed = connection.RunText("COMMIT");
    if (!committed.ok()) return committed.status();
    if (committed->Tag() == "COMMIT") return absl::OkStatus();
    return Unavailable("the database rolled the change back");
  }
  // A connection that cannot roll back is not used again.
  if (!connection.IsInDoubt()) connection.RunText("ROLLBACK").IgnoreError();
  return status;
}

}  // namespace revisit::server
