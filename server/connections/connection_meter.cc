#include "server/connections/connection_meter.h"

#include <sys/eventfd.h>
#include <unistd.h>

#include <algorithm>
#include <cstddef>
#include <utility>

namespace revisit::server {
namespace {

using Work = ConnectionMeter::Work;
using std::chrono::microseconds;

// All connections together that have not had a call let in may have brought
// this many times what one of them may.
constexpr std::uint64_t kShares = 4;
// A connection that has brought less than this is never cut for that sum.
constexpr std::uint64_t kFewBytes = std::uint64_t{64} << 10;

// Bytes of a stranger that are read at a time, beside what is known to be the
// rest of a frame: not so many that what gRPC does with them before it reads
// again could take long.
constexpr std::size_t kBytesAtATime = 256;
// Pings of a stranger without progress. gRPC says goodbye after three that come
// too soon, but then takes the longer for each that it has read already the
// more they are: it worked on 16 KB of them for seconds.
constexpr int kMaxPings = 32;
// A stranger whose calls hold less than this is not to blame for what all hold
// together, and may go on until that is twice as much as it may be.
constexpr std::uint64_t kLittleMemory = std::uint64_t{256} << 10;

// Estimates of the processor time that gRPC 1.51 takes; they need to be right
// in their proportions only.
constexpr Work kWorkOfCall = microseconds(100);
constexpr Work kWorkOfPing = microseconds(200);
constexpr Work kWorkOfSettings = microseconds(50);
constexpr Work kWorkOfReset = microseconds(20);
constexpr Work kWorkOfOtherFrame = microseconds(2);
constexpr Work kWorkOfHeaderByte{50};
constexpr Work kWorkOfByte{1};
// Granted from the beginning: what the first calls of an honest client take.
constexpr Work kFirstWork = microseconds(1000);

Work WorkOf(const FrameHead& head) {
  switch (head.type) {
    case FrameType::kHeaders:
      return kWorkOfCall + kWorkOfHeaderByte * head.length;
    case FrameType::kContinuation:
      return kWorkOfOtherFrame + kWorkOfHeaderByte * head.length;
    case FrameType::kPing:
      return head.is_answer ? kWorkOfOtherFrame : kWorkOfPing;
    case FrameType::kSettings:
      return head.is_answer ? kWorkOfOtherFrame : kWorkOfSettings;
    case FrameType::kResetStream:
      return kWorkOfReset;
    default:
      return kWorkOfOtherFrame;
  }
}

}  // namespace

Unadmitted::Unadmitted() : look_event(eventfd(0, EFD_NONBLOCK | EFD_CLOEXEC)) {}

Unadmitted::~Unadmitted() {
  if (look_event >= 0) close(look_event);
}

void Unadmitted::AskForLook() const {
  static_cast<void>(eventfd_write(look_event, 1));
}

ConnectionMeter::ConnectionMeter(const MeterBounds& bounds,
                                 std::shared_ptr<Unadmitted> unadmitted)
    : bounds_(bounds),
      unadmitted_(std::move(unadmitted)),
      granted_(kFirstWork) {
  ++unadmitted_->connections;
}

ConnectionMeter::~ConnectionMeter() {
  const MutexLock lock(&mutex_);
  if (admitted_) return;
  --unadmitted_->connections;
  unadmitted_->bytes -= debt_;
  unadmitted_->memory -= counted_memory_;
}

std::optional<std::size_t> ConnectionMeter::MayRead() {
  const MutexLock lock(&mutex_);
  if (passed_ != nullptr) return std::nullopt;
  if (MustWait()) {
    if (!std::exchange(is_waiting_, true)) unadmitted_->AskForLook();
    return 0;
  }
  return admitted_ ? kAnyNumber : frames_.left_of_frame() + kBytesAtATime;
}

bool ConnectionMeter::MustWait() const {
  if (bounds_.max_held_calls > 0 && HoldsMoreThan(bounds_.max_held_calls)) {
    return true;
  }
  if (admitted_) return false;
  if (work_ > granted_ || IsFull()) return true;
  if (bounds_.max_unadmitted_memory == 0) return false;
  const std::uint64_t most = calls_.memory() < kLittleMemory
                                 ? 2 * bounds_.max_unadmitted_memory
                                 : bounds_.max_unadmitted_memory;
  return unadmitted_->memory > most;
}

bool ConnectionMeter::HoldsMoreThan(std::uint64_t calls) const {
  return calls_.count() > calls;
}

bool ConnectionMeter::IsFull() const {
  return bounds_.max_unadmitted_memory > 0 && !admitted_ &&
         calls_.memory() > bounds_.max_unadmitted_memory / kShareOfOne;
}

void ConnectionMeter::Condemn(const char* bound) {
  const MutexLock lock(&mutex_);
  if (passed_ == nullptr) passed_ = bound;
}

bool ConnectionMeter::Resume() {
  const MutexLock lock(&mutex_);
  if (!is_waiting_ || (passed_ == nullptr && MustWait())) return false;
  is_waiting_ = false;
  return true;
}

void ConnectionMeter::CountReceived(std::uint64_t bytes) {
  const MutexLock lock(&mutex_);
  received_ += bytes;
  debt_ += bytes;
  Spend(kWorkOfByte * bytes);
  if (!admitted_) {
    const std::uint64_t all = unadmitted_->bytes += bytes;
    const std::uint64_t most = bounds_.max_unadmitted_bytes;
    if (most > 0 &&
        (debt_ > most || (all > kShares * most && debt_ > kFewBytes))) {
      passed_ = "max-unadmitted-bytes";
      return;
    }
  }
  if (bounds_.max_idle_bytes > 0 && debt_ > bounds_.max_idle_bytes) {
    passed_ = "max-idle-bytes";
  }
}

void ConnectionMeter::CountFrames(const unsigned char* bytes,
                                  std::size_t count) {
  const MutexLock lock(&mutex_);
  FrameHead head{};
  while (frames_.Next(&bytes, &count, &head)) CountHead(head);
  UpdateMemory();
}

void ConnectionMeter::CountHead(const FrameHead& head) {
  Spend(WorkOf(head));
  switch (head.type) {
    case FrameType::kHeaders:
      calls_.Begin(head.length);
      if (head.ends_headers) calls_.Complete();
      if (!admitted_ && bounds_.max_unadmitted_calls > 0 &&
          HoldsMoreThan(bounds_.max_unadmitted_calls)) {
        passed_ = "max-unadmitted-calls";
      }
      break;
    case FrameType::kContinuation:
      calls_.Grow(head.length);
      if (head.ends_headers) calls_.Complete();
      break;
    case FrameType::kPing:
      if (!admitted_ && !head.is_answer && ++pings_ > kMaxPings) {
        passed_ = "max-unadmitted-pings";
      }
      break;
    default:
      break;
  }
}

void ConnectionMeter::Spend(Work work) {
  if (!admitted_) work_ += work;
}

void ConnectionMeter::UpdateMemory() {
  if (admitted_) return;
  const std::uint64_t memory = calls_.memory();
  // Of unsigned numbers the difference may also be below zero.
  unadmitted_->memory += memory - std::exchange(counted_memory_, memory);
}

void ConnectionMeter::CountProgress() {
  const MutexLock lock(&mutex_);
  TakeFromDebt(bounds_.credit_bytes);
  if (admitted_) return;
  admitted_ = true;
  --unadmitted_->connections;
  unadmitted_->bytes -= debt_;
  unadmitted_->memory -= std::exchange(counted_memory_, 0);
  if (is_waiting_) unadmitted_->AskForLook();
}

void ConnectionMeter::Forgive() {
  const MutexLock lock(&mutex_);
  TakeFromDebt(debt_);
}

void ConnectionMeter::TakeFromDebt(std::uint64_t bytes) {
  const std::uint64_t taken = std::min(debt_, bytes);
  debt_ -= taken;
  if (!admitted_) unadmitted_->bytes -= taken;
}

void ConnectionMeter::LearnCalls(const CallCounts& counts, bool is_settled) {
  const MutexLock lock(&mutex_);
  if (counts.over > over_) calls_.End(counts.over - over_);
  over_ = std::max(over_, counts.over);
  if (is_settled && calls_.count() > counts.held) {
    calls_.End(calls_.count() - counts.held);
  }
  UpdateMemory();
  if (bounds_.max_held_calls > 0 && counts.held > bounds_.max_held_calls) {
    passed_ = "max-concurrent-streams";
  }
}

void ConnectionMeter::Grant(Work work) {
  const MutexLock lock(&mutex_);
  granted_ += work;
}

ConnectionMeter::Standing ConnectionMeter::standing() const {
  const MutexLock lock(&mutex_);
  Standing standing{};
  standing.is_admitted = admitted_;
  standing.is_waiting = is_waiting_;
  standing.wants_work = is_waiting_ && !admitted_ && work_ > granted_;
  // Calls of an admitted connection are in order as long as they are not nearly
  // too many.
  standing.wants_counts =
      admitted_ ? bounds_.max_held_calls > 0 &&
                      HoldsMoreThan(bounds_.max_held_calls / 4 * 3)
                : calls_.count() > 0;
  standing.is_half_way = IsHalfWay();
  standing.passed = passed_;
  standing.received = received_;
  standing.memory = calls_.memory();
  standing.is_full = IsFull();
  standing.work = work_;
  return standing;
}

bool ConnectionMeter::IsHalfWay() const {
  const std::uint64_t bound = admitted_ || bounds_.max_unadmitted_bytes == 0
                                  ? bounds_.max_idle_bytes
                                  : bounds_.max_unadmitted_bytes;
  return bound > 0 && debt_ > bound / 2;
}

const char* ConnectionMeter::BoundPassed() const {
  const MutexLock lock(&mutex_);
  return passed_;
}

bool ConnectionMeter::admitted() const {
  const MutexLock lock(&mutex_);
  return admitted_;
}

ConnectionMeters::ConnectionMeters(const MeterBounds& bounds)
    : bounds_(bounds), unadmitted_(std::make_shared<Unadmitted>()) {}

void ConnectionMeters::NoteLook() {
  eventfd_t raised;
  static_cast<void>(eventfd_read(unadmitted_->look_event, &raised));
}

MeterPointer ConnectionMeters::Open(const std::string& remote) {
  auto meter = std::make_shared<ConnectionMeter>(bounds_, unadmitted_);
  const MutexLock lock(&mutex_);
  meters_[remote] = meter;
  return meter;
}

void ConnectionMeters::Close(const std::string& remote,
                             const MeterPointer& meter) {
  const MutexLock lock(&mutex_);
  const auto found = meters_.find(remote);
  if (found != meters_.end() && found->second == meter) meters_.erase(found);
}

MeterPointer ConnectionMeters::Find(const std::string& peer) const {
  const std::string remote = RemoteOf(peer);
  const MutexLock lock(&mutex_);
  const auto found = meters_.find(remote);
  return found == meters_.end() ? nullptr : found->second;
}

std::string ConnectionMeters::RemoteOf(const std::string& peer) {
  const std::size_t scheme = peer.find(':');
  if (scheme == std::string::npos) return peer;
  std::string remote;
  for (std::size_t i = scheme + 1; i < peer.size(); ++i) {
    if (peer.compare(i, 3, "%5B") == 0 || peer.compare(i, 3, "%5D") == 0) {
      i += 2;
    } else if (peer[i] != '[' && peer[i] != ']') {
      remote += peer[i];
    }
  }
  return remote;
}

}  // namespace revisit::server
