#include "server/base/library_log.h"

#include <google/protobuf/stubs/logging.h>
#include <grpc/support/log.h>

#include <atomic>
#include <string>

namespace revisit::server {
namespace {

std::atomic<const Log*> destination{nullptr};

void WriteGrpc(gpr_log_func_args* line) {
  const Log* const log = destination;
  if (log == nullptr) return;
  const LogLevel level =
      line->severity == GPR_LOG_SEVERITY_ERROR  ? LogLevel::kError
      : line->severity == GPR_LOG_SEVERITY_INFO ? LogLevel::kInfo
                                                : LogLevel::kDebug;
  log->Write(level, "grpc", {{"message", std::string(line->message)}});
}

// Protobuf's complaints are of level debug unless they end the process: callers
// can cause them by invalid messages, which are answered with errors.
void WriteProtobuf(google::protobuf::LogLevel level, const char*, int,
                   const std::string& message) {
  const Log* const log = destination;
  if (log == nullptr) return;
  log->Write(level == google::protobuf::LOGLEVEL_FATAL ? LogLevel::kError
                                                       : LogLevel::kDebug,
             "protobuf", {{"message", message}});
}

}  // namespace

LibraryLogRoute::LibraryLogRoute(const Log* log) {
  destination = log;
  gpr_set_log_function(WriteGrpc);
  google::protobuf::SetLogHandler(WriteProtobuf);
}

LibraryLogRoute::~LibraryLogRoute() { destination = nullptr; }

}  // namespace revisit::server
