#include "server/server.h"

#include <algorithm>
#include <atomic>
#include <chrono>
#include <cstdint>
#include <cstdio>
#include <fstream>
#include <optional>
#include <string>
#include <utility>
#include <vector>

#include "core/base/build_info.h"
#include "revisit/v1/pose_graph_service.grpc.pb.h"
#include "server/admin/admin_port.h"
#include "server/admin/health.h"
#include "server/admin/http_server.h"
#include "server/base/library_log.h"
#include "server/base/metrics.h"
#include "server/connections/connection_meter.h"
#include "server/connections/drain.h"
#include "server/connections/listener.h"
#include "server/identities.h"
#include "server/service/exported_graphs.h"
#include "server/service/pose_graph_service.h"
#include "server/service/reflection.h"
#include "server/storage/engines/engine.h"
#include "server/storage/run_notes.h"
#include "server/storage/storage_metrics.h"
#include "server/telemetry/audit_log.h"
#include "server/telemetry/process_metrics.h"
#include "server/telemetry/service_counters.h"
#include "server/vehicles.h"

namespace revisit::server {
namespace {

using SteadyClock = std::chrono::steady_clock;

// Time for connections to be closed in an orderly way. Where calls were ended
// it is longer: a connection that the server cuts before its caller has read
// how a call ended takes that answer with it.
constexpr std::chrono::milliseconds kGoodbyeTime{100};
constexpr std::chrono::milliseconds kGoodbyeTimeAfterCalls{2000};

// The code for an address that cannot be listened on.
ExitCode CodeOfListening(const absl::Status& status) {
  return absl::IsInvalidArgument(status) ? kExitUsage : kExitCannotListen;
}

// Sets `*error` and returns false.
bool Fail(ExitCode code, const absl::Status& status, StartError* error) {
  *error = {code, std::string(status.message())};
  return false;
}

// Writes the file whole or not at all, because a script may be waiting for it.
bool WritePortFile(const std::string& path, const std::string& address) {
  const std::string temporary = path + ".new";
  std::ofstream file(temporary);
  file << address << "\n";
  file.close();
  return !file.fail() && std::rename(temporary.c_str(), path.c_str()) == 0;
}

// Full names of the services that reflection describes beside itself.
std::vector<std::string> ServedNames(const ServerSettings& settings) {
  std::vector<std::string> names = {v1::PoseGraphService::service_full_name()};
  if (settings.serve_health) names.emplace_back("grpc.health.v1.Health");
  return names;
}

}  // namespace

struct RevisitServer::State {
  // All that works on the store. The members stand in the order in which they
  // need each other, and are destroyed from the last to the first; a start
  // fills some of the last in before, see Start().
  struct Parts {
    explicit Parts(const Log* log) : health(log) {}

    ServiceCounters counts;
    ExportedGraphs exported_graphs;
    Drain drain;
    std::unique_ptr<Vehicles> vehicles;
    std::unique_ptr<ConnectionMeters> meters;
    std::unique_ptr<PoseGraphService> service;
    // Empty if reflection is not served.
    std::vector<std::unique_ptr<grpc::Service>> reflection;
    // The gatekeeper's thread may hold the last reference to a stream, and with
    // it all that a call uses.
    std::unique_ptr<Identities> identities;
    std::unique_ptr<Listener> listener;
    Health health;
    // Null if there is none. Its thread uses the others.
    std::unique_ptr<HttpServer> admin;
  };

  // The steps of a start, in this order. Those that may fail return whether
  // they did not, and otherwise set `*error`.
  bool LoadIdentities(StartError* error);
  bool OpenAuditLog(StartError* error);
  bool ServeAdmin(StartError* error);
  bool OpenStore(StartError* error);
  void MakeService();
  bool Listen(StartError* error);
  bool Announce(StartError* error);

  // The steps of an end, in this order.
  void EndCalls(SteadyClock::time_point deadline);
  CommitCounts CloseStore();

  // REQUIRES: the server serves or drains. The parts are an argument, since
  // they may be on their way out.
  void CollectMetrics(const Parts& from, Metrics* metrics) const;

  ServerSettings settings;
  const Log* log = nullptr;
  std::optional<LibraryLogRoute> library_log;
  std::function<void()> on_failure;
  std::atomic<bool> has_failed{false};
  // Null if none is kept.
  std::unique_ptr<AuditLog> audit;
  OpenedStore store;
  std::optional<RunNotes> run_notes;
  // Null once the server has ended.
  std::unique_ptr<Parts> parts;
};

RevisitServer::RevisitServer(std::unique_ptr<State> state)
    : state_(std::move(state)) {}

RevisitServer::~RevisitServer() { Shutdown(); }

std::unique_ptr<RevisitServer> RevisitServer::Start(
    const ServerSettings& settings, const Log* log,
    std::function<void()> on_failure, StartError* error) {
  auto state = std::make_unique<State>();
  state->settings = settings;
  state->log = log;
  state->library_log.emplace(log);
  state->on_failure = std::move(on_failure);
  state->parts = std::make_unique<State::Parts>(log);
  if (!state->LoadIdentities(error) || !state->OpenAuditLog(error) ||
      !state->ServeAdmin(error) || !state->OpenStore(error)) {
    return nullptr;
  }
  state->parts->vehicles = std::make_unique<Vehicles>(
      settings, state->store.storage.get(), state->store.is_shared, log);
  state->MakeService();
  if (!state->Listen(error) || !state->Announce(error)) return nullptr;
  return std::unique_ptr<RevisitServer>(new RevisitServer(std::move(state)));
}

// Comes first, since these files are settings: a wrong one leaves no trace.
bool RevisitServer::State::LoadIdentities(StartError* error) {
  auto loaded = Identities::Load(settings, log);
  if (!loaded.ok()) return Fail(kExitUsage, loaded.status(), error);
  parts->identities = *std::move(loaded);
  return true;
}

bool RevisitServer::State::OpenAuditLog(StartError* error) {
  if (settings.audit_log.empty()) return true;
  auto opened = AuditLog::Open(settings.audit_log, settings.log_format);
  if (!opened.ok()) return Fail(kExitUsage, opened.status(), error);
  audit = *std::move(opened);
  return true;
}

// Comes before the store is opened, which may take long: who looks on sees that
// the process is alive.
bool RevisitServer::State::ServeAdmin(StartError* error) {
  if (settings.admin_listen.empty()) return true;
  auto served = ServeAdminPort(settings.admin_listen, &parts->health,
                               [this, from = parts.get()](Metrics* metrics) {
                                 CollectMetrics(*from, metrics);
                               });
  if (!served.ok()) {
    *error = {CodeOfListening(served.status()),
              "admin-listen: " + std::string(served.status().message())};
    return false;
  }
  parts->admin = *std::move(served);
  return true;
}

bool RevisitServer::State::OpenStore(StartError* error) {
  absl::StatusOr<OpenedStore> opened =
      EngineOf(settings.store).Open(settings, log, [this] {
        has_failed = true;
        if (on_failure) on_failure();
      });
  if (!opened.ok()) {
    return Fail(ExitCodeOf(opened.status()), opened.status(), error);
  }
  store = *std::move(opened);
  run_notes.emplace(store.file, log);
  return true;
}

void RevisitServer::State::MakeService() {
  ServiceContext context;
  context.storage = store.storage.get();
  context.executor = parts->vehicles->read_executor();
  context.fleet = parts->vehicles->fleet();
  context.groups = parts->vehicles->groups();
  context.group_searches = parts->vehicles->group_searches();
  context.feed = parts->vehicles->feed();
  context.drain = &parts->drain;
  context.gatekeeper = parts->identities->gatekeeper();
  context.log = log;
  context.admission = parts->vehicles->admission();
  context.exported_graphs = &parts->exported_graphs;
  context.counts = &parts->counts;
  context.audit = audit.get();
  if (settings.slow_call_seconds > 0.0) {
    context.slow_call = std::chrono::duration_cast<SteadyClock::duration>(
        std::chrono::duration<double>(settings.slow_call_seconds));
  }
  context.scratch_directory = store.scratch_directory;
  context.min_free_bytes = settings.min_free_bytes;
  parts->meters =
      std::make_unique<ConnectionMeters>(MeterBoundsOf(settings.limits));
  context.meters = parts->meters.get();
  context.limits = settings.limits;
  // One stream alone must not exceed the batches that its vehicle may have
  // waiting.
  context.limits.max_batches_in_flight =
      std::min(settings.limits.max_batches_in_flight,
               settings.limits.max_pending_appends);
  parts->service = std::make_unique<PoseGraphService>(context);
  if (settings.serve_reflection) {
    parts->reflection = MakeReflectionServices(ServedNames(settings));
  }
}

bool RevisitServer::State::Listen(StartError* error) {
  auto listening = Listener::Listen(settings, parts->identities->tls_files(),
                                    log, parts->meters.get());
  if (!listening.ok()) {
    return Fail(CodeOfListening(listening.status()), listening.status(), error);
  }
  parts->listener = *std::move(listening);
  std::vector<grpc::Service*> services = {parts->service.get()};
  for (const auto& reflecting : parts->reflection) {
    services.push_back(reflecting.get());
  }
  const absl::Status started = parts->listener->Start(services);
  if (!started.ok()) return Fail(kExitCannotListen, started, error);
  run_notes->Note(kRunning);
  parts->health.Serve(store.storage.get(), &parts->drain,
                      parts->vehicles->executor(), parts->listener->server());
  parts->listener->Accept();
  return true;
}

bool RevisitServer::State::Announce(StartError* error) {
  const std::string& address = parts->listener->address();
  if (!settings.port_file.empty() &&
      !WritePortFile(settings.port_file, address)) {
    *error = {kExitCannotListen, "cannot write " + settings.port_file};
    return false;
  }
  if (const std::string risk = RiskOfListening(settings); !risk.empty()) {
    log->Write(LogLevel::kWarning, "listening_insecurely",
               {{"address", address}, {"message", risk}});
  }
  log->Write(LogLevel::kInfo, "serving",
             {{"address", address},
              {"admin_address",
               parts->admin ? parts->admin->address() : std::string()},
              {"store", store.name},
              {"version", kVersion}});
  return true;
}

// In the order of the page.
void RevisitServer::State::CollectMetrics(const Parts& from,
                                          Metrics* metrics) const {
  CollectProcessMetrics(metrics);
  from.counts.CollectMetrics(metrics);
  from.vehicles->admission()->CollectMetrics(metrics);
  from.listener->CollectMetrics(metrics);
  CollectStorageMetrics(store.storage.get(), metrics);
  run_notes->CollectMetrics(metrics);
  from.vehicles->census()->CollectMetrics(metrics);
  from.vehicles->fleet()->CollectMetrics(metrics);
  from.vehicles->group_searches()->CollectMetrics(metrics);
  from.vehicles->feed()->CollectMetrics(metrics);
  from.identities->CollectMetrics(metrics);
  log->CollectMetrics("server", metrics);
  if (audit != nullptr) audit->CollectMetrics(metrics);
  from.health.CollectMetrics(metrics);
}

ExitCode RevisitServer::exit_code() const {
  return state_->has_failed ? kExitStoreFailed : kExitOk;
}

const std::string& RevisitServer::address() const {
  return state_->parts->listener->address();
}

std::string RevisitServer::admin_address() const {
  const auto& admin = state_->parts->admin;
  return admin == nullptr ? std::string() : admin->address();
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

void RevisitServer::LookAtFiles() { state_->parts->identities->LookAtFiles(); }

bool RevisitServer::Answers(std::chrono::milliseconds patience) {
  return state_->parts->health.Answers(patience);
}

void RevisitServer::GiveNotice() {
  state_->log->Write(LogLevel::kInfo, "notice_of_drain",
                     {{"seconds", state_->settings.drain_notice_seconds}});
  state_->parts->health.Drain();
  state_->store.storage->Leave();
}

void RevisitServer::Shutdown() {
  if (state_->parts == nullptr) return;
  const auto start = SteadyClock::now();
  state_->log->Write(LogLevel::kInfo, "draining", {});
  state_->EndCalls(start +
                   Milliseconds(state_->settings.drain_timeout_seconds));
  state_->parts.reset();
  const CommitCounts counts = state_->CloseStore();
  const std::chrono::duration<double, std::milli> duration =
      SteadyClock::now() - start;
  state_->log->Write(LogLevel::kInfo, "stopped",
                     {{"duration_ms", duration.count()},
                      {"commits", static_cast<std::int64_t>(counts.commits)},
                      {"writes", static_cast<std::int64_t>(counts.writes)}});
}

void RevisitServer::State::EndCalls(SteadyClock::time_point deadline) {
  parts->health.Drain();
  parts->drain.Start();
  parts->drain.WaitForCalls(deadline);
  parts->listener->StopAccepting();
  // Calls that are cut still wait for loading that they have begun.
  parts->vehicles->fleet()->GiveUpReplays();
  // Cuts the calls that are left, and the connections that do not answer to
  // being closed.
  auto goodbye = kGoodbyeTime;
  if (parts->drain.HasEndedCalls()) {
    const auto left = std::chrono::duration_cast<std::chrono::milliseconds>(
        deadline - SteadyClock::now());
    goodbye = std::max(goodbye, std::min(left, kGoodbyeTimeAfterCalls));
  }
  parts->health.EndChecks();
  parts->listener->End(std::chrono::system_clock::now() + goodbye);
}

CommitCounts RevisitServer::State::CloseStore() {
  const CommitCounts counts = store.storage->Counts();
  // The note is written while this server still has the store, since the next
  // one writes its own.
  const bool had_failed = has_failed;
  run_notes->Note(had_failed ? kStoreFailed : kStopped);
  store.storage.reset();
  if (has_failed && !had_failed) run_notes->Note(kStoreFailed);
  return counts;
}

}  // namespace revisit::server
