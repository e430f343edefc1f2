// revisit convert
#ifndef REVISIT_CLIENT_CLI_COMMANDS_CONVERT_COMMAND_H_
#define REVISIT_CLIENT_CLI_COMMANDS_CONVERT_COMMAND_H_

#include <string>
#include <vector>

#include "absl/status/status.h"
#include "client/cli/flags.h"
#include "client/formats/reader.h"
#include "client/terminal/terminal.h"
#include "client/trajectory/dead_reckoning.h"
#include "client/trajectory/recording_starts.h"
#include "revisit/v1/vehicle.pb.h"

namespace revisit::client {

void AddConvertCommand(const Command& program);

enum class ConvertFormat {
  // In the local frame, that of geodetic poses being East-North-Up at the
  // first of them: see trajectory_text.h and g2o_text.h.
  kCsv,
  kTum,
  kKitti,
  kG2o,
  // A line of protobuf JSON for each revisit.v1.Pose.
  kJsonLines,
  // Serialised revisit.v1.PoseBatch, each behind its size as a varint, as
  // protobuf's delimited messages are.
  kMessages,
};

struct ConvertOptions {
  // "-" is the standard input.
  std::vector<std::string> files;
  ReaderOptions reader;
  // `source` counts only where it was given; see
  // claim_choice.h.
  UncertaintyOptions uncertainty;
  bool uncertainty_given = false;
  // The settings of the vehicle that the poses are for. With FILTER, poses have
  // error transitions.
  v1::StateSpace state_space = v1::STATE_SPACE_PLANAR;
  v1::CorrelationModel correlation_model = v1::CORRELATION_MODEL_DEAD_RECKONING;
  // Where recordings begin, as StreamOptions.recording has it.
  RecordingChoice recording;
  ConvertFormat format = ConvertFormat::kCsv;
  // The poses go to the terminal if this is empty.
  std::string output;
};

// Writes the poses of recordings as `revisit stream` would send them: pose i of
// all files together gets sequence i. Asks no server. An existing file is
// replaced when the output is complete, and only then.
absl::Status RunConvert(const ConvertOptions& options,
                        const Terminal& terminal);

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_CLI_COMMANDS_CONVERT_COMMAND_H_
