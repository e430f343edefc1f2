// Tells who calls, by what the call brought, and has streams look again.
#ifndef REVISIT_SERVER_SECURITY_GATEKEEPER_H_
#define REVISIT_SERVER_SECURITY_GATEKEEPER_H_

#include <chrono>
#include <cstdint>
#include <functional>
#include <memory>
#include <string>
#include <vector>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "server/base/logging.h"
#include "server/security/caller.h"
#include "server/security/tls_files.h"
#include "server/security/token.h"

namespace revisit::server {

// What a call brought to show who its caller is.
struct Credentials {
  // Values of the metadata key `authorization`, as they came.
  std::vector<std::string> authorizations;
  // Of the client, verified by the handshake; empty if there is none.
  std::string certificate_pem;
  // What the client showed besides, up to an authority; may be empty.
  std::string certificate_chain_pem{};
};

// Thread-safe.
class Gatekeeper {
 public:
  using WatchId = std::int64_t;
  using Time = std::chrono::system_clock::time_point;

  virtual ~Gatekeeper() = default;

  // False: everyone is let in and may do everything; credentials are not
  // looked at.
  virtual bool asks() const = 0;

  // UNAUTHENTICATED if the credentials are missing or not good at this time,
  // PERMISSION_DENIED (NOT_GRANTED) if they are, but nothing is granted to who
  // they name.
  virtual absl::StatusOr<std::shared_ptr<const Caller>> Admit(
      const Credentials& credentials, Time now) = 0;

  // Calls `recheck` whenever what was found of a caller may have changed: at
  // `expires`, whenever keys or policy have changed, and from time to time. It
  // comes on a thread of the gatekeeper's, also shortly after Unwatch().
  virtual WatchId Watch(Time expires, std::function<void()> recheck) = 0;
  virtual void Unwatch(WatchId id) = 0;

  // Looks at its files, and has all streams recheck, soon rather than when it
  // is due. Returns at once.
  virtual void LookAtFiles() = 0;
};

struct GatekeeperSettings {
  // See policy.h.
  std::string policy_file;
  // A key set (jwk_set.h); empty if no bearer tokens are taken.
  std::string token_keys_file;
  TokenRules token_rules;
  // Whether a client's certificate says who calls, if there is no token.
  bool takes_certificates = false;
  // Whose client authorities have to stand behind a certificate at every call
  // and recheck, for the handshake asked those of its time. Null: nobody is
  // asked again. Outlives the gatekeeper.
  const TlsFiles* tls_files = nullptr;
  // How often files are looked at and all streams recheck.
  std::chrono::milliseconds check_period{10'000};
};

// Knows callers by token or certificate. Files that change are taken together,
// or, if one of them is no good, refused together with a line in the log, once
// a change; then what was good before stays in use. INVALID_ARGUMENT if they
// are no good at the start. The log must outlive the gatekeeper.
absl::StatusOr<std::unique_ptr<Gatekeeper>> StartGatekeeper(
    const GatekeeperSettings& settings, const Log* log);

// Lets everyone in.
std::unique_ptr<Gatekeeper> MakeOpenGatekeeper();

}  // namespace revisit::server

#endif  // REVISIT_SERVER_SECURITY_GATEKEEPER_H_
