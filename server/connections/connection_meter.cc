#include "server/connections/connection_meter.h"

#include <sys/eventfd.h>
#include <unistd.h>

#include <algorithm>
#include <cstddef>

namespace revisit::server {
namespace {

// All connections together that have not had a call let in may have brought
// this many times what one of them may.
constexpr std::uint64_t kShares = 4;
// A connection that has brought less than this is never cut for that sum.
constexpr std::uint64_t kFewBytes = std::uint64_t{64} << 10;
// Bytes of some 3,000 of the smallest calls, which take 60 MB in gRPC.
constexpr std::uint64_t kBytesBetweenLooks = std::uint64_t{64} << 10;

}  // namespace

Unadmitted::Unadmitted() : look_event(eventfd(0, EFD_NONBLOCK | EFD_CLOEXEC)) {}

Unadmitted::~Unadmitted() {
  if (look_event >= 0) close(look_event);
}

void Unadmitted::CountTowardsLook(std::uint64_t received) {
  const std::uint64_t before = bytes_unseen.fetch_add(received);
  if (before < kBytesBetweenLooks && before + received >= kBytesBetweenLooks) {
    static_cast<void>(eventfd_write(look_event, 1));
  }
}

ConnectionMeter::ConnectionMeter(const MeterBounds& bounds,
                                 std::shared_ptr<Unadmitted> unadmitted)
    : bounds_(bounds), unadmitted_(std::move(unadmitted)) {
  ++unadmitted_->connections;
}

ConnectionMeter::~ConnectionMeter() {
  const MutexLock lock(&mutex_);
  if (admitted_) return;
  --unadmitted_->connections;
  unadmitted_->bytes -= debt_;
}

void ConnectionMeter::CountReceived(std::uint64_t bytes) {
  const MutexLock lock(&mutex_);
  received_ += bytes;
  debt_ += bytes;
  if (!admitted_) {
    unadmitted_->CountTowardsLook(bytes);
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

void ConnectionMeter::CountProgress() {
  const MutexLock lock(&mutex_);
  TakeFromDebt(bounds_.credit_bytes);
  if (admitted_) return;
  admitted_ = true;
  --unadmitted_->connections;
  unadmitted_->bytes -= debt_;
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

const char* ConnectionMeter::BoundPassed() const {
  const MutexLock lock(&mutex_);
  return passed_;
}

bool ConnectionMeter::IsHalfWay() const {
  const MutexLock lock(&mutex_);
  const std::uint64_t bound = Bound();
  return bound > 0 && debt_ > bound / 2;
}

std::uint64_t ConnectionMeter::Bound() const {
  return admitted_ || bounds_.max_unadmitted_bytes == 0
             ? bounds_.max_idle_bytes
             : bounds_.max_unadmitted_bytes;
}

bool ConnectionMeter::admitted() const {
  const MutexLock lock(&mutex_);
  return admitted_;
}

std::uint64_t ConnectionMeter::received() const {
  const MutexLock lock(&mutex_);
  return received_;
}

ConnectionMeters::ConnectionMeters(const MeterBounds& bounds)
    : bounds_(bounds), unadmitted_(std::make_shared<Unadmitted>()) {}

void ConnectionMeters::NoteLook() {
  eventfd_t raised;
  static_cast<void>(eventfd_read(unadmitted_->look_event, &raised));
  unadmitted_->bytes_unseen = 0;
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
