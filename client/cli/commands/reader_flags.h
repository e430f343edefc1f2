// The flags that say how recordings are read.
#ifndef REVISIT_CLIENT_CLI_COMMANDS_READER_FLAGS_H_
#define REVISIT_CLIENT_CLI_COMMANDS_READER_FLAGS_H_

#include "client/cli/flags.h"
#include "client/formats/reader.h"
#include "client/trajectory/recording_starts.h"

namespace revisit::client {

void AddReaderFlags(const Command& command, ReaderOptions* options);

// --recording, which says how the frames of recordings lie that each file but
// the first begins.
void AddRecording(const Command& command, RecordingChoice* choice);

// The same flags for the truth of a drive, such as --truth-axes.
void AddTruthReaderFlags(const Command& command, ReaderOptions* options);

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_CLI_COMMANDS_READER_FLAGS_H_
