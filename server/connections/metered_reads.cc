#include "server/connections/metered_reads.h"

#include <dlfcn.h>
#include <openssl/crypto.h>
#include <openssl/ssl.h>
#include <sys/socket.h>
#include <sys/syscall.h>
#include <sys/uio.h>
#include <unistd.h>

#include <algorithm>
#include <array>
#include <cerrno>
#include <cstddef>
#include <optional>
#include <unordered_map>
#include <utility>

#include "core/base/mutex.h"

// How this program's own function stands before one of OpenSSL, and calls that.
// It has the same name where OpenSSL is a shared library, and the dynamic
// linker finds it first. Where OpenSSL is linked from its archive, there can be
// only one of a name: --wrap=NAME has the linker send calls of NAME to
// __wrap_NAME, and those of __real_NAME to OpenSSL.
#ifdef REVISIT_OPENSSL_ARCHIVE
#define REVISIT_REPLACEMENT(name) __wrap_##name
#define REVISIT_ORIGINAL(name) (&__real_##name)
// NOLINTBEGIN(bugprone-reserved-identifier): the linker's names.
extern "C" SSL* __real_SSL_new(SSL_CTX* context);
extern "C" int __real_SSL_read(SSL* ssl, void* buffer, int size);
// NOLINTEND(bugprone-reserved-identifier)
#else
#define REVISIT_REPLACEMENT(name) name
#define REVISIT_ORIGINAL(name) \
  (reinterpret_cast<decltype(&(name))>(dlsym(RTLD_NEXT, #name)))
#endif

namespace revisit::server {
namespace {

struct Metered {
  MeterPointer meter;
  WireContent content = WireContent::kHttp2;
};

// A share of the descriptors with a lock of its own: all threads that read go
// through here.
struct Shard {
  Mutex mutex;
  std::unordered_map<int, Metered> meters ABSL_GUARDED_BY(mutex);
};

constexpr std::size_t kShards = 64;
// Decrypted bytes of a stranger that are taken at a time.
constexpr int kTlsBytesAtATime = 512;

// Shards are never destroyed: threads of gRPC may read to the very end.
Shard& ShardOf(int descriptor) {
  static auto* const shards = new std::array<Shard, kShards>();
  return (*shards)[static_cast<std::size_t>(descriptor) % kShards];
}

Metered MeterOf(int descriptor) {
  if (descriptor < 0) return {};
  Shard& shard = ShardOf(descriptor);
  const MutexLock lock(&shard.mutex);
  const auto found = shard.meters.find(descriptor);
  return found == shard.meters.end() ? Metered() : found->second;
}

ssize_t Read(int descriptor, msghdr* message, int flags) {
  return syscall(SYS_recvmsg, descriptor, message, flags);
}

// Reads no more than `most` bytes.
ssize_t ReadSome(int descriptor, msghdr* message, std::size_t most) {
  iovec* const pieces = message->msg_iov;
  const std::size_t count = message->msg_iovlen;
  std::size_t before = 0;
  for (std::size_t i = 0; i < count; ++i) {
    const std::size_t length = pieces[i].iov_len;
    if (before + length <= most) {
      before += length;
      continue;
    }
    pieces[i].iov_len = most - before;
    message->msg_iovlen = i + 1;
    const ssize_t bytes = Read(descriptor, message, 0);
    pieces[i].iov_len = length;
    message->msg_iovlen = count;
    return bytes;
  }
  return Read(descriptor, message, 0);
}

void CountFrames(const msghdr& message, std::size_t bytes,
                 ConnectionMeter* meter) {
  for (std::size_t i = 0; bytes > 0 && i < message.msg_iovlen; ++i) {
    const iovec& piece = message.msg_iov[i];
    const std::size_t count = std::min(bytes, piece.iov_len);
    meter->CountFrames(static_cast<const unsigned char*>(piece.iov_base),
                       count);
    bytes -= count;
  }
}

ssize_t ReadMetered(int descriptor, msghdr* message, int flags) {
  // Reads with flags, such as of the error queue, bring no bytes of the stream.
  const Metered metered = flags == 0 ? MeterOf(descriptor) : Metered();
  ConnectionMeter* const meter = metered.meter.get();
  if (meter == nullptr) return Read(descriptor, message, flags);
  const std::optional<std::size_t> most = meter->MayRead();
  if (!most) return 0;
  if (*most == 0) {
    errno = EAGAIN;
    return -1;
  }
  const ssize_t bytes = ReadSome(descriptor, message, *most);
  if (bytes <= 0) return bytes;
  const auto count = static_cast<std::size_t>(bytes);
  meter->CountReceived(count);
  if (metered.content == WireContent::kHttp2) {
    CountFrames(*message, count, meter);
  }
  return bytes;
}

// ---- TLS

thread_local MeterPointer tls_begins_here;

void FreeMeter(void* /*parent*/, void* meter, CRYPTO_EX_DATA* /*data*/,
               int /*index*/, long /*argl*/, void* /*argp*/) {
  delete static_cast<MeterPointer*>(meter);
}

int MeterIndex() {
  static const int index = CRYPTO_get_ex_new_index(
      CRYPTO_EX_INDEX_SSL, 0, nullptr, nullptr, nullptr, FreeMeter);
  return index;
}

SSL* NewMetered(SSL_CTX* context) {
  static auto* const original = REVISIT_ORIGINAL(SSL_new);
  SSL* const ssl = original(context);
  if (ssl == nullptr || tls_begins_here == nullptr) return ssl;
  auto* const meter = new MeterPointer(tls_begins_here);
  if (SSL_set_ex_data(ssl, MeterIndex(), meter) != 1) delete meter;
  return ssl;
}

int ReadMeteredTls(SSL* ssl, void* buffer, int size) {
  static auto* const original = REVISIT_ORIGINAL(SSL_read);
  const auto* const attached =
      static_cast<const MeterPointer*>(SSL_get_ex_data(ssl, MeterIndex()));
  if (attached == nullptr) return original(ssl, buffer, size);
  ConnectionMeter* const meter = attached->get();
  if (meter->BoundPassed() != nullptr) {
    // What it has sent is as good as not sent: as if it had said goodbye.
    SSL_set_shutdown(ssl, SSL_get_shutdown(ssl) | SSL_RECEIVED_SHUTDOWN);
    return original(ssl, buffer, size);
  }
  // A record has 16 KB, and may pass a bound in the middle. gRPC takes fewer
  // bytes than it has asked for to be all there are.
  auto* const bytes = static_cast<unsigned char*>(buffer);
  int count = 0;
  while (count < size && meter->BoundPassed() == nullptr) {
    const int most = meter->admitted()
                         ? size - count
                         : std::min(size - count, kTlsBytesAtATime);
    const int taken = original(ssl, bytes + count, most);
    if (taken <= 0) return count > 0 ? count : taken;
    meter->CountFrames(bytes + count, static_cast<std::size_t>(taken));
    count += taken;
  }
  return count;
}

}  // namespace

void MeterReads(int descriptor, MeterPointer meter, WireContent content) {
  Shard& shard = ShardOf(descriptor);
  const MutexLock lock(&shard.mutex);
  if (meter == nullptr) {
    shard.meters.erase(descriptor);
  } else {
    shard.meters[descriptor] = {std::move(meter), content};
  }
}

TlsBeginsHere::TlsBeginsHere(int descriptor) {
  Metered metered = MeterOf(descriptor);
  if (metered.content == WireContent::kTls) {
    tls_begins_here = std::move(metered.meter);
  }
}

TlsBeginsHere::~TlsBeginsHere() { tls_begins_here = nullptr; }

}  // namespace revisit::server

extern "C" {

ssize_t recvmsg(int descriptor, msghdr* message, int flags) {
  return revisit::server::ReadMetered(descriptor, message, flags);
}

SSL* REVISIT_REPLACEMENT(SSL_new)(SSL_CTX* context) {
  return revisit::server::NewMetered(context);
}

int REVISIT_REPLACEMENT(SSL_read)(SSL* ssl, void* buffer, int size) {
  return revisit::server::ReadMeteredTls(ssl, buffer, size);
}
}
