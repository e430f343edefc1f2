// The server's log: one line per event, as text or as JSON.
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

class Metrics;

enum class LogFormat { kText, kJson };
enum class LogLevel { kDebug, kInfo, kWarning, kError, kOff };

// As in settings, such as "warning".
const char* NameOf(LogLevel level);

struct LogField {
  // Letters and underscores.
  const char* key;
  std::variant<std::string, std::int64_t, double> value;
};

// Thread-safe. A log that writes to a descriptor never waits for its reader:
// lines that find no room (LineWriter::Options) are dropped, and counted in a
// line of the event log_lines_dropped in their place.
//
//   text: 2026-01-31T12:00:00.000Z info call method=GetVehicle code=OK ...
//   JSON: {"time":"2026-01-31T12:00:00.000Z","level":"info","event":"call",
//          "method":"GetVehicle","code":"OK",...}
//
// In text, a value made only of letters, digits and ._:/@+- stands bare. Any
// other, and in JSON every text, is a string literal of JSON in printable
// ASCII: all other characters are escaped, and invalid UTF-8 becomes U+FFFD. So
// no caller can forge a line or send control sequences to a terminal. Times are
// UTC.
class Log {
 public:
  // Writes to a descriptor, which stays the caller's; SIGPIPE must be ignored.
  // The destructor waits a moment for lines that are not yet written.
  Log(LogFormat format, LogLevel level, int descriptor);
  // Writes to a stream, before Write() returns. The stream must outlive this.
  Log(LogFormat format, LogLevel level, std::ostream* stream);
  ~Log();

  Log(const Log&) = delete;
  Log& operator=(const Log&) = delete;

  // `event` is not escaped: never text of a caller. Fields whose string is
  // empty are left out.
  void Write(LogLevel level, const char* event,
             std::initializer_list<LogField> fields) const;

  // The least severe level that is written from now on.
  void SetLevel(LogLevel level);

  // Number of lines that found no room; 0 for a stream.
  std::int64_t dropped() const;

  // `name`: which of the process's logs this is.
  void CollectMetrics(const char* name, Metrics* metrics) const;

 private:
  struct Sink;
  class LineSink;
  Log(LogFormat format, LogLevel level, std::unique_ptr<Sink> sink);

  const LogFormat format_;
  const std::unique_ptr<Sink> sink_;
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_BASE_LOGGING_H_
