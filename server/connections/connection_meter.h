// Counts what each connection brings: says when it is too much, and when the
// connection has to wait until somebody has looked at what gRPC holds for it.
//
// gRPC as Debian 12 has it (1.51) stores the headers of a call as they come
// until they end, holds a client to a limit only once that client has agreed to
// it, and then to a limit for each frame of headers: a connection whose headers
// do not end, or that begins calls without end, fills the memory. Only the
// received bytes show it, so they are counted before gRPC gets them
// (metered_reads.h): bytes, and the calls and headers among them. Progress is a
// call of a caller who was let in, or a message of such a call; it is credited
// at most with the bytes that a call and its message may bring.
//
// A connection that has had no call let in is a stranger's. Of its bytes no
// more are read than it has room for: in the memory that its calls hold by
// estimate, in that of all strangers together, and in processor time, of which
// strangers get a share (ConnectionTable). What is not read waits in the
// kernel, and then with the stranger.
#ifndef REVISIT_SERVER_CONNECTIONS_CONNECTION_METER_H_
#define REVISIT_SERVER_CONNECTIONS_CONNECTION_METER_H_

#include <atomic>
#include <chrono>
#include <cstddef>
#include <cstdint>
#include <limits>
#include <memory>
#include <optional>
#include <string>
#include <unordered_map>

#include "core/base/mutex.h"
#include "server/connections/frame_reader.h"
#include "server/connections/held_calls.h"

namespace revisit::server {

// Zero switches a bound off.
struct MeterBounds {
  // The limits of the same names (limits.h).
  std::uint64_t max_idle_bytes = 0;
  std::uint64_t max_unadmitted_bytes = 0;
  // Most bytes credited for a call with its message, or for one more message.
  std::uint64_t credit_bytes = 0;
  // Calls that one connection may hold, including those that were reset and are
  // not yet cleared away.
  std::uint64_t max_held_calls = 0;
  // Calls that one stranger may hold, including those that were reset.
  std::uint64_t max_unadmitted_calls = 0;
  // Estimated bytes that gRPC may hold for the calls of all strangers together;
  // for those of one, kShareOfOne.
  std::uint64_t max_unadmitted_memory = 0;
};

// Calls of one connection, as gRPC counts them.
struct CallCounts {
  // Calls in memory, including those that were reset and not yet cleared away.
  std::uint64_t held = 0;
  // Calls that have ended and left the memory.
  std::uint64_t over = 0;
};

// Totals over all connections that have not had a call let in. Thread-safe.
struct Unadmitted {
  Unadmitted();
  ~Unadmitted();

  // Wakes whoever looks at the connections.
  void AskForLook() const;

  std::atomic<std::uint64_t> connections{0};
  std::atomic<std::uint64_t> bytes{0};
  // Estimated bytes that gRPC holds for their calls.
  std::atomic<std::uint64_t> memory{0};
  // An eventfd; negative if there was no descriptor for it.
  const int look_event;
};

// Meters one connection. Thread-safe.
class ConnectionMeter {
 public:
  using Work = std::chrono::nanoseconds;

  // A stranger's calls may hold this part of max_unadmitted_memory.
  static constexpr std::uint64_t kShareOfOne = 16;
  static constexpr std::size_t kAnyNumber =
      std::numeric_limits<std::size_t>::max();

  ConnectionMeter(const MeterBounds& bounds,
                  std::shared_ptr<Unadmitted> unadmitted);
  ~ConnectionMeter();

  ConnectionMeter(const ConnectionMeter&) = delete;
  ConnectionMeter& operator=(const ConnectionMeter&) = delete;

  // Bytes that may be read from the socket now, nothing if it has passed a
  // bound. With 0 the connection waits, and a look is asked for, after which
  // Resume() says whether it may go on.
  std::optional<std::size_t> MayRead();
  // Bytes came from the socket.
  void CountReceived(std::uint64_t bytes);
  // The next bytes of what the client says, decrypted.
  void CountFrames(const unsigned char* bytes, std::size_t count);
  // A call was let in, or a message of such a call was read.
  void CountProgress();
  // gRPC holds nothing any more of what came on this connection.
  void Forgive();
  // What gRPC says of the calls now. `is_settled` if gRPC has acted on all that
  // came: what it then does not know is no call.
  void LearnCalls(const CallCounts& counts, bool is_settled);
  // Processor time that the connection may cost on top of what it was granted.
  void Grant(Work work);
  // The connection counts as having passed this bound.
  void Condemn(const char* bound);
  // Whether a connection that waits may go on; it then waits no longer. Its
  // socket has to be read again.
  bool Resume();

  // What a look at the connection asks for.
  struct Standing {
    bool is_admitted;
    bool is_waiting;
    // Whether it waits for a grant.
    bool wants_work;
    // Whether gRPC's counts would change something.
    bool wants_counts;
    // Whether it is half-way to a bound of bytes.
    bool is_half_way;
    // The bound that it has passed, for good; null as long as it may go on.
    const char* passed;
    std::uint64_t received;
    // Estimated bytes that gRPC holds for its calls.
    std::uint64_t memory;
    // Whether that is as much as a stranger's may be.
    bool is_full;
    // Processor time by estimate, so far.
    Work work;
  };
  Standing standing() const;

  // As in Standing.
  const char* BoundPassed() const;
  bool admitted() const;

 private:
  void TakeFromDebt(std::uint64_t bytes) ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_);
  void CountHead(const FrameHead& head) ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_);
  void Spend(Work work) ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_);
  // Brings the total of strangers' memory up to date.
  void UpdateMemory() ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_);
  bool IsHalfWay() const ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_);
  bool HoldsMoreThan(std::uint64_t calls) const
      ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_);
  bool IsFull() const ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_);
  bool MustWait() const ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_);

  const MeterBounds bounds_;
  const std::shared_ptr<Unadmitted> unadmitted_;

  mutable Mutex mutex_;
  std::uint64_t received_ ABSL_GUARDED_BY(mutex_) = 0;
  // Bytes that came without progress.
  std::uint64_t debt_ ABSL_GUARDED_BY(mutex_) = 0;
  FrameReader frames_ ABSL_GUARDED_BY(mutex_);
  HeldCalls calls_ ABSL_GUARDED_BY(mutex_);
  // Calls that are over of those that calls_ was told.
  std::uint64_t over_ ABSL_GUARDED_BY(mutex_) = 0;
  // Its part of unadmitted_->memory.
  std::uint64_t counted_memory_ ABSL_GUARDED_BY(mutex_) = 0;
  Work work_ ABSL_GUARDED_BY(mutex_){0};
  Work granted_ ABSL_GUARDED_BY(mutex_);
  // Pings without progress.
  int pings_ ABSL_GUARDED_BY(mutex_) = 0;
  bool is_waiting_ ABSL_GUARDED_BY(mutex_) = false;
  bool admitted_ ABSL_GUARDED_BY(mutex_) = false;
  const char* passed_ ABSL_GUARDED_BY(mutex_) = nullptr;
};

// Null stands for a connection that nobody counts.
using MeterPointer = std::shared_ptr<ConnectionMeter>;

// The meters of all connections. Thread-safe.
class ConnectionMeters {
 public:
  explicit ConnectionMeters(const MeterBounds& bounds);

  // `remote` is the other end, host and port: "127.0.0.1:4711", "::1:4711". The
  // new connection replaces an earlier one from there.
  MeterPointer Open(const std::string& remote);
  // Forgets a connection that is gone, but not one that has taken its place.
  void Close(const std::string& remote, const MeterPointer& meter);
  // `peer` in gRPC's form: "ipv4:127.0.0.1:4711", "ipv6:%5B::1%5D:4711".
  MeterPointer Find(const std::string& peer) const;

  const MeterBounds& bounds() const { return bounds_; }
  const Unadmitted& unadmitted() const { return *unadmitted_; }
  // Readable once somebody should look at the connections; negative if there
  // was no descriptor for it.
  int look_event() const { return unadmitted_->look_event; }
  // Called before somebody looks at them.
  void NoteLook();

  // The remote end that a peer in gRPC's form names.
  static std::string RemoteOf(const std::string& peer);

 private:
  const MeterBounds bounds_;
  // Shared with meters, which may outlive this.
  const std::shared_ptr<Unadmitted> unadmitted_;
  mutable Mutex mutex_;
  std::unordered_map<std::string, MeterPointer> meters_ ABSL_GUARDED_BY(mutex_);
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_CONNECTIONS_CONNECTION_METER_H_
