// One method on one drive, through the service.
#ifndef REVISIT_CLIENT_EVALUATION_DRIVE_EVALUATOR_H_
#define REVISIT_CLIENT_EVALUATION_DRIVE_EVALUATOR_H_

#include <cstddef>
#include <cstdint>
#include <functional>
#include <memory>
#include <optional>
#include <string>
#include <vector>

#include "absl/status/statusor.h"
#include "client/evaluation/evaluation.h"
#include "client/evaluation/evaluation_report.h"
#include "client/evaluation/played_verifier.h"
#include "client/formats/drive_file.h"
#include "client/revisit/client.h"
#include "client/terminal/terminal.h"
#include "client/trajectory/dead_reckoning.h"
#include "client/trajectory/drive_poses.h"
#include "revisit/v1/vehicle.pb.h"

namespace grpc {
class Channel;
}

namespace revisit::client {

struct DriveRun {
  // The id and the settings of the vehicle that is made.
  std::string vehicle_id;
  v1::VehicleSettings settings;
  // The label of the progress.
  std::string label;
  // How answers are judged. Searches ask for its direction.
  Judging judging;
  // CandidateOptions.exhaustive.
  bool exhaustive = false;
  // Whether to play the verifier: an accepted first candidate that is right is
  // added as a loop closure, one that is wrong is rejected, before any pose
  // beyond the next check is sent. Checks and verdicts then follow each other
  // in one order, so that the result is the same every time.
  bool verify = false;
  // How the verifier errs; not with asking_from.
  VerifierErrors verifier_errors;
  // The seed of the drive; the verifier's draws depend on both.
  std::uint64_t seed = 0;
  // The first sample of the recording that asks, behind all others, whose
  // candidates in these alone count; 0 where there is one recording. Then a
  // verifier adds the first candidate that is right in each of the others, and
  // nothing else, and only checks behind the first one it has added count.
  std::size_t asking_from = 0;
  // If set, candidates of the recent path (Judging::excluded_nodes) are left
  // out and this many of the others kept, for methods that do not know it.
  std::optional<std::size_t> older_candidates;
};

// Streams the estimates of a drive with truth into a new vehicle and judges the
// answers. `created` is called as soon as the vehicle exists. A connection that
// breaks may lose answers; the drive is then streamed again from its start, to
// a new vehicle of the same name, so that figures are always those of an
// unbroken stream. UNAVAILABLE if it keeps breaking.
absl::StatusOr<DriveResult> EvaluateDrive(
    const std::shared_ptr<grpc::Channel>& channel, const Client& client,
    const Drive& drive, const std::vector<ClaimedUncertainty>& uncertainty,
    const RecordingsOfDrive& starts, const DriveRun& run,
    const std::function<void(const v1::Vehicle&)>& created,
    const Terminal& terminal);

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_EVALUATION_DRIVE_EVALUATOR_H_
