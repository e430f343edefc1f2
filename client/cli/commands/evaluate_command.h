// revisit evaluate
#ifndef REVISIT_CLIENT_CLI_COMMANDS_EVALUATE_COMMAND_H_
#define REVISIT_CLIENT_CLI_COMMANDS_EVALUATE_COMMAND_H_

#include <cstdint>
#include <optional>
#include <string>
#include <vector>

#include "absl/status/status.h"
#include "client/cli/console.h"
#include "client/cli/evaluation/dead_reckoning.h"
#include "client/cli/evaluation/evaluation.h"
#include "client/revisit/channel.h"
#include "revisit/v1/vehicle.pb.h"

namespace revisit::client {

struct EvaluateOptions {
  enum class Format {
    // DriveFormat::kDrive with truth.
    kDrive,
    // A receiver's solution, with a reference beside it: gnss_file.h. Its
    // vehicles are GEODETIC and claim the file's covariances as they are.
    kRtklib,
  };
  // Drive files.
  std::vector<std::string> files;
  Format format = Format::kDrive;
  // The truth of each file; kRtklib only.
  std::vector<std::string> truth_files;
  // All files are one drive of one vehicle, one after the other. They must be
  // in one frame.
  bool one_vehicle = false;
  // Nothing: a private server is started and stopped.
  std::optional<ChannelOptions> server;
  // Of the vehicles that are made for the drives. PLANAR, DEAD_RECKONING or
  // INDEPENDENT; the frame follows from the format. Every field is set.
  v1::VehicleSettings settings;
  UncertaintyOptions uncertainty;
  // `excluded_nodes` is made of `exclude_meters` and the node spacing.
  Judging judging;
  // CandidateOptions.exhaustive.
  bool exhaustive = false;
  double exclude_meters = 150.0;
  // Measures the baselines beside the settings.
  bool baselines = false;
  // Measures each of these in place of the settings' own; each then is the
  // excluded recent path too.
  std::vector<double> sequence_lengths;
  // Draws each drive's estimate anew, once for each of these.
  std::vector<std::uint64_t> seeds;
  // Tells the service which accepted candidates are right and which are wrong.
  bool verify = false;
  // Does everything this often, and insists on the same answers. At least 1.
  int repeats = 1;
  // A line for each check.
  bool verbose = false;
  // Where to write the map of the first drive.
  std::string map;
  // Directory for precision_recall.svg and reliability.svg; made if need be.
  std::string plots;
  // Keeps the vehicles on a server that is not private.
  bool keep_vehicles = false;
  // Id of the vehicle, where one only is made. Empty: made of the drive's name,
  // and unique.
  std::string vehicle;
};

// Streams the estimates of each drive into a vehicle of its own, with checks,
// and judges the answers against the truth, which never leaves this process.
//
// As JSON: {"drives": [...], "total": {...}, "methods": [...], "repeats",
// "notes"}. Each drive and total has drive, checks, true_loops, accepted,
// accepted_correct, top1_correct, top5_correct, precision, recall, f1, top1,
// recall_at_5, candidates_to_verify, loops_found, candidates_per_loop_found,
// expected_calibration_error, confirmed, rejected, jumps, query_ms_p50,
// query_ms_p99, poses, poses_per_second; null where there is nothing to divide
// by. Drives have seed and inflation too, null where there is none, and with
// `verbose` check_list. `drives` and `total` are those of the settings; each of
// `methods` has method, sequence_length_meters, drives, total, precision_recall
// (a list of threshold, precision, recall) and reliability (null, or a list of
// low, high, count, mean_stated, share_correct).
//
// ABORTED, as a fault of this machine, if a repeat answers otherwise.
absl::Status RunEvaluate(const EvaluateOptions& options,
                         const Console& console);

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_CLI_COMMANDS_EVALUATE_COMMAND_H_
