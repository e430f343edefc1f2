#include "client/cli/grpc_log.h"

#include <grpc/support/log.h>

#include <cstdio>
#include <cstdlib>

#include "absl/strings/match.h"

namespace revisit::client {
namespace {

void WriteLastWords(gpr_log_func_args* line) {
  if (absl::StartsWith(line->message, "assertion failed: ")) {
    std::fprintf(stderr, "%s:%d: %s\n", line->file, line->line, line->message);
  }
}

}  // namespace

void SilenceGrpcLog() {
  if (std::getenv("GRPC_VERBOSITY") == nullptr) {
    gpr_set_log_function(WriteLastWords);
  }
}

}  // namespace revisit::client
