// Reports to the service manager, such as systemd, over the socket that
// NOTIFY_SOCKET names: sd_notify(3). Without that variable nothing is reported.
#ifndef REVISIT_SERVER_BASE_SERVICE_MANAGER_H_
#define REVISIT_SERVER_BASE_SERVICE_MANAGER_H_

#include <chrono>
#include <functional>
#include <memory>

#include "server/base/logging.h"
#include "server/base/periodic.h"

namespace revisit::server {

// Reports that the service has started: calls are taken.
void ReportReady();

// Reports that the service has begun to end.
void ReportStopping();

// Reports to the manager's watchdog that the service works, for as long as this
// lives. The manager kills and restarts a service that it has not heard of for
// the time that WATCHDOG_USEC states; without that variable nothing is done.
class Watchdog {
 public:
  // Returns whether the service works, within `patience`. Called on one thread.
  using Works = std::function<bool(std::chrono::milliseconds patience)>;

  // Asks `works` four times in the manager's time, each time with a quarter of
  // it as patience, and reports only where the answer is true. A false one is
  // logged as `watchdog_not_answered`. The log must outlive this.
  Watchdog(Works works, const Log* log);

 private:
  // Null if there is no watchdog.
  std::unique_ptr<Periodic> timer_;
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_BASE_SERVICE_MANAGER_H_
