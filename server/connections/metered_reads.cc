#include "server/connections/metered_reads.h"

#include <sys/socket.h>
#include <sys/syscall.h>
#include <unistd.h>

#include <array>
#include <cstddef>
#include <unordered_map>
#include <utility>

#include "core/base/mutex.h"

namespace revisit::server {
namespace {

// A share of the descriptors with a lock of its own: all threads that read go
// through here.
struct Shard {
  Mutex mutex;
  std::unordered_map<int, MeterPointer> meters ABSL_GUARDED_BY(mutex);
};

constexpr std::size_t kShards = 64;

// Shards are never destroyed: threads of gRPC may read to the very end.
Shard& ShardOf(int descriptor) {
  static auto* const shards = new std::array<Shard, kShards>();
  return (*shards)[static_cast<std::size_t>(descriptor) % kShards];
}

MeterPointer MeterOf(int descriptor) {
  if (descriptor < 0) return nullptr;
  Shard& shard = ShardOf(descriptor);
  const MutexLock lock(&shard.mutex);
  const auto found = shard.meters.find(descriptor);
  return found == shard.meters.end() ? nullptr : found->second;
}

ssize_t Read(int descriptor, msghdr* message, int flags) {
  return syscall(SYS_recvmsg, descriptor, message, flags);
}

ssize_t ReadMetered(int descriptor, msghdr* message, int flags) {
  // Reads with flags, such as of the error queue, bring no bytes of the stream.
  const MeterPointer meter = flags == 0 ? MeterOf(descriptor) : nullptr;
  if (meter == nullptr) return Read(descriptor, message, flags);
  if (meter->BoundPassed() != nullptr) return 0;
  const ssize_t bytes = Read(descriptor, message, flags);
  if (bytes > 0) meter->CountReceived(static_cast<std::uint64_t>(bytes));
  return bytes;
}

}  // namespace

void MeterReads(int descriptor, MeterPointer meter) {
  Shard& shard = ShardOf(descriptor);
  const MutexLock lock(&shard.mutex);
  if (meter == nullptr) {
    shard.meters.erase(descriptor);
  } else {
    shard.meters[descriptor] = std::move(meter);
  }
}

}  // namespace revisit::server

extern "C" ssize_t recvmsg(int descriptor, msghdr* message, int flags) {
  return revisit::server::ReadMetered(descriptor, message, flags);
}
