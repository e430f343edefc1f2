// Key and certificates of the listener, from files that may be replaced while
// the server runs.
//
// gRPC's own watcher of files takes whatever it finds, and if that is invalid
// no handshake succeeds any more. Here files are checked first, and as long as
// they are invalid, the earlier contents stay in use.
#ifndef REVISIT_SERVER_SECURITY_TLS_FILES_H_
#define REVISIT_SERVER_SECURITY_TLS_FILES_H_

#include <chrono>
#include <cstdint>
#include <memory>
#include <string>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "core/base/mutex.h"
#include "server/base/logging.h"
#include "server/security/certificates.h"
#include "server/security/watched_files.h"

namespace revisit::server {

struct TlsPaths {
  std::string private_key;
  std::string certificate_chain;
  // Empty if clients are not asked for certificates.
  std::string client_authorities;
};

// Thread-safe.
class TlsFiles {
 public:
  // INVALID_ARGUMENT if the files are missing or invalid at `now`. The log must
  // outlive this.
  static absl::StatusOr<std::unique_ptr<TlsFiles>> Load(const TlsPaths& paths,
                                                        const Log* log,
                                                        CertificateTime now);

  // Looks at the files. Changed contents are taken up, or refused with one line
  // in the log per change. Warns, once a day, about a certificate that expires
  // within 14 days. For one thread at a time.
  void Look(CertificateTime now);

  struct Current {
    // Grows with each change.
    std::int64_t version = 0;
    std::shared_ptr<const TlsMaterial> material;
  };
  Current current() const;

  FilesState state() const;
  // When the certificate in use expires.
  CertificateTime expires() const;

  void CollectMetrics(Metrics* metrics) const;

 private:
  TlsFiles(const TlsPaths& paths, const Log* log);

  absl::Status Take(CertificateTime now);
  void WarnOfExpiry(CertificateTime now);

  const Log* const log_;

  // Used by Look() alone.
  const bool has_authorities_;
  WatchedFiles files_;
  // Why the present contents were refused; OK if they are in use.
  absl::Status refusal_;
  TlsSummary summary_;
  CertificateTime warned_ = CertificateTime::min();

  mutable Mutex mutex_;
  Current current_ ABSL_GUARDED_BY(mutex_);
  FilesState state_ ABSL_GUARDED_BY(mutex_);
  CertificateTime expires_ ABSL_GUARDED_BY(mutex_);
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_SECURITY_TLS_FILES_H_
