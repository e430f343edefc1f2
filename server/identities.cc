#include "server/identities.h"

#include <chrono>
#include <cstdint>
#include <utility>

namespace revisit::server {
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

}  // namespace

absl::StatusOr<std::unique_ptr<Identities>> Identities::Load(
    const ServerSettings& settings, const Log* log) {
  auto tls_files = LoadTlsFiles(settings, log);
  auto gatekeeper = MakeGatekeeper(
      settings, tls_files.ok() ? tls_files->get() : nullptr, log);
  if (!gatekeeper.ok()) return gatekeeper.status();
  if (!tls_files.ok()) return tls_files.status();
  std::unique_ptr<Identities> identities(new Identities());
  identities->tls_files_ = *std::move(tls_files);
  identities->gatekeeper_ = *std::move(gatekeeper);
  if (identities->tls_files_ != nullptr) {
    identities->tls_timer_ = std::make_unique<Periodic>(
        Milliseconds(settings.security_check_seconds),
        [files = identities->tls_files_.get()] {
          files->Look(std::chrono::system_clock::now());
        });
  }
  return identities;
}

void Identities::LookAtFiles() {
  gatekeeper_->LookAtFiles();
  if (tls_timer_ != nullptr) tls_timer_->Hasten();
}

void Identities::CollectMetrics(Metrics* metrics) const {
  if (tls_files_ != nullptr) tls_files_->CollectMetrics(metrics);
  gatekeeper_->CollectMetrics(metrics);
}

}  // namespace revisit::server
