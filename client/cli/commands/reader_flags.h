// Flags that say how a recording is read.
#ifndef REVISIT_CLIENT_CLI_COMMANDS_READER_FLAGS_H_
#define REVISIT_CLIENT_CLI_COMMANDS_READER_FLAGS_H_

#include "client/cli/flags.h"
#include "client/formats/reader.h"

namespace revisit::client {

// `options` must live until the command has run.
void AddReaderFlags(const Command& command, ReaderOptions* options);

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_CLI_COMMANDS_READER_FLAGS_H_
