// revisit watch
#ifndef REVISIT_CLIENT_CLI_COMMANDS_WATCH_COMMAND_H_
#define REVISIT_CLIENT_CLI_COMMANDS_WATCH_COMMAND_H_

#include <memory>
#include <string>

#include "absl/status/status.h"
#include "client/cli/flags.h"
#include "client/revisit/backoff.h"
#include "client/revisit/client.h"
#include "client/terminal/terminal.h"

namespace revisit::client {

void AddWatchCommand(const Command& program);

struct WatchOptions {
  // Vehicles in it are names.
  v1::CandidateFilter filter;
  // Keeps the cursor from run to run; empty where nothing does.
  std::string cursor_file;
  // Without a cursor: begins with the open candidates that there are.
  bool from_start = false;
  // A command of the shell that decides about each open candidate; empty where
  // nothing decides.
  std::string command;
  BackoffOptions backoff;
};

// Prints every event as a line of JSON as it comes: {"cursor",
// "resynchronised", and "candidate" or "vehicleDeleted"}. Events come at least
// once; the cursor is kept behind those that were worked off. OK if a signal
// ended it (InterruptGuard), once the event of the moment was worked off or
// left.
//
// A command that decides is given this line, and says by its exit code that the
// candidate is confirmed (0), rejected (10), or left as it is (20). Whatever
// else it ends with is an error, with the cursor before the event. A decision
// that comes too late, since another one was made or the candidate is no longer
// there, is told and left.
absl::Status RunWatch(const std::shared_ptr<grpc::Channel>& channel,
                      const Client& client, const WatchOptions& options,
                      const Terminal& terminal);

// The cursor that a file keeps; empty if there is no such file, or nothing in
// it.
absl::StatusOr<std::string> ReadCursorFile(const std::string& path);
// Replaces the file as a whole, or what it leads to if it is a link.
absl::Status WriteCursorFile(const std::string& path,
                             const std::string& cursor);

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_CLI_COMMANDS_WATCH_COMMAND_H_
