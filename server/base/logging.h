// The server's log: one event a line, as text or as JSON.
#ifndef REVISIT_SERVER_BASE_LOGGING_H_
#define REVISIT_SERVER_BASE_LOGGING_H_

#include <cstdint>
#include <initializer_list>
#include <iosfwd>
#include <memory>
#include <string>
#include <utility>
#include <variant>

namespace revisit::server {

enum class LogFormat { kText, kJson };
enum class LogLevel { kDebug, kInfo, kWarning, kError, kOff };

struct LogField {
  // Letters and underscores.
  const char* key;
  std::variant<std::string, std::int64_t, double> value;
};

// Printable ASCII: everything else, and what a string literal of JSON cannot
// hold, is escaped as JSON does; bytes that are no UTF-8 become U+FFFD. So no
// caller can forge a line or send control sequences to a terminal.
std::string EscapeForLog(const std::string& text);

// Thread-safe. Where it writes to a descriptor, no call waits for whoever reads
// that: lines that find no room (LineWriter::Options) are dropped, and counted
// in a line of the event log_lines_dropped in their place.
//
//   text: 2026-01-31T12:00:00.000Z info call method=GetVehicle code=OK ...
//   JSON: {"time":"2026-01-31T12:00:00.000Z","level":"info","event":"call",
//          "method":"GetVehicle","code":"OK",...}
//
// In text, a value stands bare where it is made of letters, digits and ._:/@+-
// only, and in quotes otherwise. Times are UTC.
class Log {
 public:
  // To a descriptor, which stays the caller's; SIGPIPE must be ignored. The
  // destructor waits a moment for lines that are not yet written.
  Log(LogFormat format, LogLevel level, int descriptor);
  // To a stream that must outlive this, before Write() returns.
  Log(LogFormat format, LogLevel level, std::ostream* stream);
  ~Log();

  Log(const Log&) = delete;
  Log& operator=(const Log&) = delete;

  // `event` is a word of ours, not of a caller. Fields whose string is empty
  // are left out.
  void Write(LogLevel level, const char* event,
             std::initializer_list<LogField> fields) const;

 private:
  struct Sink;
  Log(LogFormat format, LogLevel level, std::unique_ptr<Sink> sink);

  const LogFormat format_;
  const std::unique_ptr<Sink> sink_;
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_BASE_LOGGING_H_
