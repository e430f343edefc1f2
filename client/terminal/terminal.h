// Output of the commands: results on one stream, progress on another.
#ifndef REVISIT_CLIENT_TERMINAL_TERMINAL_H_
#define REVISIT_CLIENT_TERMINAL_TERMINAL_H_

#include <chrono>
#include <cstddef>
#include <cstdint>
#include <ostream>
#include <string>
#include <utility>
#include <vector>

#include "absl/status/status.h"
#include "client/terminal/table.h"
#include "core/base/mutex.h"
#include "nlohmann/json_fwd.hpp"

namespace google::protobuf {
class Message;
}

namespace revisit::client {

// The form of results. Every command has kText and kJson.
enum class OutputFormat {
  // For people.
  kText,
  // Text with all columns that there are.
  kWide,
  // Only the names of what the answer holds, each on a line.
  kName,
  kJson,
};

struct Terminal {
  std::ostream& out;
  std::ostream& progress;
  // Whether progress is drawn in place.
  bool progress_is_terminal = false;
  OutputFormat format = OutputFormat::kText;
  // Columns of the terminal to which `out` leads; 0 if it leads elsewhere.
  std::size_t width = 0;

  bool json() const { return format == OutputFormat::kJson; }
  bool wide() const { return format == OutputFormat::kWide; }
  bool names() const { return format == OutputFormat::kName; }
};

// Columns of the terminal on this descriptor; COLUMNS in the environment wins.
// 0 if it is no terminal and COLUMNS says nothing.
std::size_t TerminalWidth(int descriptor);

// Exit codes of the program. An error of a server exits with 64 + its gRPC
// code.
inline constexpr int kExitOk = 0;
inline constexpr int kExitLocalError = 1;
inline constexpr int kExitUsage = 64;
inline constexpr int kExitInterrupted = 130;

// Adds to an error what whoever reads it can do next: a line of its own below
// the message, and below a hint that it has, "hint" in the JSON.
absl::Status WithHint(const absl::Status& status, const std::string& hint);

// A wrong usage of the command line, in words of its own.
absl::Status UsageError(const std::string& problem, const std::string& hint);

// Marks a status as a fault of this machine (a file, the private server), not
// of the server that was asked.
absl::Status LocalError(const absl::Status& status);

int ExitCodeOf(const absl::Status& status);

// Describes an error to people: a fault of this machine in its own words, an
// error of the server with its code. Fit for a terminal, as Describe() is.
std::string ErrorText(const absl::Status& status);

// JSON on one line unless `pretty`. Fit for a terminal: what could steer it, or
// shows as nothing, is escaped (printable_text.h).
std::string JsonText(const nlohmann::ordered_json& json, bool pretty);

// A message as protobuf JSON, including fields that have their default value;
// on one line unless `pretty`. Whole numbers of 64 bits are numbers, as all
// others are, not texts.
std::string ToJson(const google::protobuf::Message& message, bool pretty);

// An error as {"error": {"code", "message", "reason", "metadata",
// "fieldViolations"}}, and "hint" if it has one, on one line.
std::string ErrorToJson(const absl::Status& status);

// Prints "name  value" lines with the values aligned, each Printable().
void PrintFields(const std::vector<std::pair<std::string, std::string>>& fields,
                 std::ostream& out);

// The number with this many digits after the point.
std::string Fixed(double value, int digits);

// Shows how far long work has come: a bar that is redrawn in place on a
// terminal, a line every few seconds elsewhere. Thread-safe.
class Progress {
 public:
  // `total` units of work; 0 if nobody knows how many. The label is made
  // Printable().
  Progress(const Terminal& terminal, const std::string& label,
           std::uint64_t total, std::string unit);
  // Ends the line of the bar.
  ~Progress();

  Progress(const Progress&) = delete;
  Progress& operator=(const Progress&) = delete;

  void Update(std::uint64_t done);
  // Prints a line without spoiling the bar. What others said in it has to be
  // Printable().
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

#endif  // REVISIT_CLIENT_TERMINAL_TERMINAL_H_
