// Takes connections and hands them to gRPC.
//
// gRPC's own listener, as Debian 12 has it (1.51), stops listening for good the
// first time that accept() finds no free descriptor: a flood of connections
// ends the service of a process that looks healthy. So the server accepts by
// itself, sheds connections beyond its bounds by closing them at once, and can
// therefore serve the next caller as soon as there is room.
//
// Who cuts whom, in this folder:
//   ConnectionAcceptor  resets a new connection that is one too many.
//   ConnectionWatch     looks at those that are open, on a thread of its own:
//                       shuts down those that the table names, logs these and
//                       those that metered reads have ended, and has those
//                       read again that waited and may go on.
//   ConnectionTable     judges and does not cut: too many connections, in all
//                       or from one address; bounds that a meter has passed;
//                       too much memory held, and too many connections, of
//                       strangers. It shares processor time among strangers.
//   ConnectionMeter     counts the bytes, calls and headers of one connection
//                       against its progress, which the calls report
//                       (service/call.h), and says when it has to wait.
//   metered_reads.h     feeds the meters, holds up a connection that has to
//                       wait, and ends one at its next read once its meter has
//                       passed a bound: at once, because much may come before
//                       the next look.
//   TransportCalls      counts the calls that gRPC holds for a connection.
//   Admission           refuses calls, searches and batches and cuts nothing:
//                       it knows callers and vehicles, not connections.
//   Drain               ends calls, and only when the server stops.
//   gRPC                closes connections that do not open as gRPC does, have
//                       no calls or do not answer its pings, by the times in
//                       limits.h. The memory that all connections hold is
//                       bounded by its quota (max-transport-bytes); nothing
//                       counts what one connection holds but for its calls.
#ifndef REVISIT_SERVER_CONNECTIONS_CONNECTION_ACCEPTOR_H_
#define REVISIT_SERVER_CONNECTIONS_CONNECTION_ACCEPTOR_H_

#include <sys/types.h>

#include <atomic>
#include <chrono>
#include <cstdint>
#include <memory>
#include <optional>
#include <string>
#include <thread>
#include <utility>
#include <vector>

#include "absl/status/statusor.h"
#include "grpcpp/security/server_credentials.h"
#include "grpcpp/server_builder.h"
#include "server/base/logging.h"
#include "server/connections/connection_meter.h"
#include "server/connections/connection_table.h"
#include "server/connections/connection_watch.h"
#include "server/connections/metered_reads.h"
#include "server/connections/refusals.h"

namespace revisit::server {

// Order of life: Listen(), Register() with the builder, Start() once gRPC's
// server runs, Stop() before it is shut down.
class ConnectionAcceptor {
 public:
  struct Options {
    // HOST:PORT, [V6]:PORT, unix:PATH or unix-abstract:NAME. Port 0 takes a
    // free one, the same on all addresses of the host.
    std::string address;
    WireContent content = WireContent::kHttp2;
    ConnectionTable::Bounds bounds;
    // A connection ends if the other side has not acknowledged bytes that were
    // sent this long ago (TCP_USER_TIMEOUT).
    std::chrono::milliseconds unacknowledged_timeout{20000};
  };

  // UNAVAILABLE with the reason if the address cannot be listened on. Log and
  // meters must outlive this.
  static absl::StatusOr<std::unique_ptr<ConnectionAcceptor>> Listen(
      const Options& options, const Log* log, ConnectionMeters* meters);
  // Stops.
  ~ConnectionAcceptor();

  ConnectionAcceptor(const ConnectionAcceptor&) = delete;
  ConnectionAcceptor& operator=(const ConnectionAcceptor&) = delete;

  // Every connection will use these credentials.
  void Register(std::shared_ptr<grpc::ServerCredentials> credentials,
                grpc::ServerBuilder* builder);
  void Start();
  // Closes the listening sockets. Connections that were handed on stay open.
  void Stop();

  // The address with the port that was chosen.
  const std::string& address() const { return address_; }

  // How many connections were handed to gRPC, and how often each limit has
  // closed one, because there were too many or because it was harmful.
  void CollectMetrics(Metrics* metrics) const;

 private:
  ConnectionAcceptor(const Options& options, const Log* log,
                     ConnectionMeters* meters);

  absl::Status Open();
  absl::Status OpenInternet();
  absl::Status OpenUnix();
  void Run();
  // Accepts connections from a listening socket, but only so many at a time
  // that the thread can attend to its other work.
  void AcceptSome(int listener);
  void HandOn(int listener, int connection);
  void Shed(int connection, const char* why, const std::string& peer);
  // After accept() failed for want of a descriptor: frees the reserve to accept
  // one connection and close it.
  void TurnAway(int listener);

  const Options options_;
  const Log* const log_;
  std::string address_;
  // File of a unix socket, removed at the end if it is still the one that was
  // made.
  std::string socket_path_;
  std::optional<std::pair<dev_t, ino_t>> socket_file_;
  std::vector<int> listeners_;
  // An eventfd that asks the thread to stop.
  int wake_ = -1;
  // A descriptor that is kept to be given up in TurnAway().
  int reserve_ = -1;
  std::unique_ptr<grpc::experimental::ExternalConnectionAcceptor> grpc_;
  Refusals refusals_;
  std::atomic<std::int64_t> accepted_{0};

  ConnectionWatch watch_;

  // Used by the thread only.
  std::int64_t shed_ = 0;
  std::int64_t shed_unsaid_ = 0;
  std::chrono::steady_clock::time_point last_said_{};

  std::thread thread_;
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_CONNECTIONS_CONNECTION_ACCEPTOR_H_
