// Writes lines to a descriptor that may block, without ever making the caller
// wait for it.
//
// A server's standard error is often a pipe. If its reader stops, a write()
// waits for ever, and with it every thread that has something to log. spdlog's
// own thread pool bounds the number of lines, not their bytes, and its
// destructor waits for a write that blocks; hence this class.
#ifndef REVISIT_SERVER_BASE_LINE_WRITER_H_
#define REVISIT_SERVER_BASE_LINE_WRITER_H_

#include <chrono>
#include <cstddef>
#include <cstdint>
#include <functional>
#include <memory>
#include <string>
#include <thread>

namespace revisit::server {

// Writes `text` to the descriptor, but waits no longer than `limit` for it to
// take more. Returns whether all of it was written.
bool WriteWithin(int descriptor, const std::string& text,
                 std::chrono::milliseconds limit);

// Thread-safe. A thread of its own writes the lines in the order in which they
// came.
class LineWriter {
 public:
  struct Options {
    // Bytes that may wait to be written; lines beyond them are dropped.
    std::size_t max_queued_bytes = std::size_t{1} << 20;
    // How long the destructor waits for the descriptor to take what is queued.
    std::chrono::milliseconds farewell{500};
  };

  // `gap` makes the line that is written in the place of so many dropped ones,
  // as soon as lines can be written again. It runs on the writer's thread and
  // must own what it uses, because that thread outlives this object if a write
  // never returns. SIGPIPE must be ignored. The descriptor stays the caller's.
  LineWriter(int descriptor, const Options& options,
             std::function<std::string(std::int64_t dropped)> gap);
  ~LineWriter();

  LineWriter(const LineWriter&) = delete;
  LineWriter& operator=(const LineWriter&) = delete;

  // `line` includes its newline. Returns at once.
  void Write(const std::string& line);

  // Number of lines that were dropped since the start.
  std::int64_t dropped() const;

 private:
  struct State;
  const std::shared_ptr<State> state_;
  std::thread thread_;
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_BASE_LINE_WRITER_H_
