// The log of who changed what: one line per call that makes, changes or removes
// something that people decide about, whether it was let in or not. Poses that
// are streamed or appended are no such decisions.
#ifndef REVISIT_SERVER_TELEMETRY_AUDIT_LOG_H_
#define REVISIT_SERVER_TELEMETRY_AUDIT_LOG_H_

#include <cstdint>
#include <initializer_list>
#include <memory>
#include <string>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "server/base/logging.h"

namespace revisit::server {

// Thread-safe.
class AuditLog {
 public:
  // Appends to a file, which is made for its owner alone (0600) if it is
  // missing. INVALID_ARGUMENT, with the reason, if it cannot be opened.
  static absl::StatusOr<std::unique_ptr<AuditLog>> Open(const std::string& path,
                                                        LogFormat format);
  ~AuditLog();

  AuditLog(const AuditLog&) = delete;
  AuditLog& operator=(const AuditLog&) = delete;

  // Whether calls of this method are written.
  static bool Covers(const std::string& method);

  void Write(std::initializer_list<LogField> fields) const;

  // Opens the file by its name again, for those who have renamed it. If that
  // fails, with INVALID_ARGUMENT, lines go where they went before.
  absl::Status Reopen();

  // How many lines were lost because the file took none.
  void CollectMetrics(Metrics* metrics) const {
    log_->CollectMetrics("audit", metrics);
  }

 private:
  AuditLog(std::string path, LogFormat format, int descriptor);

  const std::string path_;
  const int descriptor_;
  // Ends before the descriptor is closed.
  std::unique_ptr<Log> log_;
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_TELEMETRY_AUDIT_LOG_H_
