#include "server/connections/connection_watch.h"

#include <poll.h>
#include <sys/eventfd.h>
#include <sys/socket.h>
#include <unistd.h>

#include <algorithm>
#include <array>
#include <cstdint>
#include <optional>
#include <utility>

namespace revisit::server {
namespace {

// The longest time between two looks, and the least: a look that nobody asks
// for finds what has changed without anything being read.
constexpr std::chrono::milliseconds kLookInterval{100};
constexpr std::chrono::microseconds kLeastInterval{1000};
// Looks take no more than this part of the time.
constexpr int kShareOfLooks = 10;

std::optional<std::uint64_t> SocketCookie(int descriptor) {
  std::uint64_t cookie = 0;
  socklen_t length = sizeof(cookie);
  if (getsockopt(descriptor, SOL_SOCKET, SO_COOKIE, &cookie, &length) != 0) {
    return std::nullopt;
  }
  return cookie;
}

// Whether the other side has closed the connection, also if something that it
// sent before waits to be read.
bool IsLeft(int descriptor) {
  pollfd polled{descriptor, POLLRDHUP, 0};
  return poll(&polled, 1, 0) == 1;
}

// Has gRPC, which waits for something to come, read the socket again: the
// kernel tells those who wait when it is told how much they want at least.
void ReadAgain(int descriptor) {
  const int one = 1;
  // It fails for a socket that is closed, which nobody waits for.
  static_cast<void>(
      setsockopt(descriptor, SOL_SOCKET, SO_RCVLOWAT, &one, sizeof(one)));
}

}  // namespace

ConnectionWatch::ConnectionWatch(const ConnectionTable::Bounds& bounds,
                                 WireContent content, const Log* log,
                                 ConnectionMeters* meters, Refusals* refusals)
    : log_(log),
      meters_(meters),
      refusals_(refusals),
      table_(
          bounds, {SocketCookie, IsLeft},
          [content](int descriptor, MeterPointer meter) {
            MeterReads(descriptor, std::move(meter), content);
          },
          [this](const std::string& remote) {
            return transport_calls_.Count(remote);
          },
          meters),
      end_(eventfd(0, EFD_NONBLOCK | EFD_CLOEXEC)) {}

ConnectionWatch::~ConnectionWatch() {
  Stop();
  if (end_ >= 0) close(end_);
}

int ConnectionWatch::Accept(int listener, int flags) {
  const MutexLock lock(&mutex_);
  return accept4(listener, nullptr, nullptr, flags);
}

const char* ConnectionWatch::Add(int descriptor, const std::string& host,
                                 int port) {
  const MutexLock lock(&mutex_);
  return table_.Add(descriptor, host, port, std::chrono::steady_clock::now());
}

void ConnectionWatch::Start() {
  thread_ = std::thread([this] { Run(); });
}

void ConnectionWatch::Stop() {
  if (!thread_.joinable()) return;
  eventfd_write(end_, 1);
  thread_.join();
}

void ConnectionWatch::Run() {
  std::array<pollfd, 2> polled{
      {{end_, POLLIN, 0}, {meters_->look_event(), POLLIN, 0}}};
  std::chrono::steady_clock::duration pause = kLeastInterval;
  bool is_urgent = false;
  while (true) {
    // What asks for a look meanwhile is seen at the next.
    if (poll(polled.data(), 1,
             static_cast<int>(
                 std::chrono::ceil<std::chrono::milliseconds>(pause).count())) >
        0) {
      return;
    }
    if (!is_urgent) {
      const auto left = std::max<std::chrono::steady_clock::duration>(
          kLookInterval - pause, std::chrono::milliseconds(1));
      poll(polled.data(), polled.size(),
           static_cast<int>(
               std::chrono::duration_cast<std::chrono::milliseconds>(left)
                   .count()));
      if (polled[0].revents != 0) return;
    }
    const auto begin = std::chrono::steady_clock::now();
    is_urgent = Look();
    pause = std::max<std::chrono::steady_clock::duration>(
        kLeastInterval,
        (std::chrono::steady_clock::now() - begin) * (kShareOfLooks - 1));
  }
}

bool ConnectionWatch::Look() {
  meters_->NoteLook();
  const MutexLock lock(&mutex_);
  const ConnectionTable::Findings findings =
      table_.Look(std::chrono::steady_clock::now());
  for (const ConnectionTable::Harmful& harmful : findings.harmful) {
    refusals_->Count(harmful.bound);
    log_->Write(
        LogLevel::kWarning, "connection_cut",
        {{"limit", std::string(harmful.bound)}, {"peer", harmful.host}});
    // gRPC keeps the descriptor and notices the end.
    if (harmful.descriptor >= 0) shutdown(harmful.descriptor, SHUT_RDWR);
  }
  for (const int descriptor : findings.left) shutdown(descriptor, SHUT_RDWR);
  for (const int descriptor : findings.resumed) ReadAgain(descriptor);
  return findings.is_urgent;
}

}  // namespace revisit::server
