// Who the server is and who its callers are, by the files that the settings
// name, which may be replaced while it runs.
#ifndef REVISIT_SERVER_IDENTITIES_H_
#define REVISIT_SERVER_IDENTITIES_H_

#include <memory>

#include "absl/status/statusor.h"
#include "server/base/logging.h"
#include "server/base/periodic.h"
#include "server/security/gatekeeper.h"
#include "server/security/tls_files.h"
#include "server/settings/settings.h"

namespace revisit::server {

class Identities {
 public:
  // INVALID_ARGUMENT if a file is missing or invalid. The log must outlive
  // this.
  static absl::StatusOr<std::unique_ptr<Identities>> Load(
      const ServerSettings& settings, const Log* log);

  // Null if the listener speaks plaintext.
  const TlsFiles* tls_files() const { return tls_files_.get(); }
  Gatekeeper* gatekeeper() const { return gatekeeper_.get(); }

  // Has the files read now, rather than within
  // ServerSettings::security_check_seconds. Returns at once.
  void LookAtFiles();

  void CollectMetrics(Metrics* metrics) const;

 private:
  Identities() = default;

  std::unique_ptr<TlsFiles> tls_files_;
  std::unique_ptr<Periodic> tls_timer_;
  // Asks the TLS files.
  std::unique_ptr<Gatekeeper> gatekeeper_;
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_IDENTITIES_H_
