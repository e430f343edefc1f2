// Exit codes of the process, with the numbers of sysexits.h.
#ifndef REVISIT_SERVER_BASE_EXIT_CODE_H_
#define REVISIT_SERVER_BASE_EXIT_CODE_H_

#include "absl/status/status.h"

namespace revisit::server {

enum ExitCode {
  kExitOk = 0,
  kExitUsage = 64,
  kExitStoreDamaged = 65,
  kExitCannotListen = 69,
  kExitStoreInUse = 73,
  kExitStoreFailed = 74,
};

// The code for a store that could not be opened or read.
inline ExitCode ExitCodeOf(const absl::Status& status) {
  if (absl::IsInvalidArgument(status)) return kExitUsage;
  if (absl::IsDataLoss(status)) return kExitStoreDamaged;
  if (absl::IsFailedPrecondition(status)) return kExitStoreInUse;
  return kExitStoreFailed;
}

}  // namespace revisit::server

#endif  // REVISIT_SERVER_BASE_EXIT_CODE_H_
