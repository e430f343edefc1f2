// revisit evaluate
#ifndef REVISIT_CLIENT_CLI_EVALUATE_COMMAND_H_
#define REVISIT_CLIENT_CLI_EVALUATE_COMMAND_H_

#include <optional>
#include <string>
#include <vector>

#include "absl/status/status.h"
#include "client/cli/console.h"
#include "client/cli/dead_reckoning.h"
#include "client/cli/evaluation.h"
#include "revisit/v1/vehicle.pb.h"

namespace revisit::client {

struct EvaluateOptions {
  // Drive files with truth.
  std::vector<std::string> files;
  // Nothing: a private server is started and stopped.
  std::optional<std::string> server;
  // Of the vehicles that are made for the drives. PLANAR, DEAD_RECKONING or
  // INDEPENDENT, LOCAL.
  v1::VehicleSettings settings;
  UncertaintyOptions uncertainty;
  // `excluded_nodes` is made of `exclude_meters` and the node spacing.
  Judging judging;
  double exclude_meters = 150.0;
  // A line for each check.
  bool verbose = false;
  // Where to write the map of the drive; one file only.
  std::string map;
  // Keeps the vehicles on a server that is not private.
  bool keep_vehicles = false;
  // Id of the vehicle; one file only. Empty: made of the drive's name, and
  // unique.
  std::string vehicle;
};

// Streams the estimates of each drive into a vehicle of its own, with checks,
// and judges the answers against the truth, which never leaves this process.
//
// As JSON: {"drives": [...], "total": {...}}, each with drive, checks,
// true_loops, accepted, accepted_correct, top1_correct, top5_correct,
// precision, recall, f1, candidates_to_verify, loops_found,
// candidates_per_loop_found, query_ms_p50, query_ms_p99, poses,
// poses_per_second; null where there is nothing to divide by. With `verbose`
// each drive has check_list too.
absl::Status RunEvaluate(const EvaluateOptions& options,
                         const Console& console);

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_CLI_EVALUATE_COMMAND_H_
