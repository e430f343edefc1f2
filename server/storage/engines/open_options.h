// Options that all engines take when they open a store to serve it.
#ifndef REVISIT_SERVER_STORAGE_ENGINES_OPEN_OPTIONS_H_
#define REVISIT_SERVER_STORAGE_ENGINES_OPEN_OPTIONS_H_

#include <chrono>
#include <cstddef>
#include <cstdint>
#include <functional>
#include <string>

#include "server/base/logging.h"
#include "server/settings/settings.h"

namespace revisit::server {

inline std::chrono::microseconds LatencyTarget(const ServerSettings& settings) {
  return std::chrono::microseconds(
      static_cast<std::int64_t>(settings.ack_latency_target_ms * 1000.0));
}

inline std::function<void(const std::string&)> WarnIn(const Log* log) {
  return [log](const std::string& message) {
    log->Write(LogLevel::kWarning, "store", {{"message", message}});
  };
}

}  // namespace revisit::server

#endif  // REVISIT_SERVER_STORAGE_ENGINES_OPEN_OPTIONS_H_
