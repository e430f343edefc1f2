// Identifies callers by their credentials, and has streams check again.
#ifndef REVISIT_SERVER_SECURITY_GATEKEEPER_H_
#define REVISIT_SERVER_SECURITY_GATEKEEPER_H_

#include <chrono>
#include <cstdint>
#include <functional>
#include <memory>
#include <optional>
#include <string>
#include <vector>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "server/base/logging.h"
#include "server/security/caller.h"
#include "server/security/tls_files.h"
#include "server/security/token.h"
#include "server/security/watched_files.h"

namespace revisit::server {

// Credentials that came with a call.
struct Credentials {
  // Values of the metadata key `authorization`, as they came.
  std::vector<std::string> authorizations;
  // The client's certificate, verified by the handshake; empty if it presented
  // none.
  std::string certificate_pem;
  // Further certificates that the client sent, up to an authority; may be
  // empty.
  std::string certificate_chain_pem{};
};

// Thread-safe.
class Gatekeeper {
 public:
  using WatchId = std::int64_t;
  using Time = std::chrono::system_clock::time_point;

  virtual ~Gatekeeper() = default;

  // Whether callers need credentials. If not, everyone may do everything, and
  // credentials are ignored.
  virtual bool asks() const = 0;

  // The caller that the credentials name. UNAUTHENTICATED if they are missing,
  // or invalid at this time; PERMISSION_DENIED (NOT_GRANTED) if they are valid,
  // but nothing is granted to that caller.
  virtual absl::StatusOr<std::shared_ptr<const Caller>> Admit(
      const Credentials& credentials, Time now) = 0;

  // Calls `recheck` whenever the rights of a caller may have changed: at
  // `expires`, whenever keys or policy have changed, and from time to time. The
  // call comes on a thread of the gatekeeper's, also shortly after Unwatch().
  virtual WatchId Watch(Time expires, std::function<void()> recheck) = 0;
  virtual void Unwatch(WatchId id) = 0;

  // The files that say who may do what; nothing if callers are not asked.
  virtual std::optional<FilesState> files() const = 0;
  void CollectMetrics(Metrics* metrics) const {
    if (const auto state = files()) {
      CollectFilesMetrics("access", *state, metrics);
    }
  }

  // Has files read and all streams rechecked soon, before the next period ends.
  // Returns at once.
  virtual void LookAtFiles() = 0;
};

struct GatekeeperSettings {
  // The policy (policy.h).
  std::string policy_file;
  // A key set (jwk_set.h); empty if no bearer tokens are taken.
  std::string token_keys_file;
  TokenRules token_rules;
  // Whether a client's certificate says who calls, if there is no token.
  bool takes_certificates = false;
  // Holds the client authorities that must vouch for a certificate at every
  // call and recheck: the handshake checked only those of its own time. If
  // null, certificates are not checked again. Outlives the gatekeeper.
  const TlsFiles* tls_files = nullptr;
  // How often files are read and all streams rechecked.
  std::chrono::milliseconds check_period{10'000};
};

// A gatekeeper that knows callers by token or certificate. Changed files are
// taken up together. If one of them is invalid, they are refused together, with
// one line in the log per change, and the earlier contents stay in use.
// INVALID_ARGUMENT if they are invalid at the start. The log must outlive the
// gatekeeper.
absl::StatusOr<std::unique_ptr<Gatekeeper>> StartGatekeeper(
    const GatekeeperSettings& settings, const Log* log);

// A gatekeeper that lets everyone in.
std::unique_ptr<Gatekeeper> MakeOpenGatekeeper();

}  // namespace revisit::server

#endif  // REVISIT_SERVER_SECURITY_GATEKEEPER_H_
