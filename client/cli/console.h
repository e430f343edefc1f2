// Output of the commands: results on one stream, progress on another.
#ifndef REVISIT_CLIENT_CLI_CONSOLE_H_
#define REVISIT_CLIENT_CLI_CONSOLE_H_

#include <chrono>
#include <cstdint>
#include <ostream>
#include <string>
#include <utility>
#include <vector>

#include "absl/status/status.h"
#include "core/base/mutex.h"

namespace google::protobuf {
class Message;
}

namespace revisit::client {

struct Console {
  std::ostream& out;
  std::ostream& progress;
  // Whether progress is drawn in place.
  bool progress_is_terminal = false;
  // Whether results are JSON.
  bool json = false;
};

// Exit codes of the program. An error of a server exits with 64 + its gRPC
// code.
inline constexpr int kExitOk = 0;
inline constexpr int kExitLocalError = 1;
inline constexpr int kExitUsage = 64;
inline constexpr int kExitInterrupted = 130;

// Marks a status as a fault of this machine (a file, the private server), not
// of the server that was asked.
absl::Status LocalError(const absl::Status& status);

int ExitCodeOf(const absl::Status& status);

// Describes an error to people: a fault of this machine in its own words, an
// error of the server with its code.
std::string ErrorText(const absl::Status& status);

// A message as protobuf JSON, including fields that have their default value;
// on one line unless `pretty`.
std::string ToJson(const google::protobuf::Message& message, bool pretty);

// An error as {"error": {"code", "message", "reason", "metadata",
// "fieldViolations"}}, on one line.
std::string ErrorToJson(const absl::Status& status);

// Prints columns as wide as they need to be. Numbers are the caller's text.
class Table {
 public:
  enum class Align { kLeft, kRight };
  struct Column {
    std::string title;
    Align align = Align::kLeft;
  };

  explicit Table(std::vector<Column> columns);

  // REQUIRES: as many cells as columns.
  void AddRow(std::vector<std::string> cells);
  // A line across before the next row.
  void AddRule();
  void Print(std::ostream& out) const;

 private:
  const std::vector<Column> columns_;
  // An empty row is a rule.
  std::vector<std::vector<std::string>> rows_;
};

// Prints "name  value" lines with the values aligned.
void PrintFields(const std::vector<std::pair<std::string, std::string>>& fields,
                 std::ostream& out);

// The number with this many digits after the point.
std::string Fixed(double value, int digits);

// Shows how far long work has come: a bar that is redrawn in place on a
// terminal, a line every few seconds elsewhere. Thread-safe.
class Progress {
 public:
  // `total` units of work; 0 if nobody knows how many.
  Progress(const Console& console, std::string label, std::uint64_t total,
           std::string unit);
  // Ends the line of the bar.
  ~Progress();

  Progress(const Progress&) = delete;
  Progress& operator=(const Progress&) = delete;

  void Update(std::uint64_t done);
  // Prints a line without spoiling the bar.
  void Note(const std::string& text);

 private:
  void Draw() ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_);
  void EraseBar() ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_);

  using Clock = std::chrono::steady_clock;

  const bool terminal_;
  const std::string label_;
  const std::uint64_t total_;
  const std::string unit_;
  const Clock::time_point start_;

  Mutex mutex_;
  std::ostream& out_ ABSL_GUARDED_BY(mutex_);
  Clock::time_point last_draw_ ABSL_GUARDED_BY(mutex_);
  std::uint64_t done_ ABSL_GUARDED_BY(mutex_) = 0;
  bool bar_shown_ ABSL_GUARDED_BY(mutex_) = false;
};

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_CLI_CONSOLE_H_
