// How a stream of poses ends before all of them are durable: what is, and how
// to go on.
#ifndef REVISIT_CLIENT_CLI_COMMANDS_STREAM_END_H_
#define REVISIT_CLIENT_CLI_COMMANDS_STREAM_END_H_

#include <string>

#include "absl/status/status.h"
#include "client/revisit/pose_stream.h"
#include "client/terminal/interrupt_guard.h"
#include "client/terminal/terminal.h"

namespace revisit::client {

// An error of the stream, with the hint which of the vehicle's poses are
// durable and how to go on behind them: by the same command, or, if its poses
// were appended to others, with all recordings. OK stays OK.
absl::Status WithDurable(const absl::Status& status, const std::string& vehicle,
                         const PoseStream& stream, bool appended);

// While it lives, Ctrl-C (also SIGTERM and SIGHUP) takes no more poses, waits
// for two seconds at most until those that were taken are durable, reports as
// WithDurable() on standard error, and ends the process with code 130. Whoever
// appends poses meanwhile is told that the stream is finished, and must destroy
// this before anything is reported as done: the destructor does not return
// then.
class StreamInterrupt {
 public:
  // All must outlive this.
  StreamInterrupt(PoseStream* stream, const std::string& vehicle, bool appended,
                  const Terminal& terminal);

 private:
  const InterruptGuard guard_;
};

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_CLI_COMMANDS_STREAM_END_H_
