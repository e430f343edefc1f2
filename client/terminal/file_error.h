// Why a file of this machine cannot be read or written.
#ifndef REVISIT_CLIENT_TERMINAL_FILE_ERROR_H_
#define REVISIT_CLIENT_TERMINAL_FILE_ERROR_H_

#include <cerrno>
#include <string>

#include "absl/status/status.h"
#include "client/terminal/terminal.h"

namespace revisit::client {

// A local error (terminal.h) with the text of `error`, a value of errno, and
// the code that stands for it, such as RESOURCE_EXHAUSTED for a full disk. 0,
// where a stream did not tell, counts as EIO.
inline absl::Status FileError(const std::string& path, int error) {
  return LocalError(absl::ErrnoToStatus(error == 0 ? EIO : error, path));
}

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_TERMINAL_FILE_ERROR_H_
