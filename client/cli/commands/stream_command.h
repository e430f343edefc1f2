// revisit stream
#ifndef REVISIT_CLIENT_CLI_COMMANDS_STREAM_COMMAND_H_
#define REVISIT_CLIENT_CLI_COMMANDS_STREAM_COMMAND_H_

#include <chrono>
#include <cstdint>
#include <memory>
#include <optional>
#include <string>
#include <vector>

#include "absl/status/status.h"
#include "client/cli/flags.h"
#include "client/formats/reader.h"
#include "client/revisit/client.h"
#include "client/terminal/terminal.h"
#include "client/trajectory/dead_reckoning.h"
#include "client/trajectory/recording_starts.h"
#include "revisit/v1/candidate.pb.h"

namespace grpc {
class Channel;
}

namespace revisit::client {

void AddStreamCommand(const Command& program);

struct StreamOptions {
  // "-" is the standard input.
  std::vector<std::string> files;
  ReaderOptions reader;
  std::string vehicle;
  // `uncertainty.source` counts only where it was given. Otherwise fixes, and
  // what goes to a vehicle with error transitions, are claimed as the file
  // states them, and so are covariances that grow along the drive; all else is
  // claimed by the model.
  UncertaintyOptions uncertainty;
  bool uncertainty_given = false;
  // Where recordings begin, and what is known of their frames. Of geodetic
  // vehicles it is kByPoses or kSame.
  RecordingChoice recording;
  // Whether to create the vehicle if there is none, with `settings`, the frame
  // of the files, and INDEPENDENT errors for fixes unless `settings` has a
  // correlation model.
  bool create = false;
  v1::VehicleSettings settings;
  // Whether the files' poses follow the durable ones, in place of being them.
  bool append = false;
  // Name under which the vehicle's labels keep the range of these poses; empty
  // for none.
  std::string session;
  int batch_poses = 64;
  // Highest sequence that the caller knows to be durable; 0 for no record.
  std::uint64_t acked_sequence = 0;
  // The uid of the vehicle that is meant; empty for whichever has the name.
  std::string vehicle_uid;
  // Whether to print the candidates of each check that falls due, and how they
  // are looked for.
  bool candidates = false;
  v1::CandidateOptions candidate_options;
  // How long to try without progress; for ever if absent.
  std::optional<std::chrono::milliseconds> give_up_after;
};

// Streams the estimates of recordings as they are read: pose i of all files
// together gets sequence i, and so does pose i of a pipe. Goes on where the
// vehicle's durable poses end, after the server has compared the last of these
// with the files'; with `append`, the first pose gets the next sequence and
// nothing is compared. Any truth in the files is not sent. Where a recording
// begins, its first pose says so (Pose.recording_start), and its errors are
// claimed anew.
//
// The first few thousand samples, or what a pipe brings at once, are held back
// until they have been looked at: what is suspicious then creates no vehicle
// and sends nothing.
absl::Status RunStream(const std::shared_ptr<grpc::Channel>& channel,
                       const StreamOptions& options, const Terminal& terminal);

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_CLI_COMMANDS_STREAM_COMMAND_H_
