#include "server/server.h"

#include <grpc/impl/codegen/grpc_types.h>
#include <grpcpp/grpcpp.h>
#include <grpcpp/health_check_service_interface.h>

#include <algorithm>
#include <atomic>
#include <chrono>
#include <cstdio>
#include <fstream>
#include <optional>
#include <string>
#include <system_error>
#include <thread>
#include <utility>
#include <vector>

#include "core/base/mutex.h"
#include "server/admin/http_server.h"
#include "server/admin/metrics_page.h"
#include "server/base/library_log.h"
#include "server/base/periodic.h"
#include "server/base/process_memory.h"
#include "server/connections/admission.h"
#include "server/connections/connection_acceptor.h"
#include "server/connections/drain.h"
#include "server/conversion/record_codec.h"
#include "server/open_store.h"
#include "server/security/gatekeeper.h"
#include "server/security/server_credentials.h"
#include "server/security/tls_files.h"
#include "server/self_check.h"
#include "server/service/graph_snapshots.h"
#include "server/service/pose_graph_service.h"
#include "server/service/reflection.h"
#include "server/sessions/executor.h"
#include "server/sessions/fair_executor.h"
#include "server/sessions/fleet.h"
#include "server/sessions/vehicle_census.h"
#include "server/storage/run_notes.h"
#include "server/storage/storage_metrics.h"
#include "server/store_health.h"
#include "server/telemetry/audit_log.h"
#include "server/telemetry/process_metrics.h"
#include "server/telemetry/service_counters.h"

namespace revisit::server {
namespace {

// Time for connections to be closed in an orderly way. Where calls were ended
// it is longer: a connection that the server cuts before its caller has read
// how a call ended takes that answer with it.
constexpr std::chrono::milliseconds kGoodbyeTime{100};
constexpr std::chrono::milliseconds kGoodbyeTimeAfterCalls{2000};
// Calls of a connection that may have ended and wait to be cleared away, 20 MB
// at most. Calls that ended well also take a moment to be cleared away.
constexpr std::int64_t kCallsToClear = 1000;
// Bytes, by estimate, that gRPC may hold for the calls of all connections
// together that have not had a call let in.
constexpr std::uint64_t kUnadmittedMemory = std::uint64_t{64} << 20;
// The part of the processors that such connections may take.
constexpr double kUnadmittedShare = 0.05;
// How long the server may leave its own question without an answer and count as
// alive: its threads are busy rather than stuck.
constexpr std::chrono::milliseconds kLivenessPatience{10'000};
// A busy storage writes a part of a snapshot, about a megabyte, that often.
constexpr std::chrono::milliseconds kSnapshotPeriod{500};
// A node of a snapshot takes about as many bytes as a stored pose, so up to
// here a snapshot is hardly larger than the poses that it stands for.
constexpr double kMostNodesPerPoseInDatabase = 1.25;

// How often rows of vehicles are read to count them, and how long after that
// all of a store that others change too are read again.
constexpr std::chrono::milliseconds kCensusPeriod{1000};
constexpr std::chrono::minutes kCensusAgain{10};

// How often memory is measured if no call does so.
constexpr std::chrono::milliseconds kMemoryPeriod{500};
// How often freed memory is given back to the system. Much of it is at once.
constexpr std::chrono::milliseconds kTrimPeriod{2000};

std::chrono::milliseconds Milliseconds(double seconds) {
  return std::chrono::milliseconds(static_cast<std::int64_t>(seconds * 1000.0));
}

// How often vehicles are unloaded. A vehicle stays at most a tenth longer than
// promised, and memory at most a second above the budget.
std::chrono::milliseconds UnloadPeriod(const Fleet::Options& options) {
  return std::clamp<std::chrono::milliseconds>(
      options.idle_unload / 10, std::chrono::milliseconds(100),
      std::chrono::seconds(options.memory_budget_bytes ? 1 : 30));
}

// Unloads vehicles that have been idle for long, or, if memory is short, all
// unused ones, and gives memory back to the system.
std::unique_ptr<Periodic> MakeUnloadTimer(Fleet* fleet, Admission* admission,
                                          const Fleet::Options& options) {
  using Clock = std::chrono::steady_clock;
  const auto period = UnloadPeriod(options);
  return std::make_unique<Periodic>(
      std::min(period, kMemoryPeriod),
      [=, idle_unload = options.idle_unload, next = Clock::now() + period,
       next_trim = Clock::now(), trimmer = Trimmer()]() mutable {
        const auto now = Clock::now();
        const bool pressed = admission->UnderMemoryPressure();
        const bool unloads = pressed || now >= next;
        if (unloads) {
          next = now + period;
          fleet->UnloadIdle(pressed ? now + idle_unload : now);
        }
        if (pressed) {
          trimmer.Trim();
        } else if (unloads || now >= next_trim) {
          next_trim = now + kTrimPeriod;
          trimmer.TrimIfWorthwhile();
        } else {
          trimmer.TrimIfMuch();
        }
      });
}

// Writes the file whole or not at all, because a script may be waiting for it.
bool WritePortFile(const std::string& path, const std::string& address) {
  const std::string temporary = path + ".new";
  std::ofstream file(temporary);
  file << address << "\n";
  file.close();
  return !file.fail() && std::rename(temporary.c_str(), path.c_str()) == 0;
}

}  // namespace

// Members are destroyed from the last to the first. The fleet waits for its
// work, which needs executor, codec and storage.
struct RevisitServer::State {
  // The steps of a start, in this order. Those that may fail return whether
  // they did not, and otherwise set `*error`.
  bool LoadIdentities(StartError* error);
  bool OpenAuditLog(StartError* error);
  bool ServeAdmin(StartError* error);
  bool OpenStore(StartError* error);
  void StartFleet();
  void StartService();
  bool Listen(StartError* error);
  bool Announce(StartError* error);

  void StartSelfChecks();
  void EndSelfChecks();

  // Health says NOT_SERVING from now on.
  void EndHealth();

  // Answers the admin port, on its own thread.
  HttpResponse AnswerAdmin(const std::string& path) const;
  HttpResponse Liveness() const;
  HttpResponse Readiness() const;
  // REQUIRES: the phase is kServing or kDraining.
  void CollectMetrics(Metrics* metrics) const;

  // Until it serves, members are made, and after it drains, destroyed; the
  // admin port is served before and is gone then.
  enum class Phase { kStarting, kServing, kDraining };

  ServerSettings settings;
  const Log* log = nullptr;
  std::optional<LibraryLogRoute> library_log;
  ProtoRecordCodec codec;
  std::string store_name;
  std::optional<RunNotes> run_notes;
  std::string scratch_directory;
  std::unique_ptr<Storage> storage;
  ServiceCounters counts;
  // Null if none is kept.
  std::unique_ptr<AuditLog> audit;
  std::unique_ptr<Executor> executor;
  std::unique_ptr<Executor> read_executor;
  std::unique_ptr<FairExecutor> search_executor;
  std::shared_ptr<VehicleCensus> census;
  std::unique_ptr<Fleet> fleet;
  std::unique_ptr<ConnectionMeters> meters;
  std::unique_ptr<Admission> admission;
  GraphSnapshots snapshots;
  std::unique_ptr<Periodic> unload_timer;
  std::unique_ptr<Periodic> snapshot_timer;
  std::unique_ptr<Periodic> census_timer;
  Drain drain;
  // Null if the listener speaks plaintext.
  std::unique_ptr<TlsFiles> tls_files;
  std::unique_ptr<Gatekeeper> gatekeeper;
  std::unique_ptr<Periodic> tls_timer;
  std::shared_ptr<grpc::ServerCredentials> credentials;
  std::unique_ptr<PoseGraphService> service;
  // Empty if reflection is not served.
  std::vector<std::unique_ptr<grpc::Service>> reflection;
  std::unique_ptr<grpc::Server> grpc_server;
  std::unique_ptr<SelfCheck> self_check;
  // The self check of the admin port, from when the server serves until it has
  // drained.
  mutable Mutex liveness_mutex;
  std::unique_ptr<SelfCheck> liveness ABSL_GUARDED_BY(liveness_mutex);
  std::unique_ptr<Periodic> store_health_timer;
  std::unique_ptr<ConnectionAcceptor> acceptor;
  std::function<void()> on_failure;
  std::atomic<bool> has_failed{false};
  std::atomic<Phase> phase{Phase::kStarting};
  // Null if there is none. The last member, since its thread uses the others.
  std::unique_ptr<HttpServer> admin;
};

namespace {

absl::StatusOr<std::unique_ptr<Gatekeeper>> MakeGatekeeper(
    const ServerSettings& settings, const TlsFiles* tls_files, const Log* log) {
  if (settings.policy.empty()) return MakeOpenGatekeeper();
  GatekeeperSettings gatekeeper;
  gatekeeper.policy_file = settings.policy;
  gatekeeper.token_keys_file = settings.token_keys;
  gatekeeper.token_rules = {
      settings.token_issuer, settings.token_audience,
      std::chrono::seconds(settings.token_leeway_seconds)};
  gatekeeper.takes_certificates = !settings.tls_client_ca.empty();
  gatekeeper.tls_files = tls_files;
  gatekeeper.check_period = Milliseconds(settings.security_check_seconds);
  return StartGatekeeper(gatekeeper, log);
}

// The files of TLS; null if the listener is to speak plaintext.
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

// Most bytes of one read. What is read by TLS is known only after it was
// decrypted, so that is a record, with 1,800 calls at most.
constexpr int kMaxReadBytes = 64 << 10;
constexpr int kMaxTlsReadBytes = 16 << 10;

int WholeMilliseconds(double seconds) {
  return static_cast<int>(Milliseconds(seconds).count());
}

void Configure(const Limits& limits, WireContent content,
               grpc::ServerBuilder* builder) {
  builder->SetMaxReceiveMessageSize(static_cast<int>(limits.max_message_bytes));
  // This version of gRPC inflates a message whole before it looks at its size:
  // a thousand times what came.
  for (const auto algorithm : {GRPC_COMPRESS_DEFLATE, GRPC_COMPRESS_GZIP}) {
    builder->SetCompressionAlgorithmSupportStatus(algorithm, false);
  }
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
  builder->AddChannelArgument(GRPC_ARG_MAX_METADATA_SIZE,
                              limits.max_metadata_bytes);
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

// Full names of the services that reflection describes beside itself.
std::vector<std::string> ServedNames(const ServerSettings& settings) {
  std::vector<std::string> names = {v1::PoseGraphService::service_full_name()};
  if (settings.serve_health) names.emplace_back("grpc.health.v1.Health");
  return names;
}

MeterBounds MetersOf(const Limits& limits) {
  MeterBounds bounds;
  bounds.max_idle_bytes = static_cast<std::uint64_t>(limits.max_idle_bytes);
  bounds.max_unadmitted_bytes =
      static_cast<std::uint64_t>(limits.max_unadmitted_bytes);
  bounds.credit_bytes = static_cast<std::uint64_t>(limits.max_message_bytes +
                                                   limits.max_metadata_bytes);
  bounds.max_held_calls =
      static_cast<std::uint64_t>(limits.max_concurrent_streams) + kCallsToClear;
  // Those that were reset are among them.
  bounds.max_unadmitted_calls = static_cast<std::uint64_t>(
      std::max<std::int64_t>(limits.max_concurrent_streams, kCallsToClear));
  bounds.max_unadmitted_memory = kUnadmittedMemory;
  return bounds;
}

WireContent ContentOf(const ServerSettings& settings) {
  return settings.tls_cert.empty() ? WireContent::kHttp2 : WireContent::kTls;
}

ConnectionAcceptor::Options AcceptorOptions(const ServerSettings& settings) {
  ConnectionAcceptor::Options options;
  options.address = settings.listen;
  options.bounds.max_connections = settings.limits.max_connections;
  options.bounds.max_connections_per_address =
      settings.limits.max_connections_per_address;
  options.bounds.max_unadmitted_connections =
      settings.limits.max_unadmitted_connections;
  options.bounds.unadmitted_work =
      std::chrono::duration_cast<std::chrono::nanoseconds>(
          std::chrono::duration<double>(
              kUnadmittedShare *
              std::max(1U, std::thread::hardware_concurrency())));
  options.content =
      settings.tls_cert.empty() ? WireContent::kHttp2 : WireContent::kTls;
  options.unacknowledged_timeout =
      Milliseconds(settings.limits.keepalive_timeout_seconds);
  return options;
}

}  // namespace

RevisitServer::RevisitServer(std::unique_ptr<State> state)
    : state_(std::move(state)) {}

RevisitServer::~RevisitServer() { Shutdown(); }

// Comes first, since these files are settings: a wrong one leaves no trace.
bool RevisitServer::State::LoadIdentities(StartError* error) {
  auto loaded_tls = LoadTlsFiles(settings, log);
  auto loaded_gatekeeper = MakeGatekeeper(
      settings, loaded_tls.ok() ? loaded_tls->get() : nullptr, log);
  for (const absl::Status& status :
       {loaded_gatekeeper.status(), loaded_tls.status()}) {
    if (status.ok()) continue;
    *error = {kExitUsage, std::string(status.message())};
    return false;
  }
  tls_files = *std::move(loaded_tls);
  gatekeeper = *std::move(loaded_gatekeeper);
  if (tls_files != nullptr) {
    tls_timer = std::make_unique<Periodic>(
        Milliseconds(settings.security_check_seconds),
        [files = tls_files.get()] {
          files->Look(std::chrono::system_clock::now());
        });
  }
  return true;
}

bool RevisitServer::State::OpenAuditLog(StartError* error) {
  if (settings.audit_log.empty()) return true;
  auto opened = AuditLog::Open(settings.audit_log, settings.log_format);
  if (!opened.ok()) {
    *error = {kExitUsage, std::string(opened.status().message())};
    return false;
  }
  audit = *std::move(opened);
  return true;
}

// Comes before the store is opened, which may take long: who looks on sees that
// the process is alive.
bool RevisitServer::State::ServeAdmin(StartError* error) {
  if (settings.admin_listen.empty()) return true;
  auto listening = HttpServer::Listen(
      settings.admin_listen,
      [this](const std::string& path) { return AnswerAdmin(path); });
  if (!listening.ok()) {
    *error = {absl::IsInvalidArgument(listening.status()) ? kExitUsage
                                                          : kExitCannotListen,
              "admin-listen: " + std::string(listening.status().message())};
    return false;
  }
  admin = *std::move(listening);
  return true;
}

HttpResponse RevisitServer::State::AnswerAdmin(const std::string& path) const {
  if (path == "/livez") return Liveness();
  if (path == "/readyz") return Readiness();
  if (path == "/metrics") {
    if (phase == Phase::kStarting) return {503, "starting\n"};
    Metrics metrics;
    CollectMetrics(&metrics);
    return {200, RenderMetrics(metrics), kMetricsContentType};
  }
  return {404, "there are /metrics, /livez and /readyz\n"};
}

HttpResponse RevisitServer::State::Liveness() const {
  std::chrono::milliseconds silence{0};
  {
    const MutexLock lock(&liveness_mutex);
    if (liveness != nullptr) silence = liveness->Silence();
  }
  if (silence < kLivenessPatience) return {200, "alive\n"};
  log->Write(LogLevel::kWarning, "liveness_not_answered",
             {{"waited_ms", static_cast<std::int64_t>(silence.count())}});
  return {503, "its threads have not answered for " +
                   std::to_string(silence.count() / 1000) + " s\n"};
}

HttpResponse RevisitServer::State::Readiness() const {
  switch (phase) {
    case Phase::kStarting:
      return {503, "starting\n"};
    case Phase::kDraining:
      return {503, "draining\n"};
    case Phase::kServing:
      break;
  }
  if (const absl::Status status = storage->CheckWritable(); !status.ok()) {
    return {503, "not writable: " + std::string(status.message()) + "\n"};
  }
  return {200, "ready\n"};
}

void RevisitServer::State::CollectMetrics(Metrics* metrics) const {
  CollectProcessMetrics(metrics);
  counts.CollectMetrics(metrics);
  admission->CollectMetrics(metrics);
  acceptor->CollectMetrics(metrics);
  CollectStorageMetrics(storage.get(), metrics);
  run_notes->CollectMetrics(metrics);
  census->CollectMetrics(metrics);
  fleet->CollectMetrics(metrics);
  if (tls_files != nullptr) tls_files->CollectMetrics(metrics);
  gatekeeper->CollectMetrics(metrics);
  log->CollectMetrics("server", metrics);
  if (audit != nullptr) audit->CollectMetrics(metrics);
  metrics
      ->Gauge("revisit_draining",
              "Whether the server has been asked to end, and calls go home.")
      .Add(phase == Phase::kDraining);
}

bool RevisitServer::State::OpenStore(StartError* error) {
  absl::StatusOr<OpenedStore> opened = OpenStoreToServe(settings, log, [this] {
    has_failed = true;
    if (on_failure) on_failure();
  });
  if (!opened.ok()) {
    *error = {ExitCodeOf(opened.status()),
              std::string(opened.status().message())};
    return false;
  }
  store_name = std::move(opened->name);
  run_notes.emplace(std::move(opened->file), log);
  scratch_directory = std::move(opened->scratch_directory);
  storage = std::move(opened->storage);
  return true;
}

void RevisitServer::State::StartFleet() {
  const int processors =
      static_cast<int>(std::max(1u, std::thread::hardware_concurrency()));
  executor = std::make_unique<Executor>(
      "vehicles",
      settings.worker_threads > 0 ? settings.worker_threads : processors);
  // With one thread alone, the loading of every vehicle would wait for each
  // long read.
  read_executor = std::make_unique<Executor>("reads", std::max(2, processors));
  const int search_threads = settings.search_threads > 0
                                 ? settings.search_threads
                                 : std::max(2, processors);
  search_executor = std::make_unique<FairExecutor>("searches", search_threads);
  Fleet::Options options;
  options.idle_unload = Milliseconds(settings.idle_unload_minutes * 60.0);
  if (settings.memory_budget_mebibytes > 0) {
    options.memory_budget_bytes = settings.memory_budget_mebibytes << 20;
  }
  options.session.max_pending_appends = settings.limits.max_pending_appends;
  options.snapshots.poses = static_cast<std::uint64_t>(settings.snapshot_poses);
  if (IsSharedStore(settings.store)) {
    options.snapshots.most_nodes_per_pose = kMostNodesPerPoseInDatabase;
  }
  options.snapshots.warn = [log = log](const std::string& message) {
    log->Write(LogLevel::kWarning, "snapshot", {{"message", message}});
  };
  options.report_drop = [log = log](const RetentionMonitor::Drop& drop) {
    log->Write(
        LogLevel::kInfo, "poses_dropped",
        {{"vehicle", drop.vehicle_id},
         {"poses", static_cast<std::int64_t>(drop.poses)},
         {"first_kept_sequence",
          static_cast<std::int64_t>(drop.first_kept_sequence)},
         {"nodes_too_old", drop.nodes_too_old},
         {"nodes_covered", drop.nodes_covered},
         {"duration_ms",
          std::chrono::duration<double, std::milli>(drop.duration).count()}});
  };
  const bool has_store_alone = !IsSharedStore(settings.store);
  census = std::make_shared<VehicleCensus>(
      storage.get(), &codec,
      has_store_alone ? std::nullopt
                      : std::optional<std::chrono::milliseconds>(kCensusAgain));
  options.census = census;
  fleet = std::make_unique<Fleet>(
      storage.get(), &codec,
      Lanes(executor.get(), read_executor.get(), search_executor.get()),
      options);
  Limits limits = settings.limits;
  if (limits.max_memory_bytes == 0) {
    limits.max_memory_bytes = DefaultMemoryLimit();
  }
  admission = std::make_unique<Admission>(
      limits, std::min(search_threads, processors), ResidentBytes);
  unload_timer = MakeUnloadTimer(fleet.get(), admission.get(), options);
  snapshot_timer = std::make_unique<Periodic>(
      kSnapshotPeriod, [fleet = fleet.get()] { fleet->WriteSnapshots(); });
  census_timer = std::make_unique<Periodic>(
      kCensusPeriod, [census = census.get()] { census->Continue(); });
  census_timer->Hasten();
}

void RevisitServer::State::StartService() {
  ServiceContext context;
  context.storage = storage.get();
  context.executor = read_executor.get();
  context.fleet = fleet.get();
  context.drain = &drain;
  context.gatekeeper = gatekeeper.get();
  context.log = log;
  context.admission = admission.get();
  context.snapshots = &snapshots;
  context.counts = &counts;
  context.audit = audit.get();
  if (settings.slow_call_seconds > 0.0) {
    context.slow_call =
        std::chrono::duration_cast<std::chrono::steady_clock::duration>(
            std::chrono::duration<double>(settings.slow_call_seconds));
  }
  context.scratch_directory = scratch_directory;
  context.min_free_bytes = settings.min_free_bytes;
  meters = std::make_unique<ConnectionMeters>(MetersOf(settings.limits));
  context.meters = meters.get();
  context.limits = settings.limits;
  // One stream alone must not exceed the batches that its vehicle may have
  // waiting.
  context.limits.max_batches_in_flight =
      std::min(settings.limits.max_batches_in_flight,
               settings.limits.max_pending_appends);
  service = std::make_unique<PoseGraphService>(context);
}

bool RevisitServer::State::Listen(StartError* error) {
  grpc::EnableDefaultHealthCheckService(settings.serve_health);
  grpc::ServerBuilder builder;
  Configure(settings.limits, ContentOf(settings), &builder);
  auto listening =
      ConnectionAcceptor::Listen(AcceptorOptions(settings), log, meters.get());
  if (!listening.ok()) {
    *error = {absl::IsInvalidArgument(listening.status()) ? kExitUsage
                                                          : kExitCannotListen,
              std::string(listening.status().message())};
    return false;
  }
  acceptor = *std::move(listening);
  credentials = ListenerCredentials(settings, tls_files.get());
  acceptor->Register(credentials, &builder);
  builder.RegisterService(service.get());
  if (settings.serve_reflection) {
    reflection = MakeReflectionServices(ServedNames(settings));
  }
  for (const auto& reflecting : reflection) {
    builder.RegisterService(reflecting.get());
  }
  grpc_server = builder.BuildAndStart();
  if (grpc_server == nullptr) {
    *error = {kExitCannotListen, "cannot start a server at " + settings.listen};
    return false;
  }
  store_health_timer = FollowStore(storage.get(), &drain,
                                   grpc_server->GetHealthCheckService(), log);
  acceptor->Start();
  return true;
}

bool RevisitServer::State::Announce(StartError* error) {
  const std::string& address = acceptor->address();
  if (!settings.port_file.empty() &&
      !WritePortFile(settings.port_file, address)) {
    *error = {kExitCannotListen, "cannot write " + settings.port_file};
    acceptor->Stop();
    grpc_server->Shutdown();
    return false;
  }
  if (const std::string risk = RiskOfListening(settings); !risk.empty()) {
    log->Write(LogLevel::kWarning, "listening_insecurely",
               {{"address", address}, {"message", risk}});
  }
  log->Write(LogLevel::kInfo, "serving",
             {{"address", address},
              {"admin_address", admin ? admin->address() : std::string()},
              {"store", store_name},
              {"version", REVISIT_VERSION}});
  return true;
}

std::unique_ptr<RevisitServer> RevisitServer::Start(
    const ServerSettings& settings, const Log* log,
    std::function<void()> on_failure, StartError* error) {
  auto state = std::make_unique<State>();
  state->settings = settings;
  state->log = log;
  state->library_log.emplace(log);
  state->on_failure = std::move(on_failure);
  if (!state->LoadIdentities(error) || !state->OpenAuditLog(error) ||
      !state->ServeAdmin(error) || !state->OpenStore(error)) {
    return nullptr;
  }
  state->StartFleet();
  state->StartService();
  if (!state->Listen(error)) return nullptr;
  state->run_notes->Note(kRunning);
  state->phase = State::Phase::kServing;
  if (!state->Announce(error)) return nullptr;
  state->StartSelfChecks();
  return std::unique_ptr<RevisitServer>(new RevisitServer(std::move(state)));
}

ExitCode RevisitServer::exit_code() const {
  return state_->has_failed ? kExitStoreFailed : kExitOk;
}

const std::string& RevisitServer::address() const {
  return state_->acceptor->address();
}

std::string RevisitServer::admin_address() const {
  return state_->admin == nullptr ? std::string() : state_->admin->address();
}

void RevisitServer::ReopenAuditLog() {
  if (state_->audit == nullptr) return;
  const absl::Status status = state_->audit->Reopen();
  if (status.ok()) {
    state_->log->Write(LogLevel::kInfo, "audit_log_opened_again", {});
  } else {
    state_->log->Write(LogLevel::kError, "audit_log_not_opened_again",
                       {{"message", std::string(status.message())}});
  }
}

void RevisitServer::LookAtFiles() {
  state_->gatekeeper->LookAtFiles();
  if (state_->tls_timer != nullptr) state_->tls_timer->Hasten();
}

bool RevisitServer::Answers(std::chrono::milliseconds patience) {
  return state_->self_check->Answers(patience);
}

void RevisitServer::State::StartSelfChecks() {
  const auto make = [this] {
    return std::make_unique<SelfCheck>(
        grpc_server->InProcessChannel(grpc::ChannelArguments()),
        executor.get());
  };
  self_check = make();
  const MutexLock lock(&liveness_mutex);
  liveness = make();
}

// Comes before the gRPC server's end: their channels are connections too.
void RevisitServer::State::EndSelfChecks() {
  self_check.reset();
  const MutexLock lock(&liveness_mutex);
  liveness.reset();
}

void RevisitServer::State::EndHealth() {
  phase = Phase::kDraining;
  // Stopped first: it would overwrite the health that is set here.
  store_health_timer.reset();
  if (auto* health = grpc_server->GetHealthCheckService()) {
    health->SetServingStatus(false);
  }
}

void RevisitServer::GiveNotice() {
  state_->log->Write(LogLevel::kInfo, "notice_of_drain",
                     {{"seconds", state_->settings.drain_notice_seconds}});
  state_->EndHealth();
  state_->storage->Leave();
}

void RevisitServer::Shutdown() {
  if (state_->grpc_server == nullptr) return;
  const auto start = std::chrono::steady_clock::now();
  state_->log->Write(LogLevel::kInfo, "draining", {});
  state_->EndHealth();
  const auto deadline =
      start + Milliseconds(state_->settings.drain_timeout_seconds);
  state_->drain.Start();
  state_->drain.WaitForCalls(deadline);
  state_->acceptor->Stop();
  // Calls that are cut still wait for loading that they have begun.
  state_->fleet->GiveUpReplays();
  // Cuts the calls that are left, and the connections that do not answer to
  // being closed.
  auto goodbye = kGoodbyeTime;
  if (state_->drain.HasEndedCalls()) {
    const auto left = std::chrono::duration_cast<std::chrono::milliseconds>(
        deadline - std::chrono::steady_clock::now());
    goodbye = std::max(goodbye, std::min(left, kGoodbyeTimeAfterCalls));
  }
  state_->EndSelfChecks();
  state_->grpc_server->Shutdown(std::chrono::system_clock::now() + goodbye);
  state_->grpc_server->Wait();
  state_->grpc_server.reset();
  state_->admin.reset();
  // The gatekeeper's thread may hold the last reference to a stream, and with
  // it a session.
  state_->gatekeeper.reset();
  state_->unload_timer.reset();
  state_->snapshot_timer.reset();
  state_->census_timer.reset();
  state_->fleet.reset();
  state_->executor.reset();
  state_->read_executor.reset();
  state_->search_executor.reset();
  const CommitCounts counts = state_->storage->Counts();
  // The note is written while this server still has the store, since the next
  // one writes its own.
  const bool had_failed = state_->has_failed;
  state_->run_notes->Note(had_failed ? kStoreFailed : kStopped);
  state_->storage.reset();
  if (state_->has_failed && !had_failed) state_->run_notes->Note(kStoreFailed);
  const std::chrono::duration<double, std::milli> duration =
      std::chrono::steady_clock::now() - start;
  state_->log->Write(LogLevel::kInfo, "stopped",
                     {{"duration_ms", duration.count()},
                      {"commits", static_cast<std::int64_t>(counts.commits)},
                      {"writes", static_cast<std::int64_t>(counts.writes)}});
}

}  // namespace revisit::server
