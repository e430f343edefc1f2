#include "server/security/tls_files.h"

#include <utility>
#include <vector>

#include "server/base/metrics.h"

namespace revisit::server {
namespace {

using std::chrono::hours;

constexpr hours kDay{24};
constexpr hours kWarnBefore = 14 * kDay;

std::vector<std::string> List(const TlsPaths& paths) {
  std::vector<std::string> list = {paths.private_key, paths.certificate_chain};
  if (!paths.client_authorities.empty()) {
    list.push_back(paths.client_authorities);
  }
  return list;
}

}  // namespace

TlsFiles::TlsFiles(const TlsPaths& paths, const Log* log)
    : log_(log),
      has_authorities_(!paths.client_authorities.empty()),
      files_(List(paths)) {}

absl::StatusOr<std::unique_ptr<TlsFiles>> TlsFiles::Load(const TlsPaths& paths,
                                                         const Log* log,
                                                         CertificateTime now) {
  std::unique_ptr<TlsFiles> files(new TlsFiles(paths, log));
  files->files_.Look();
  if (absl::Status status = files->Take(now); !status.ok()) return status;
  files->WarnOfExpiry(now);
  return files;
}

void TlsFiles::Look(CertificateTime now) {
  const bool changed = files_.Look();
  // Refused files are checked again even if unchanged: a certificate that was
  // not valid yet may be valid now.
  if (changed || !refusal_.ok()) {
    const absl::Status refused_before = refusal_;
    refusal_ = Take(now);
    {
      const MutexLock lock(&mutex_);
      state_.refused = !refusal_.ok();
    }
    if (refusal_.ok()) {
      log_->Write(LogLevel::kInfo, "tls_files_loaded",
                  {{"serial_number", summary_.serial_number}});
    } else if (changed || refusal_ != refused_before) {
      log_->Write(LogLevel::kError, "tls_files_refused",
                  {{"message", std::string(refusal_.message()) +
                                   "; what was loaded before stays in use"}});
    }
  }
  WarnOfExpiry(now);
}

TlsFiles::Current TlsFiles::current() const {
  const MutexLock lock(&mutex_);
  return current_;
}

FilesState TlsFiles::state() const {
  const MutexLock lock(&mutex_);
  return state_;
}

CertificateTime TlsFiles::expires() const {
  const MutexLock lock(&mutex_);
  return expires_;
}

void TlsFiles::CollectMetrics(Metrics* metrics) const {
  metrics
      ->Gauge("revisit_tls_certificate_expiry_timestamp_seconds",
              "When the listener's certificate expires, since the Unix epoch.")
      .Add(expires());
  CollectFilesMetrics("tls", state(), metrics);
}

absl::Status TlsFiles::Take(CertificateTime now) {
  if (!files_.contents().ok()) return files_.contents().status();
  const std::vector<std::string>& texts = *files_.contents();
  auto material = std::make_shared<TlsMaterial>();
  material->private_key = texts[0];
  material->certificate_chain = texts[1];
  if (has_authorities_) {
    material->client_authorities = texts[2];
    if (texts[2].empty()) {
      return absl::InvalidArgumentError(
          "the file of client authorities is empty");
    }
  }
  const absl::StatusOr<TlsSummary> summary = CheckTlsMaterial(*material, now);
  if (!summary.ok()) return summary.status();
  summary_ = *summary;
  const MutexLock lock(&mutex_);
  state_.loaded = now;
  expires_ = summary->expires;
  ++current_.version;
  current_.material = std::move(material);
  return absl::OkStatus();
}

void TlsFiles::WarnOfExpiry(CertificateTime now) {
  const bool soon = summary_.expires - now < kWarnBefore;
  if (!soon || (warned_ != CertificateTime::min() && now - warned_ < kDay)) {
    return;
  }
  warned_ = now;
  const auto left = std::chrono::duration_cast<hours>(summary_.expires - now);
  log_->Write(LogLevel::kWarning, "certificate_expires_soon",
              {{"serial_number", summary_.serial_number},
               {"hours_left", static_cast<std::int64_t>(left.count())}});
}

}  // namespace revisit::server
