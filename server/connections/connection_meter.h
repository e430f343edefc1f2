// Counts how many bytes each connection has brought since it last made
// progress, and says when that is too much.
//
// gRPC as Debian 12 has it (1.51) stores the headers of a call as they come
// until they end, holds a client to a limit only once that client has agreed to
// it, and then to a limit for each frame of headers: a connection whose headers
// do not end, or that begins calls without end, fills the memory. Only the
// received bytes show it, so they are counted before gRPC gets them
// (metered_reads.h). Progress is a call of a caller who was let in, or a
// message of such a call; it is credited at most with the bytes that a call and
// its message may bring.
#ifndef REVISIT_SERVER_CONNECTIONS_CONNECTION_METER_H_
#define REVISIT_SERVER_CONNECTIONS_CONNECTION_METER_H_

#include <atomic>
#include <cstdint>
#include <memory>
#include <string>
#include <unordered_map>

#include "core/base/mutex.h"

namespace revisit::server {

// The limits of the same names (limits.h); 0 switches one off.
struct MeterBounds {
  std::uint64_t max_idle_bytes = 0;
  std::uint64_t max_unadmitted_bytes = 0;
  // Most bytes credited for a call with its message, or for one more message.
  std::uint64_t credit_bytes = 0;
};

// Totals over all connections that have not had a call let in. Thread-safe.
struct Unadmitted {
  Unadmitted();
  ~Unadmitted();

  // Counts bytes until the next look, and raises `look_event` where they may
  // begin more calls than should go unseen.
  void CountTowardsLook(std::uint64_t received);

  std::atomic<std::uint64_t> connections{0};
  std::atomic<std::uint64_t> bytes{0};
  // Bytes since somebody last looked at the connections.
  std::atomic<std::uint64_t> bytes_unseen{0};
  // An eventfd; negative if there was no descriptor for it.
  const int look_event;
};

// Meters one connection. Thread-safe.
class ConnectionMeter {
 public:
  ConnectionMeter(const MeterBounds& bounds,
                  std::shared_ptr<Unadmitted> unadmitted);
  ~ConnectionMeter();

  ConnectionMeter(const ConnectionMeter&) = delete;
  ConnectionMeter& operator=(const ConnectionMeter&) = delete;

  void CountReceived(std::uint64_t bytes);
  // A call was let in, or a message of such a call was read.
  void CountProgress();
  // gRPC holds nothing any more of what came on this connection.
  void Forgive();

  // The bound that the connection has passed, for good; null as long as it may
  // go on.
  const char* BoundPassed() const;
  // Whether it is half-way to a bound.
  bool IsHalfWay() const;
  bool admitted() const;
  std::uint64_t received() const;

 private:
  void TakeFromDebt(std::uint64_t bytes) ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_);
  std::uint64_t Bound() const ABSL_EXCLUSIVE_LOCKS_REQUIRED(mutex_);

  const MeterBounds bounds_;
  const std::shared_ptr<Unadmitted> unadmitted_;

  mutable Mutex mutex_;
  std::uint64_t received_ ABSL_GUARDED_BY(mutex_) = 0;
  // Bytes that came without progress.
  std::uint64_t debt_ ABSL_GUARDED_BY(mutex_) = 0;
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

  const Unadmitted& unadmitted() const { return *unadmitted_; }
  // Readable once connections without a call let in have brought so much that
  // somebody should look at them; negative if there is none.
  int look_event() const { return unadmitted_->look_event; }
  // Called when somebody looks at them: counting towards the next look starts
  // over.
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
