// Where calls come in: the listening sockets, and gRPC's server behind them
// with the bounds that the settings give it.
#ifndef REVISIT_SERVER_CONNECTIONS_LISTENER_H_
#define REVISIT_SERVER_CONNECTIONS_LISTENER_H_

#include <chrono>
#include <memory>
#include <string>
#include <vector>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "grpcpp/impl/service_type.h"
#include "grpcpp/security/server_credentials.h"
#include "grpcpp/server.h"
#include "server/base/logging.h"
#include "server/connections/connection_acceptor.h"
#include "server/connections/connection_meter.h"
#include "server/security/tls_files.h"
#include "server/settings/limits.h"
#include "server/settings/settings.h"

namespace revisit::server {

class Metrics;

// Bounds of one connection: what it may hold and do (connection_meter.h).
MeterBounds MeterBoundsOf(const Limits& limits);

// Order of life: Listen(), Start(), Accept(), StopAccepting(), End().
class Listener {
 public:
  // Listens at ServerSettings::listen. `tls_files` is null if the settings ask
  // for plaintext. It, log and meters must outlive this. Errors are those of
  // ConnectionAcceptor::Listen().
  static absl::StatusOr<std::unique_ptr<Listener>> Listen(
      const ServerSettings& settings, const TlsFiles* tls_files, const Log* log,
      ConnectionMeters* meters);
  // Ends at once what has not ended.
  ~Listener();

  Listener(const Listener&) = delete;
  Listener& operator=(const Listener&) = delete;

  // Starts gRPC's server with these services, which must outlive this. No call
  // comes yet. UNAVAILABLE if it does not start.
  absl::Status Start(const std::vector<grpc::Service*>& services);
  void Accept();
  // Takes no connection any more; calls go on.
  void StopAccepting();
  // Cuts the calls that are left at the deadline, and waits until all are gone.
  void End(std::chrono::system_clock::time_point deadline);

  // The address with the port that was chosen.
  const std::string& address() const { return acceptor_->address(); }
  // REQUIRES: it is between Start() and the end of this.
  grpc::Server* server() const { return server_.get(); }

  void CollectMetrics(Metrics* metrics) const {
    acceptor_->CollectMetrics(metrics);
  }

 private:
  Listener(const ServerSettings& settings, const TlsFiles* tls_files,
           std::unique_ptr<ConnectionAcceptor> acceptor);

  const ServerSettings settings_;
  const std::unique_ptr<ConnectionAcceptor> acceptor_;
  const std::shared_ptr<grpc::ServerCredentials> credentials_;
  std::unique_ptr<grpc::Server> server_;
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_CONNECTIONS_LISTENER_H_
