#include "server/connections/connection_acceptor.h"

#include <arpa/inet.h>
#include <fcntl.h>
#include <netdb.h>
#include <netinet/in.h>
#include <netinet/tcp.h>
#include <poll.h>
#include <sys/eventfd.h>
#include <sys/resource.h>
#include <sys/socket.h>
#include <sys/stat.h>
#include <sys/un.h>
#include <unistd.h>

#include <algorithm>
#include <cerrno>
#include <cstddef>
#include <cstring>
#include <limits>
#include <optional>
#include <utility>

#include "server/base/listen_address.h"
#include "server/base/metrics.h"
#include "server/connections/metered_reads.h"

namespace revisit::server {
namespace {

constexpr int kBacklog = 4096;
constexpr char kUnixPrefix[] = "unix:";
constexpr char kAbstractPrefix[] = "unix-abstract:";
// All connections shed within this interval share one line in the log.
constexpr std::chrono::seconds kLogInterval{1};
// Connections that are taken from one listener before anything else is done: a
// flood must not hold up the end of the server.
constexpr int kAcceptsPerRound = 64;
// Pause before another try after the kernel lacked a resource.
constexpr int kPauseMilliseconds = 10;

std::string ErrnoText() {
  char text[128];
  return strerror_r(errno, text, sizeof(text));
}

absl::Status CannotListen(const std::string& address, const std::string& why) {
  return absl::UnavailableError(
      ("cannot listen at " + address + ": " + why).c_str());
}

bool HasPrefix(const std::string& text, const char* prefix) {
  return text.rfind(prefix, 0) == 0;
}

void SetOption(int socket, int level, int option, int value) {
  // A failure is ignored: not all kinds of sockets support every option, and
  // the options only refine.
  setsockopt(socket, level, option, &value, sizeof(value));
}

// Opens a listening socket with the options that gRPC sets on its own.
int OpenListener(const sockaddr* address, socklen_t length) {
  const int listener =
      socket(address->sa_family, SOCK_STREAM | SOCK_NONBLOCK | SOCK_CLOEXEC, 0);
  if (listener < 0) return -1;
  // A server that starts anew need not wait for old connections to be
  // forgotten. Not SO_REUSEPORT: a second server could take half of the calls.
  SetOption(listener, SOL_SOCKET, SO_REUSEADDR, 1);
  if (address->sa_family == AF_INET6) {
    SetOption(listener, IPPROTO_IPV6, IPV6_V6ONLY, 0);
  }
  if (bind(listener, address, length) == 0 && listen(listener, kBacklog) == 0) {
    return listener;
  }
  const int error = errno;
  close(listener);
  errno = error;
  return -1;
}

// Device and inode; nothing if there is no socket at the path.
std::optional<std::pair<dev_t, ino_t>> FileOfSocket(const std::string& path) {
  struct stat file {};
  if (stat(path.c_str(), &file) != 0 || !S_ISSOCK(file.st_mode)) {
    return std::nullopt;
  }
  return std::make_pair(file.st_dev, file.st_ino);
}

// Whether a program listens at the address. Only a refused connection shows
// that none does: any other failure, such as a full queue, means that one does.
bool IsListenedAt(const sockaddr* address, socklen_t length) {
  const int probe =
      socket(address->sa_family, SOCK_STREAM | SOCK_NONBLOCK | SOCK_CLOEXEC, 0);
  if (probe < 0) return true;
  const bool refused =
      connect(probe, address, length) != 0 && errno == ECONNREFUSED;
  close(probe);
  return !refused;
}

std::uint16_t PortOf(int listener) {
  sockaddr_storage address{};
  socklen_t length = sizeof(address);
  getsockname(listener, reinterpret_cast<sockaddr*>(&address), &length);
  return ntohs(address.ss_family == AF_INET6
                   ? reinterpret_cast<sockaddr_in6*>(&address)->sin6_port
                   : reinterpret_cast<sockaddr_in*>(&address)->sin_port);
}

void SetPort(std::uint16_t port, sockaddr* address) {
  if (address->sa_family == AF_INET6) {
    reinterpret_cast<sockaddr_in6*>(address)->sin6_port = htons(port);
  } else {
    reinterpret_cast<sockaddr_in*>(address)->sin_port = htons(port);
  }
}

// The port of the other end; 0 where host and port do not identify it.
int PeerPort(const sockaddr_storage& peer) {
  if (peer.ss_family == AF_INET) {
    return ntohs(reinterpret_cast<const sockaddr_in*>(&peer)->sin_port);
  }
  if (peer.ss_family != AF_INET6) return 0;
  const auto* address = reinterpret_cast<const sockaddr_in6*>(&peer);
  return address->sin6_scope_id == 0 ? ntohs(address->sin6_port) : 0;
}

// The host without the port; all local programs are one peer.
std::string PeerText(const sockaddr_storage& peer) {
  char text[INET6_ADDRSTRLEN] = "local";
  if (peer.ss_family == AF_INET) {
    inet_ntop(AF_INET, &reinterpret_cast<const sockaddr_in*>(&peer)->sin_addr,
              text, sizeof(text));
  } else if (peer.ss_family == AF_INET6) {
    const in6_addr& address =
        reinterpret_cast<const sockaddr_in6*>(&peer)->sin6_addr;
    if (IN6_IS_ADDR_V4MAPPED(&address)) {
      inet_ntop(AF_INET, address.s6_addr + 12, text, sizeof(text));
    } else {
      inet_ntop(AF_INET6, &address, text, sizeof(text));
    }
  }
  return text;
}

// Descriptors are given out lowest first, so one from here on means that as
// many are open.
int DescriptorLimit() {
  rlimit limit{};
  if (getrlimit(RLIMIT_NOFILE, &limit) != 0 ||
      limit.rlim_cur == RLIM_INFINITY) {
    return std::numeric_limits<int>::max();
  }
  return static_cast<int>(std::min<rlim_t>(limit.rlim_cur / 4 * 3,
                                           std::numeric_limits<int>::max()));
}

int OpenReserve() { return open("/dev/null", O_RDONLY | O_CLOEXEC); }

// Closes the connection by a reset, so that a flooder leaves no state behind in
// the kernel.
void Reset(int connection) {
  const linger at_once{1, 0};
  setsockopt(connection, SOL_SOCKET, SO_LINGER, &at_once, sizeof(at_once));
  close(connection);
}

}  // namespace

ConnectionAcceptor::ConnectionAcceptor(const Options& options, const Log* log,
                                       ConnectionMeters* meters)
    : options_(options),
      log_(log),
      address_(options.address),
      watch_(options.bounds, options.content, log, meters, &refusals_) {}

absl::StatusOr<std::unique_ptr<ConnectionAcceptor>> ConnectionAcceptor::Listen(
    const Options& options, const Log* log, ConnectionMeters* meters) {
  std::unique_ptr<ConnectionAcceptor> acceptor(
      new ConnectionAcceptor(options, log, meters));
  if (absl::Status status = acceptor->Open(); !status.ok()) return status;
  return acceptor;
}

ConnectionAcceptor::~ConnectionAcceptor() { Stop(); }

absl::Status ConnectionAcceptor::Open() {
  wake_ = eventfd(0, EFD_NONBLOCK | EFD_CLOEXEC);
  reserve_ = OpenReserve();
  if (wake_ < 0 || reserve_ < 0) return CannotListen(address_, ErrnoText());
  return HasPrefix(address_, "unix") ? OpenUnix() : OpenInternet();
}

absl::Status ConnectionAcceptor::OpenInternet() {
  const absl::StatusOr<ListenAddress> address = ParseListenAddress(address_);
  if (!address.ok()) return address.status();
  addrinfo hints{};
  hints.ai_socktype = SOCK_STREAM;
  hints.ai_flags = AI_PASSIVE | AI_NUMERICSERV;
  addrinfo* found = nullptr;
  const int error =
      getaddrinfo(address->host.c_str(), address->port.c_str(), &hints, &found);
  if (error != 0) return CannotListen(address_, gai_strerror(error));
  const std::unique_ptr<addrinfo, decltype(&freeaddrinfo)> owner(found,
                                                                 freeaddrinfo);
  std::uint16_t chosen = 0;
  std::string failure = "no such address";
  for (addrinfo* one = found; one != nullptr; one = one->ai_next) {
    if (one->ai_family != AF_INET && one->ai_family != AF_INET6) continue;
    if (chosen != 0) SetPort(chosen, one->ai_addr);
    const int listener = OpenListener(one->ai_addr, one->ai_addrlen);
    if (listener < 0) {
      failure = ErrnoText();
      // Callers would reach this server by one address of a name and another
      // program by the other.
      if (errno == EADDRINUSE) return CannotListen(address_, failure);
      continue;
    }
    listeners_.push_back(listener);
    chosen = PortOf(listener);
  }
  if (listeners_.empty()) return CannotListen(address_, failure);
  address_.resize(address_.size() - address->port.size());
  address_ += std::to_string(chosen);
  return absl::OkStatus();
}

absl::Status ConnectionAcceptor::OpenUnix() {
  sockaddr_un address{};
  address.sun_family = AF_UNIX;
  const bool abstract = HasPrefix(address_, kAbstractPrefix);
  const std::string path =
      address_.substr(std::strlen(abstract ? kAbstractPrefix : kUnixPrefix));
  // An abstract name begins behind a zero byte, a path ends with one.
  if (path.empty() || path.size() + 1 > sizeof(address.sun_path)) {
    return CannotListen(
        address_, "a path has 1 to " +
                      std::to_string(sizeof(address.sun_path) - 1) + " bytes");
  }
  std::memcpy(address.sun_path + (abstract ? 1 : 0), path.data(), path.size());
  const auto length =
      static_cast<socklen_t>(offsetof(sockaddr_un, sun_path) + path.size() + 1);
  const auto* const name = reinterpret_cast<const sockaddr*>(&address);
  if (!abstract && FileOfSocket(path)) {
    if (IsListenedAt(name, length)) {
      return CannotListen(address_, "another program listens at it");
    }
    // A server that was killed has left it behind.
    unlink(path.c_str());
  }
  const int listener = OpenListener(name, length);
  if (listener < 0) return CannotListen(address_, ErrnoText());
  listeners_.push_back(listener);
  if (!abstract) {
    socket_path_ = path;
    socket_file_ = FileOfSocket(path);
  }
  return absl::OkStatus();
}

void ConnectionAcceptor::Register(
    std::shared_ptr<grpc::ServerCredentials> credentials,
    grpc::ServerBuilder* builder) {
  using Type = grpc::ServerBuilder::experimental_type::ExternalConnectionType;
  grpc_ = builder->experimental().AddExternalConnectionAcceptor(
      Type::FROM_FD, std::move(credentials));
}

void ConnectionAcceptor::Start() {
  watch_.Start();
  thread_ = std::thread([this] { Run(); });
}

void ConnectionAcceptor::Stop() {
  if (thread_.joinable()) {
    eventfd_write(wake_, 1);
    thread_.join();
  }
  watch_.Stop();
  for (const int listener : listeners_) close(listener);
  listeners_.clear();
  // Another server may have put its own in this place.
  if (socket_file_ && FileOfSocket(socket_path_) == socket_file_) {
    unlink(socket_path_.c_str());
  }
  socket_file_.reset();
  for (int* descriptor : {&wake_, &reserve_}) {
    if (*descriptor >= 0) close(std::exchange(*descriptor, -1));
  }
}

void ConnectionAcceptor::Run() {
  std::vector<pollfd> polled;
  for (const int listener : listeners_) polled.push_back({listener, POLLIN, 0});
  const std::size_t listeners = polled.size();
  polled.push_back({wake_, POLLIN, 0});
  const pollfd& end = polled[listeners];
  while (true) {
    const int ready = poll(polled.data(), polled.size(), /*timeout=*/-1);
    if (ready > 0 && end.revents != 0) return;
    if (ready <= 0) continue;
    for (std::size_t i = 0; i < listeners; ++i) {
      if (polled[i].revents != 0) AcceptSome(polled[i].fd);
    }
  }
}

void ConnectionAcceptor::AcceptSome(int listener) {
  for (int i = 0; i < kAcceptsPerRound; ++i) {
    const int connection =
        watch_.Accept(listener, SOCK_NONBLOCK | SOCK_CLOEXEC);
    if (connection >= 0) {
      HandOn(listener, connection);
      continue;
    }
    switch (errno) {
      case EAGAIN:
        return;
      case EMFILE:
      case ENFILE:
        TurnAway(listener);
        return;
      case EINTR:
      case ECONNABORTED:
        continue;
      default:
        // A fault of the network, or of a filter in front of it.
        poll(nullptr, 0, kPauseMilliseconds);
        return;
    }
  }
}

void ConnectionAcceptor::HandOn(int listener, int connection) {
  sockaddr_storage address{};
  socklen_t length = sizeof(address);
  if (getpeername(connection, reinterpret_cast<sockaddr*>(&address), &length) !=
      0) {
    close(connection);
    return;
  }
  const std::string peer = PeerText(address);
  if (connection >= DescriptorLimit()) {
    Shed(connection, "descriptors", peer);
    return;
  }
  if (const char* why = watch_.Add(connection, peer, PeerPort(address))) {
    Shed(connection, why, peer);
    return;
  }
  SetOption(connection, IPPROTO_TCP, TCP_NODELAY, 1);
  SetOption(connection, IPPROTO_TCP, TCP_USER_TIMEOUT,
            static_cast<int>(options_.unacknowledged_timeout.count()));
  grpc::experimental::ExternalConnectionAcceptor::NewConnectionParameters
      parameters;
  parameters.listener_fd = listener;
  parameters.fd = connection;
  ++accepted_;
  const TlsBeginsHere tls(connection);
  grpc_->HandleNewConnection(&parameters);
}

void ConnectionAcceptor::Shed(int connection, const char* why,
                              const std::string& peer) {
  Reset(connection);
  ++shed_;
  refusals_.Count(why);
  ++shed_unsaid_;
  const auto now = std::chrono::steady_clock::now();
  if (now - last_said_ < kLogInterval) return;
  last_said_ = now;
  log_->Write(LogLevel::kWarning, "connections_shed",
              {{"limit", std::string(why)},
               {"peer", peer},
               {"count", shed_unsaid_},
               {"in_all", shed_}});
  shed_unsaid_ = 0;
}

void ConnectionAcceptor::TurnAway(int listener) {
  if (reserve_ >= 0) close(reserve_);
  const int connection = watch_.Accept(listener, SOCK_CLOEXEC);
  if (connection >= 0) Shed(connection, "descriptors", "");
  reserve_ = OpenReserve();
  // Something else in the process holds all descriptors: give it time.
  poll(nullptr, 0, kPauseMilliseconds);
}

void ConnectionAcceptor::CollectMetrics(Metrics* metrics) const {
  refusals_.CollectMetrics(metrics);
  metrics
      ->Counter("revisit_connections_accepted_total",
                "Connections that were let in.")
      .Add(accepted_.load());
}

}  // namespace revisit::server
