// revisit stream
#ifndef REVISIT_CLIENT_CLI_COMMANDS_STREAM_COMMAND_H_
#define REVISIT_CLIENT_CLI_COMMANDS_STREAM_COMMAND_H_

#include <chrono>
#include <cstdint>
#include <memory>
#include <optional>
#include <string>

#include "absl/status/status.h"
#include "client/cli/console.h"
#include "client/cli/evaluation/dead_reckoning.h"
#include "client/cli/flags.h"
#include "client/formats/drive_file.h"
#include "client/revisit/client.h"

namespace grpc {
class Channel;
}

namespace revisit::client {

void AddStreamCommand(const Command& program);

struct StreamOptions {
  std::string file;
  DriveFormat format = DriveFormat::kDrive;
  std::string vehicle;
  UncertaintyOptions uncertainty;
  // Whether to create the vehicle if there is none, with `settings`. No flag
  // sets these: `revisit stream` leaves them to the server's defaults.
  bool create = false;
  v1::VehicleSettings settings;
  int batch_poses = 64;
  // Highest sequence that the caller knows to be durable; 0 for no record.
  std::uint64_t acked_sequence = 0;
  // The uid of the vehicle that is meant; empty for whichever has the name.
  std::string vehicle_uid;
  // Whether to print the candidates of each check that falls due.
  bool candidates = false;
  // How long to try without progress; for ever if absent.
  std::optional<std::chrono::milliseconds> give_up_after;
};

// Streams the estimates of a drive file: pose i of the file gets sequence i.
// Goes on where the vehicle's durable poses end, after the server has compared
// the last of these with the file's. Any truth in the file is not read.
absl::Status RunStream(const std::shared_ptr<grpc::Channel>& channel,
                       const StreamOptions& options, const Console& console);

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_CLI_COMMANDS_STREAM_COMMAND_H_
