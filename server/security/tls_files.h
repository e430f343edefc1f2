// Key and certificates of the listener, from files that may be replaced while
// the server runs.
//
// gRPC's own watcher of files takes whatever it finds, and then no handshake
// succeeds any more. Here files are checked first, and as long as they are no
// good, what was good before stays in use.
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
  // Empty: clients are not asked for certificates.
  std::string client_authorities;
};

// Thread-safe.
class TlsFiles {
 public:
  // INVALID_ARGUMENT if the files are missing or no good at `now`. The log must
  // outlive this.
  static absl::StatusOr<std::unique_ptr<TlsFiles>> Load(const TlsPaths& paths,
                                                        const Log* log,
                                                        CertificateTime now);

  // Looks at the files. What has changed is taken, or refused with a line in
  // the log, once a change. Warns, once a day, of a certificate that expires
  // within 14 days. From one thread at a time.
  void Look(CertificateTime now);

  struct Current {
    // Goes up with each change.
    std::int64_t version = 0;
    std::shared_ptr<const TlsMaterial> material;
  };
  Current current() const;

 private:
  TlsFiles(const TlsPaths& paths, const Log* log);

  absl::Status Take(CertificateTime now);
  void WarnOfExpiry(CertificateTime now);

  const Log* const log_;

  // Of Look() alone.
  const bool has_authorities_;
  WatchedFiles files_;
  // Of what was refused last; OK if the files as they are now are in use.
  absl::Status refusal_;
  TlsSummary summary_;
  CertificateTime warned_ = CertificateTime::min();

  mutable Mutex mutex_;
  Current current_ ABSL_GUARDED_BY(mutex_);
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_SECURITY_TLS_FILES_H_
