#include "server/base/line_writer.h"

#include <limits.h>
#include <poll.h>
#include <unistd.h>

#include <algorithm>
#include <cerrno>
#include <optional>
#include <utility>

#include "core/base/mutex.h"

namespace revisit::server {
namespace {

using Clock = std::chrono::steady_clock;

// How often a writer that waits for its descriptor checks whether to go on.
constexpr std::chrono::milliseconds kPollInterval{50};

// Writes from `*written` on until `may_go_on()` says false or the descriptor
// fails. A pipe that polls as writable has room for PIPE_BUF bytes, so that
// pieces of that size do not block, which the flags of a descriptor that is
// shared with other processes cannot promise.
template <typename MayGoOn>
bool WriteWhile(int descriptor, const std::string& text, std::size_t* written,
                const MayGoOn& may_go_on) {
  while (*written < text.size()) {
    if (!may_go_on()) return false;
    pollfd ready = {descriptor, POLLOUT, 0};
    if (poll(&ready, 1, static_cast<int>(kPollInterval.count())) <= 0) continue;
    const std::size_t piece =
        std::min<std::size_t>(text.size() - *written, PIPE_BUF);
    const ssize_t size = write(descriptor, text.data() + *written, piece);
    if (size > 0) {
      *written += static_cast<std::size_t>(size);
    } else if (size == 0 || (errno != EAGAIN && errno != EINTR)) {
      return false;
    }
  }
  return true;
}

}  // namespace

bool WriteWithin(int descriptor, const std::string& text,
                 std::chrono::milliseconds limit) {
  const auto deadline = Clock::now() + limit;
  std::size_t written = 0;
  return WriteWhile(descriptor, text, &written,
                    [&] { return Clock::now() < deadline; });
}

// Shared by the writer and its thread, which may be in a write() that never
// returns when the writer is destroyed.
struct LineWriter::State {
  State(int to, const Options& writer_options,
        std::function<std::string(std::int64_t)> gap_line)
      : descriptor(to), options(writer_options), gap(std::move(gap_line)) {}

  void Run();
  // Waits for lines and returns them, followed by the line about dropped ones;
  // nothing once the writer stops and all is written.
  std::optional<std::string> Take();
  // Records how much of `batch` was written.
  void Settle(const std::string& batch, std::size_t written);
  bool MayGoOn();

  const int descriptor;
  const Options options;
  const std::function<std::string(std::int64_t)> gap;

  Mutex mutex;
  CondVar changed;
  std::string queue ABSL_GUARDED_BY(mutex);
  // Bytes that the thread has taken and not yet written.
  std::size_t in_flight ABSL_GUARDED_BY(mutex) = 0;
  // Dropped lines that no line in `queue` or in flight reports.
  std::int64_t dropped ABSL_GUARDED_BY(mutex) = 0;
  // Dropped lines that were reported, besides those and `told`.
  std::int64_t reported ABSL_GUARDED_BY(mutex) = 0;
  // Dropped lines that the last line in flight reports.
  std::int64_t told ABSL_GUARDED_BY(mutex) = 0;
  // Whether the last write failed. Then the writer tries again when the next
  // line comes, not for the gap alone.
  bool failed ABSL_GUARDED_BY(mutex) = false;
  // Whether the last byte that was written was not a newline.
  bool torn ABSL_GUARDED_BY(mutex) = false;
  bool done ABSL_GUARDED_BY(mutex) = false;
  // Set when the writer stops.
  std::optional<Clock::time_point> deadline ABSL_GUARDED_BY(mutex);
};

std::optional<std::string> LineWriter::State::Take() {
  const MutexLock lock(&mutex);
  while (queue.empty() && (dropped == 0 || failed)) {
    if (deadline.has_value()) return std::nullopt;
    changed.Wait(&mutex);
  }
  std::string batch = std::exchange(queue, std::string());
  if (torn) batch.insert(0, 1, '\n');
  told = std::exchange(dropped, 0);
  if (told > 0) batch += gap(told);
  in_flight = batch.size();
  return batch;
}

void LineWriter::State::Settle(const std::string& batch, std::size_t written) {
  const MutexLock lock(&mutex);
  failed = written < batch.size();
  if (failed) {
    dropped += std::count(batch.begin() + static_cast<std::ptrdiff_t>(written),
                          batch.end(), '\n');
    // The line about dropped ones was lost, and with it its count.
    if (told > 0) dropped += told - 1;
  }
  if (written > 0) torn = batch[written - 1] != '\n';
  if (!failed) reported += told;
  in_flight = 0;
  told = 0;
}

bool LineWriter::State::MayGoOn() {
  const MutexLock lock(&mutex);
  return !deadline.has_value() || Clock::now() < *deadline;
}

void LineWriter::State::Run() {
  while (const std::optional<std::string> batch = Take()) {
    std::size_t written = 0;
    WriteWhile(descriptor, *batch, &written, [this] { return MayGoOn(); });
    Settle(*batch, written);
    if (!MayGoOn()) break;
  }
  const MutexLock lock(&mutex);
  done = true;
  changed.NotifyAll();
}

LineWriter::LineWriter(int descriptor, const Options& options,
                       std::function<std::string(std::int64_t)> gap)
    : state_(std::make_shared<State>(descriptor, options, std::move(gap))),
      thread_([state = state_] { state->Run(); }) {}

LineWriter::~LineWriter() {
  bool done = false;
  {
    const MutexLock lock(&state_->mutex);
    state_->deadline = Clock::now() + state_->options.farewell;
    state_->changed.NotifyAll();
    // The thread notices the deadline itself unless a write() blocks.
    const auto last = *state_->deadline + 2 * kPollInterval;
    while (!state_->done && !state_->changed.WaitUntil(&state_->mutex, last)) {
    }
    done = state_->done;
  }
  if (done) {
    thread_.join();
  } else {
    thread_.detach();
  }
}

std::int64_t LineWriter::dropped() const {
  const MutexLock lock(&state_->mutex);
  return state_->reported + state_->told + state_->dropped;
}

void LineWriter::Write(const std::string& line) {
  const MutexLock lock(&state_->mutex);
  const std::size_t waiting = state_->queue.size() + state_->in_flight;
  // Nothing is queued behind a gap that has not been reported.
  const bool gap_is_open = state_->dropped > 0 && !state_->failed;
  if (gap_is_open || waiting + line.size() > state_->options.max_queued_bytes) {
    ++state_->dropped;
    return;
  }
  state_->queue += line;
  state_->changed.NotifyAll();
}

}  // namespace revisit::server
