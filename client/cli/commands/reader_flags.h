// The flags that say how recordings are read.
#ifndef REVISIT_CLIENT_CLI_COMMANDS_READER_FLAGS_H_
#define REVISIT_CLIENT_CLI_COMMANDS_READER_FLAGS_H_

#include "client/cli/flags.h"
#include "client/formats/reader.h"

namespace revisit::client {

void AddReaderFlags(const Command& command, ReaderOptions* options);

// The same flags for the truth of a drive, such as --truth-axes.
void AddTruthReaderFlags(const Command& command, ReaderOptions* options);

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_CLI_COMMANDS_READER_FLAGS_H_
