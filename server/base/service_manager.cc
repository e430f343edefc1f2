#include "server/base/service_manager.h"

#include <systemd/sd-daemon.h>

#include <algorithm>
#include <cstdint>
#include <utility>

namespace revisit::server {
namespace {

// Failures are ignored: the manager finds out by itself that it hears nothing.
void Report(const char* state) { sd_notify(/*unset_environment=*/0, state); }

}  // namespace

void ReportReady() { Report("READY=1"); }

void ReportStopping() { Report("STOPPING=1"); }

Watchdog::Watchdog(Works works, const Log* log) {
  std::uint64_t microseconds = 0;
  if (sd_watchdog_enabled(/*unset_environment=*/0, &microseconds) <= 0) return;
  const auto period =
      std::max(std::chrono::milliseconds(1),
               std::chrono::duration_cast<std::chrono::milliseconds>(
                   std::chrono::microseconds(microseconds / 4)));
  timer_ = std::make_unique<Periodic>(period, [works = std::move(works), log,
                                               period] {
    if (works(period)) {
      Report("WATCHDOG=1");
    } else {
      log->Write(LogLevel::kWarning, "watchdog_not_answered",
                 {{"waited_ms", static_cast<std::int64_t>(period.count())}});
    }
  });
}

}  // namespace revisit::server
