// What callers are told of a server whose store is out of reach or takes no
// writes.
#ifndef REVISIT_SERVER_ADMIN_STORE_HEALTH_H_
#define REVISIT_SERVER_ADMIN_STORE_HEALTH_H_

#include <memory>

#include "server/base/logging.h"
#include "server/base/periodic.h"
#include "server/connections/drain.h"

namespace grpc {
class HealthCheckServiceInterface;
}  // namespace grpc

namespace revisit::server {

class Storage;

// Says that all is well, then looks twice a second, first at once, whether the
// store's lease holds and whether it takes writes, and tells health, calls and
// the log of each change. `health` may be null. All of these outlive the timer,
// which looks no more once it is gone.
std::unique_ptr<Periodic> FollowStore(Storage* storage, Drain* drain,
                                      grpc::HealthCheckServiceInterface* health,
                                      const Log* log);

}  // namespace revisit::server

#endif  // REVISIT_SERVER_ADMIN_STORE_HEALTH_H_
