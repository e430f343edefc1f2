#include "server/server.h"

#include <grpc/impl/codegen/grpc_types.h>
#include <grpc/support/log.h>
#include <grpcpp/ext/proto_server_reflection_plugin.h>
#include <grpcpp/grpcpp.h>
#include <grpcpp/health_check_service_interface.h>
#include <grpcpp/impl/server_builder_option.h>
#include <grpcpp/impl/server_builder_plugin.h>
#include <malloc.h>

#include <algorithm>
#include <atomic>
#include <chrono>
#include <cstdio>
#include <filesystem>
#include <fstream>
#include <optional>
#include <system_error>
#include <thread>
#include <utility>
#include <vector>

#include "server/drain.h"
#include "server/periodic.h"
#include "server/pose_graph_service.h"
#include "server/proto_conversion.h"
#include "server/security/gatekeeper.h"
#include "server/security/server_credentials.h"
#include "server/security/tls_files.h"
#include "server/sessions/executor.h"
#include "server/sessions/fleet.h"
#include "server/storage/sqlite_storage.h"

namespace revisit::server {
namespace {

constexpr char kStoreFile[] = "revisit.sqlite";
// Of vehicles that send few poses a batch, as many as others send at once.
constexpr std::size_t kRowPoses = 64;
// For connections to be closed in an orderly way.
constexpr std::chrono::milliseconds kGoodbyeTime{100};

std::chrono::milliseconds Milliseconds(double seconds) {
  return std::chrono::milliseconds(static_cast<std::int64_t>(seconds * 1000.0));
}

// The store's file, in its directory, which is made if it is not there.
absl::StatusOr<std::string> StoreFile(const std::string& path) {
  std::error_code error;
  if (std::filesystem::is_regular_file(path, error)) return path;
  std::filesystem::create_directories(path, error);
  if (error) {
    return absl::UnavailableError(
        ("cannot create the directory " + path + ": " + error.message())
            .c_str());
  }
  return (std::filesystem::path(path) / kStoreFile).string();
}

// Unloaded bytes that are worth giving back to the system: the C library keeps
// what is freed, and to hand it over takes it some milliseconds per 100 MB.
constexpr std::int64_t kWorthTrimming = std::int64_t{8} << 20;

// A vehicle stays at most a tenth longer than promised, and memory at most a
// second above the budget.
std::chrono::milliseconds UnloadPeriod(const Fleet::Options& options) {
  return std::clamp<std::chrono::milliseconds>(
      options.idle_unload / 10, std::chrono::milliseconds(100),
      std::chrono::seconds(options.memory_budget_bytes ? 1 : 30));
}

// The address with the port that was chosen for port 0.
std::string WithPort(const std::string& listen, int port) {
  const std::size_t colon = listen.rfind(':');
  if (listen.rfind("unix", 0) == 0 || colon == std::string::npos) return listen;
  return listen.substr(0, colon + 1) + std::to_string(port);
}

// Whole or not at all, for a script may be waiting for it.
bool WritePortFile(const std::string& path, const std::string& address) {
  const std::string temporary = path + ".new";
  std::ofstream file(temporary);
  file << address << "\n";
  file.close();
  return !file.fail() && std::rename(temporary.c_str(), path.c_str()) == 0;
}

// Gives the lines of gRPC's own log the form of ours, as long as it lives. gRPC
// knows one place for the whole process.
class GrpcLogRoute {
 public:
  explicit GrpcLogRoute(const Log* log) {
    destination_ = log;
    gpr_set_log_function(Write);
  }
  ~GrpcLogRoute() { destination_ = nullptr; }

  GrpcLogRoute(const GrpcLogRoute&) = delete;
  GrpcLogRoute& operator=(const GrpcLogRoute&) = delete;

 private:
  static void Write(gpr_log_func_args* line) {
    const Log* const log = destination_;
    if (log == nullptr) return;
    const LogLevel level =
        line->severity == GPR_LOG_SEVERITY_ERROR  ? LogLevel::kError
        : line->severity == GPR_LOG_SEVERITY_INFO ? LogLevel::kInfo
                                                  : LogLevel::kDebug;
    log->Write(level, "grpc", {{"message", std::string(line->message)}});
  }

  static std::atomic<const Log*> destination_;
};

std::atomic<const Log*> GrpcLogRoute::destination_{nullptr};

}  // namespace

// Destroyed from the last member to the first. The fleet waits for its work,
// which needs executor, codec and storage.
struct RevisitServer::State {
  ServerSettings settings;
  const Log* log = nullptr;
  std::optional<GrpcLogRoute> grpc_log;
  ProtoRecordCodec codec;
  std::unique_ptr<Storage> storage;
  std::unique_ptr<Executor> executor;
  std::unique_ptr<Executor> search_executor;
  std::unique_ptr<Fleet> fleet;
  std::unique_ptr<Periodic> unload_timer;
  Drain drain;
  std::unique_ptr<Gatekeeper> gatekeeper;
  // Null if the listener speaks plaintext.
  std::unique_ptr<TlsFiles> tls_files;
  std::unique_ptr<Periodic> tls_timer;
  std::shared_ptr<grpc::ServerCredentials> credentials;
  std::unique_ptr<PoseGraphService> service;
  std::unique_ptr<grpc::Server> grpc_server;
  std::string address;
};

namespace {

absl::StatusOr<std::unique_ptr<Gatekeeper>> MakeGatekeeper(
    const ServerSettings& settings, const Log* log) {
  if (settings.policy.empty()) return MakeOpenGatekeeper();
  GatekeeperSettings gatekeeper;
  gatekeeper.policy_file = settings.policy;
  gatekeeper.token_keys_file = settings.token_keys;
  gatekeeper.token_rules = {
      settings.token_issuer, settings.token_audience,
      std::chrono::seconds(settings.token_leeway_seconds)};
  gatekeeper.takes_certificates = !settings.tls_client_ca.empty();
  gatekeeper.check_period = Milliseconds(settings.security_check_seconds);
  return StartGatekeeper(gatekeeper, log);
}

// Null if the listener is to speak plaintext.
absl::StatusOr<std::unique_ptr<TlsFiles>> LoadTlsFiles(
    const ServerSettings& settings, const Log* log) {
  if (settings.tls_cert.empty()) return std::unique_ptr<TlsFiles>();
  return TlsFiles::Load(
      {settings.tls_key, settings.tls_cert, settings.tls_client_ca}, log,
      std::chrono::system_clock::now());
}

std::shared_ptr<grpc::ServerCredentials> ListenerCredentials(
    const ServerSettings& settings, const TlsFiles* files) {
  if (files == nullptr) return grpc::InsecureServerCredentials();
  return MakeTlsServerCredentials(files, settings.tls_client_ca.empty()
                                             ? ClientCertificates::kDoNotAsk
                                             : settings.tls_client_certs);
}

// Reflection is a plugin that adds itself to every builder as soon as its
// library is loaded.
class WithoutReflection final : public grpc::ServerBuilderOption {
 public:
  void UpdateArguments(grpc::ChannelArguments*) override {}
  void UpdatePlugins(std::vector<std::unique_ptr<grpc::ServerBuilderPlugin>>*
                         plugins) override {
    plugins->erase(std::remove_if(plugins->begin(), plugins->end(),
                                  [](const auto& plugin) {
                                    return plugin->name() ==
                                           "proto_server_reflection";
                                  }),
                   plugins->end());
  }
};

void Configure(const ServerSettings& settings, grpc::ServerBuilder* builder) {
  builder->SetMaxReceiveMessageSize(
      static_cast<int>(settings.max_message_bytes));
  // Else a second server could take half of the calls of this one's port.
  builder->AddChannelArgument(GRPC_ARG_ALLOW_REUSEPORT, 0);
  builder->AddChannelArgument(GRPC_ARG_MAX_CONCURRENT_STREAMS,
                              settings.max_concurrent_streams);
  builder->AddChannelArgument(
      GRPC_ARG_KEEPALIVE_TIME_MS,
      static_cast<int>(Milliseconds(settings.keepalive_seconds).count()));
  builder->AddChannelArgument(
      GRPC_ARG_KEEPALIVE_TIMEOUT_MS,
      static_cast<int>(
          Milliseconds(settings.keepalive_timeout_seconds).count()));
  // Vehicles behind mobile networks ping to keep their way through open.
  builder->AddChannelArgument(GRPC_ARG_KEEPALIVE_PERMIT_WITHOUT_CALLS, 1);
  builder->AddChannelArgument(
      GRPC_ARG_HTTP2_MIN_RECV_PING_INTERVAL_WITHOUT_DATA_MS, 10000);
}

ServiceLimits Limits(const ServerSettings& settings) {
  return {
      settings.max_message_bytes, settings.max_batch_poses,
      // A stream alone must not exceed what one vehicle may have waiting.
      std::min(settings.max_batches_in_flight, settings.max_pending_appends),
      settings.max_bytes_in_flight, settings.max_revision_bytes};
}

}  // namespace

RevisitServer::RevisitServer(std::unique_ptr<State> state)
    : state_(std::move(state)) {}

RevisitServer::~RevisitServer() { Shutdown(); }

std::unique_ptr<RevisitServer> RevisitServer::Start(
    const ServerSettings& settings, const Log* log, StartError* error) {
  auto state = std::make_unique<State>();
  state->settings = settings;
  state->log = log;
  state->grpc_log.emplace(log);

  // First: they are settings, and a wrong one leaves no trace.
  auto gatekeeper = MakeGatekeeper(settings, log);
  auto tls_files = LoadTlsFiles(settings, log);
  for (const absl::Status& status : {gatekeeper.status(), tls_files.status()}) {
    if (status.ok()) continue;
    *error = {kExitUsage, std::string(status.message())};
    return nullptr;
  }
  state->gatekeeper = *std::move(gatekeeper);
  state->tls_files = *std::move(tls_files);
  if (state->tls_files != nullptr) {
    state->tls_timer = std::make_unique<Periodic>(
        Milliseconds(settings.security_check_seconds),
        [files = state->tls_files.get()] {
          files->Look(std::chrono::system_clock::now());
        });
  }

  SqliteOptions storage_options;
  storage_options.max_joined_poses = kRowPoses;
  storage_options.latency_target = std::chrono::microseconds(
      static_cast<std::int64_t>(settings.ack_latency_target_ms * 1000.0));
  const absl::StatusOr<std::string> file = StoreFile(settings.store);
  absl::StatusOr<std::unique_ptr<Storage>> storage =
      file.ok() ? OpenSqliteStorage(*file, storage_options) : file.status();
  if (!storage.ok()) {
    *error = {absl::IsFailedPrecondition(storage.status()) ? kExitStoreInUse
                                                           : kExitStoreFailed,
              std::string(storage.status().message())};
    return nullptr;
  }
  state->storage = *std::move(storage);

  const int processors =
      static_cast<int>(std::max(1u, std::thread::hardware_concurrency()));
  state->executor = std::make_unique<Executor>(
      "vehicles",
      settings.worker_threads > 0 ? settings.worker_threads : processors);
  // With one alone, every vehicle that is loaded waits for every search.
  state->search_executor = std::make_unique<Executor>(
      "searches", settings.search_threads > 0 ? settings.search_threads
                                              : std::max(2, processors));
  Fleet::Options options;
  options.idle_unload = Milliseconds(settings.idle_unload_minutes * 60.0);
  if (settings.memory_budget_mebibytes > 0) {
    options.memory_budget_bytes = settings.memory_budget_mebibytes << 20;
  }
  options.session.max_pending_appends = settings.max_pending_appends;
  state->fleet = std::make_unique<Fleet>(
      state->storage.get(), &state->codec,
      Lanes(state->executor.get(), state->search_executor.get()), options);
  state->unload_timer = std::make_unique<Periodic>(
      UnloadPeriod(options),
      [fleet = state->fleet.get(), untrimmed = std::int64_t{0}]() mutable {
        untrimmed += fleet->UnloadIdle(std::chrono::steady_clock::now()).bytes;
        if (untrimmed >= kWorthTrimming) {
          malloc_trim(0);
          untrimmed = 0;
        }
      });

  ServiceContext context;
  context.storage = state->storage.get();
  context.executor = state->search_executor.get();
  context.fleet = state->fleet.get();
  context.drain = &state->drain;
  context.gatekeeper = state->gatekeeper.get();
  context.log = log;
  context.limits = Limits(settings);
  state->service = std::make_unique<PoseGraphService>(context);

  grpc::EnableDefaultHealthCheckService(settings.serve_health);
  // By name, since a linker drops a library that is used by its mere presence.
  grpc::reflection::InitProtoReflectionServerBuilderPlugin();
  grpc::ServerBuilder builder;
  if (!settings.serve_reflection) {
    builder.SetOption(std::make_unique<WithoutReflection>());
  }
  Configure(settings, &builder);
  int port = 0;
  state->credentials = ListenerCredentials(settings, state->tls_files.get());
  builder.AddListeningPort(settings.listen, state->credentials, &port);
  builder.RegisterService(state->service.get());
  state->grpc_server = builder.BuildAndStart();
  if (state->grpc_server == nullptr) {
    *error = {kExitCannotListen, "cannot listen at " + settings.listen};
    return nullptr;
  }
  state->address = WithPort(settings.listen, port);
  if (auto* health = state->grpc_server->GetHealthCheckService()) {
    health->SetServingStatus(true);
    health->SetServingStatus(v1::PoseGraphService::service_full_name(), true);
  }
  if (!settings.port_file.empty() &&
      !WritePortFile(settings.port_file, state->address)) {
    *error = {kExitCannotListen, "cannot write " + settings.port_file};
    state->grpc_server->Shutdown();
    return nullptr;
  }
  if (const std::string risk = RiskOfListening(settings); !risk.empty()) {
    log->Write(LogLevel::kWarning, "listening_insecurely",
               {{"address", state->address}, {"message", risk}});
  }
  log->Write(LogLevel::kInfo, "serving",
             {{"address", state->address},
              {"store", *file},
              {"version", REVISIT_VERSION}});
  return std::unique_ptr<RevisitServer>(new RevisitServer(std::move(state)));
}

const std::string& RevisitServer::address() const { return state_->address; }

void RevisitServer::Shutdown() {
  if (state_->grpc_server == nullptr) return;
  const auto start = std::chrono::steady_clock::now();
  state_->log->Write(LogLevel::kInfo, "draining", {});
  if (auto* health = state_->grpc_server->GetHealthCheckService()) {
    health->SetServingStatus(false);
  }
  state_->drain.Start();
  state_->drain.WaitForCalls(
      start + Milliseconds(state_->settings.drain_timeout_seconds));
  // Cuts the calls that are left, and the connections that do not answer to
  // being closed.
  state_->grpc_server->Shutdown(std::chrono::system_clock::now() +
                                kGoodbyeTime);
  state_->grpc_server->Wait();
  state_->grpc_server.reset();
  // Its thread may hold the last of a stream, and with it a session.
  state_->gatekeeper.reset();
  state_->unload_timer.reset();
  state_->fleet.reset();
  state_->executor.reset();
  state_->search_executor.reset();
  const CommitCounts counts = state_->storage->Counts();
  state_->storage.reset();
  const std::chrono::duration<double, std::milli> duration =
      std::chrono::steady_clock::now() - start;
  state_->log->Write(LogLevel::kInfo, "stopped",
                     {{"duration_ms", duration.count()},
                      {"commits", static_cast<std::int64_t>(counts.commits)},
                      {"writes", static_cast<std::int64_t>(counts.writes)}});
}

}  // namespace revisit::server
