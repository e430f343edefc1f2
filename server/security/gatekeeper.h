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
#include "server/security/caller.h"

namespace revisit::server {

// What a call brought to show who its caller is.
struct Credentials {
  // Values of the metadata key `authorization`, as they came.
  std::vector<std::string> authorizations;
  // Of the client, verified by the handshake; empty if there is none.
  std::string certificate_pem;
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
};

// Lets everyone in.
std::unique_ptr<Gatekeeper> MakeOpenGatekeeper();

}  // namespace revisit::server

#endif  // REVISIT_SERVER_SECURITY_GATEKEEPER_H_
