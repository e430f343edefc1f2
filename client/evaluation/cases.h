// The drives of an evaluation, read and made ready to be streamed.
#ifndef REVISIT_CLIENT_EVALUATION_CASES_H_
#define REVISIT_CLIENT_EVALUATION_CASES_H_

#include <cstdint>
#include <optional>
#include <vector>

#include "absl/status/statusor.h"
#include "client/evaluation/evaluate_options.h"
#include "client/formats/drive_file.h"
#include "client/trajectory/dead_reckoning.h"
#include "client/trajectory/drive_poses.h"

namespace revisit::client {

// A drive that is streamed, as it was recorded or drawn anew.
struct Case {
  Drive drive;
  // The seed of the draw; absent for a recorded drive.
  std::optional<std::uint64_t> seed;
  std::vector<ClaimedUncertainty> uncertainty;
  // The recordings that begin, by their first sample; none where the drive is
  // in one frame.
  RecordingsOfDrive starts;
  // The first sample of the recording that asks for places in the others; 0
  // where there is one recording.
  std::size_t asking_from = 0;
};

// Reads all files, so that a mistake in the last one shows before the first is
// streamed, and draws the estimates that are simulated. Settles what follows
// from the files: `geodetic`, and with it frame, correlation model and source
// of the uncertainty.
absl::StatusOr<std::vector<Case>> ReadCases(EvaluateOptions* options);

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_EVALUATION_CASES_H_
