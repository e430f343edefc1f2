// Preloaded into revisitd by the fault matrix: stops it at a statement, or
// takes the fence out of the database's hands. So the program under test is the
// one that is shipped, and knows nothing of it.
//
//   REVISIT_TEST_STATEMENT=NAME  the prepared statement that is meant
//   REVISIT_TEST_STOP_BEFORE=N   the process stops (SIGSTOP) before it sends
//   the
//                                Nth execution, after all that it checks itself
//   REVISIT_TEST_STOP_AFTER=N    and after the answer to the Nth has come,
//                                before anybody is told
//   REVISIT_TEST_WITHOUT=TEXT    this text is cut out of the statement's SQL;
//   if
//                                it is not in there, the process ends
//   REVISIT_TEST_NO_BOOTTIME=1   CLOCK_BOOTTIME, by which leases run, stands
//   still
#include <dlfcn.h>
#include <libpq-fe.h>
#include <signal.h>
#include <time.h>
#include <unistd.h>

#include <atomic>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <string>

namespace {

long Number(const char* name) {
  const char* const text = getenv(name);
  return text == nullptr ? 0 : atol(text);
}

struct Plan {
  const char* statement = getenv("REVISIT_TEST_STATEMENT");
  const char* without = getenv("REVISIT_TEST_WITHOUT");
  long stop_before = Number("REVISIT_TEST_STOP_BEFORE");
  long stop_after = Number("REVISIT_TEST_STOP_AFTER");
  bool no_boottime = Number("REVISIT_TEST_NO_BOOTTIME") != 0;
};

const Plan& ThePlan() {
  static const Plan plan;
  return plan;
}

bool IsMeant(const char* statement) {
  return ThePlan().statement != nullptr &&
         std::strcmp(ThePlan().statement, statement) == 0;
}

std::atomic<long> sent{0};
// The connection whose next answer is that to the statement to stop after.
std::atomic<PGconn*> stops_after{nullptr};

template <typename Function>
Function* Next(const char* name) {
  return reinterpret_cast<Function*>(dlsym(RTLD_NEXT, name));
}

}  // namespace

extern "C" {

int clock_gettime(clockid_t clock, timespec* time) noexcept {
  if (clock == CLOCK_BOOTTIME && ThePlan().no_boottime) {
    *time = {1, 0};
    return 0;
  }
  // Asked for often.
  static auto* const next = Next<int(clockid_t, timespec*)>("clock_gettime");
  return next(clock, time);
}

int PQsendPrepare(PGconn* connection, const char* name, const char* sql,
                  int count, const Oid* types) {
  std::string text = sql;
  if (IsMeant(name) && ThePlan().without != nullptr) {
    const std::size_t at = text.find(ThePlan().without);
    if (at == std::string::npos) {
      std::fprintf(stderr, "statement_shim: '%s' is not in %s\n",
                   ThePlan().without, sql);
      _exit(70);
    }
    text.erase(at, std::strlen(ThePlan().without));
  }
  return Next<int(PGconn*, const char*, const char*, int, const Oid*)>(
      "PQsendPrepare")(connection, name, text.c_str(), count, types);
}

int PQsendQueryPrepared(PGconn* connection, const char* name, int count,
                        const char* const* values, const int* lengths,
                        const int* formats, int result_format) {
  if (IsMeant(name)) {
    const long number = ++sent;
    if (number == ThePlan().stop_before) raise(SIGSTOP);
    if (number == ThePlan().stop_after) stops_after = connection;
  }
  return Next<int(PGconn*, const char*, int, const char* const*, const int*,
                  const int*, int)>("PQsendQueryPrepared")(
      connection, name, count, values, lengths, formats, result_format);
}

PGresult* PQgetResult(PGconn* connection) {
  PGresult* const result = Next<PGresult*(PGconn*)>("PQgetResult")(connection);
  // The end of the answer: the transaction has been committed.
  PGconn* meant = connection;
  if (result == nullptr &&
      stops_after.compare_exchange_strong(meant, nullptr)) {
    raise(SIGSTOP);
  }
  return result;
}

}  // extern "C"
