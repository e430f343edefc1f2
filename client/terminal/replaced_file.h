// Files that are kept for a later run.
#ifndef REVISIT_CLIENT_TERMINAL_REPLACED_FILE_H_
#define REVISIT_CLIENT_TERMINAL_REPLACED_FILE_H_

#include <string>

#include "absl/status/status.h"

namespace revisit::client {

// Gives the text the name `path` once it is whole on the disk: whoever reads
// the file, also after a loss of power, has what it was or what it becomes.
// Its owner alone may read it. A link is replaced, not what it leads to.
absl::Status ReplaceFile(const std::string& path, const std::string& text);

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_TERMINAL_REPLACED_FILE_H_
