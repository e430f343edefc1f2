#include "server/connections/listener.h"

#include <grpc/impl/codegen/grpc_types.h>
#include <grpcpp/grpcpp.h>
#include <grpcpp/health_check_service_interface.h>

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <thread>
#include <utility>

#include "server/security/server_credentials.h"

namespace revisit::server {
namespace {

// Calls of a connection that may have ended and wait to be cleared away, 20 MB
// at most. Calls that ended well also take a moment to be cleared away.
constexpr std::int64_t kCallsToClear = 1000;
// Bytes, by estimate, that gRPC may hold for the calls of all connections
// together that have not had a call let in.
constexpr std::uint64_t kUnadmittedMemory = std::uint64_t{64} << 20;
// The part of the processors that such connections may take.
constexpr double kUnadmittedShare = 0.05;
// Most bytes of one read. What is read by TLS is known only after it was
// decrypted, so that is a record, with 1,800 calls at most.
constexpr int kMaxReadBytes = 64 << 10;
constexpr int kMaxTlsReadBytes = 16 << 10;

int WholeMilliseconds(double seconds) {
  return static_cast<int>(Milliseconds(seconds).count());
}

WireContent ContentOf(const ServerSettings& settings) {
  return settings.tls_cert.empty() ? WireContent::kHttp2 : WireContent::kTls;
}

std::shared_ptr<grpc::ServerCredentials> CredentialsOf(
    const ServerSettings& settings, const TlsFiles* files) {
  if (files == nullptr) return grpc::InsecureServerCredentials();
  return MakeTlsServerCredentials(files, settings.tls_client_ca.empty()
                                             ? ClientCertificates::kDoNotAsk
                                             : settings.tls_client_certs);
}

ConnectionAcceptor::Options AcceptorOptionsOf(const ServerSettings& settings) {
  const Limits& limits = settings.limits;
  ConnectionAcceptor::Options options;
  options.address = settings.listen;
  options.content = ContentOf(settings);
  options.bounds.max_connections = limits.max_connections;
  options.bounds.max_connections_per_address =
      limits.max_connections_per_address;
  options.bounds.max_unadmitted_connections = limits.max_unadmitted_connections;
  options.bounds.unadmitted_work =
      std::chrono::duration_cast<std::chrono::nanoseconds>(
          std::chrono::duration<double>(
              kUnadmittedShare *
              std::max(1U, std::thread::hardware_concurrency())));
  options.unacknowledged_timeout =
      Milliseconds(limits.keepalive_timeout_seconds);
  return options;
}

void BoundMessages(const Limits& limits, grpc::ServerBuilder* builder) {
  builder->SetMaxReceiveMessageSize(static_cast<int>(limits.max_message_bytes));
  // This version of gRPC inflates a message whole before it looks at its size:
  // a thousand times what came.
  for (const auto algorithm : {GRPC_COMPRESS_DEFLATE, GRPC_COMPRESS_GZIP}) {
    builder->SetCompressionAlgorithmSupportStatus(algorithm, false);
  }
  builder->AddChannelArgument(GRPC_ARG_MAX_METADATA_SIZE,
                              limits.max_metadata_bytes);
}

void BoundConnections(const Limits& limits, WireContent content,
                      grpc::ServerBuilder* builder) {
  grpc::ResourceQuota quota("connections");
  quota.Resize(static_cast<std::size_t>(limits.max_transport_bytes));
  builder->SetResourceQuota(quota);
  builder->AddChannelArgument(GRPC_ARG_MAX_CONCURRENT_STREAMS,
                              limits.max_concurrent_streams);
  // Windows keep their size. A window that gRPC's estimate of the bandwidth
  // makes smaller is below zero where a client has filled it, and this version
  // then resets a stream that its client ends by an empty frame, which is
  // allowed (RFC 9113, 6.9): the last poses were lost with it.
  builder->AddChannelArgument(GRPC_ARG_HTTP2_BDP_PROBE, 0);
  // Bytes that were read are handled even if the connection is cut meanwhile.
  builder->AddChannelArgument(
      GRPC_ARG_TCP_MAX_READ_CHUNK_SIZE,
      content == WireContent::kTls ? kMaxTlsReadBytes : kMaxReadBytes);
}

void SetTimes(const Limits& limits, grpc::ServerBuilder* builder) {
  // The handshake lasts until the client's settings have come.
  builder->AddChannelArgument(
      GRPC_ARG_SERVER_HANDSHAKE_TIMEOUT_MS,
      WholeMilliseconds(limits.handshake_timeout_seconds));
  builder->AddChannelArgument(
      GRPC_ARG_MAX_CONNECTION_IDLE_MS,
      WholeMilliseconds(limits.connection_idle_seconds));
  builder->AddChannelArgument(GRPC_ARG_KEEPALIVE_TIME_MS,
                              WholeMilliseconds(limits.keepalive_seconds));
  builder->AddChannelArgument(
      GRPC_ARG_KEEPALIVE_TIMEOUT_MS,
      WholeMilliseconds(limits.keepalive_timeout_seconds));
  // Vehicles behind mobile networks ping to keep their way through open.
  builder->AddChannelArgument(GRPC_ARG_KEEPALIVE_PERMIT_WITHOUT_CALLS, 1);
  builder->AddChannelArgument(
      GRPC_ARG_HTTP2_MIN_RECV_PING_INTERVAL_WITHOUT_DATA_MS, 10000);
}

}  // namespace

MeterBounds MeterBoundsOf(const Limits& limits) {
  MeterBounds bounds;
  bounds.max_idle_bytes = static_cast<std::uint64_t>(limits.max_idle_bytes);
  bounds.max_unadmitted_bytes =
      static_cast<std::uint64_t>(limits.max_unadmitted_bytes);
  bounds.credit_bytes = static_cast<std::uint64_t>(limits.max_message_bytes +
                                                   limits.max_metadata_bytes);
  bounds.max_held_calls =
      static_cast<std::uint64_t>(limits.max_concurrent_streams) + kCallsToClear;
  // Calls that were reset are among them.
  bounds.max_unadmitted_calls = static_cast<std::uint64_t>(
      std::max<std::int64_t>(limits.max_concurrent_streams, kCallsToClear));
  bounds.max_unadmitted_memory = kUnadmittedMemory;
  return bounds;
}

absl::StatusOr<std::unique_ptr<Listener>> Listener::Listen(
    const ServerSettings& settings, const TlsFiles* tls_files, const Log* log,
    ConnectionMeters* meters) {
  auto acceptor =
      ConnectionAcceptor::Listen(AcceptorOptionsOf(settings), log, meters);
  if (!acceptor.ok()) return acceptor.status();
  return std::unique_ptr<Listener>(
      new Listener(settings, tls_files, *std::move(acceptor)));
}

Listener::Listener(const ServerSettings& settings, const TlsFiles* tls_files,
                   std::unique_ptr<ConnectionAcceptor> acceptor)
    : settings_(settings),
      acceptor_(std::move(acceptor)),
      credentials_(CredentialsOf(settings, tls_files)) {}

Listener::~Listener() {
  StopAccepting();
  if (server_ != nullptr) End(std::chrono::system_clock::now());
}

absl::Status Listener::Start(const std::vector<grpc::Service*>& services) {
  grpc::EnableDefaultHealthCheckService(settings_.serve_health);
  grpc::ServerBuilder builder;
  BoundMessages(settings_.limits, &builder);
  BoundConnections(settings_.limits, ContentOf(settings_), &builder);
  SetTimes(settings_.limits, &builder);
  acceptor_->Register(credentials_, &builder);
  for (grpc::Service* const service : services) {
    builder.RegisterService(service);
  }
  server_ = builder.BuildAndStart();
  if (server_ != nullptr) return absl::OkStatus();
  return absl::UnavailableError("cannot start a server at " + settings_.listen);
}

void Listener::Accept() { acceptor_->Start(); }

void Listener::StopAccepting() { acceptor_->Stop(); }

void Listener::End(std::chrono::system_clock::time_point deadline) {
  server_->Shutdown(deadline);
  server_->Wait();
  server_.reset();
}

}  // namespace revisit::server
