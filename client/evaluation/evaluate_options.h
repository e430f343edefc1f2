// The measurements of an evaluation, and where its results go.
#ifndef REVISIT_CLIENT_EVALUATION_EVALUATE_OPTIONS_H_
#define REVISIT_CLIENT_EVALUATION_EVALUATE_OPTIONS_H_

#include <cstdint>
#include <functional>
#include <optional>
#include <string>
#include <vector>

#include "absl/status/status.h"
#include "client/evaluation/evaluation.h"
#include "client/evaluation/played_verifier.h"
#include "client/evaluation/simulation.h"
#include "client/formats/reader.h"
#include "client/revisit/channel.h"
#include "client/trajectory/dead_reckoning.h"
#include "client/trajectory/recording_starts.h"
#include "revisit/v1/vehicle.pb.h"

namespace revisit::client {

struct EvaluateOptions {
  // Drive files, and how to read them.
  std::vector<std::string> files;
  ReaderOptions reader;
  // The truth of each file, in any format that is read or as
  // truth_file.h, and how to read it; if there are none, the files have it.
  std::vector<std::string> truth_files;
  ReaderOptions truth_reader;
  // Lines of the report about the files, found out when these are read.
  std::vector<std::string> file_notes;
  // Whether the files hold fixes of a receiver: found out when they are read.
  // Vehicles are then GEODETIC, their errors INDEPENDENT and claimed as the
  // file states them, unless flags say otherwise. FILTER claims as the file
  // states too.
  bool geodetic = false;
  bool uncertainty_given = false;
  bool correlation_given = false;
  // Whether all files are one drive of one vehicle, one after the other. They
  // must be in one frame.
  bool one_vehicle = false;
  // If set, with `one_vehicle`: each file is a recording in a frame of its own,
  // of which so much is known, and each of them once the last one, which asks
  // for places in the others. The truths of all files are in one frame. kAfter,
  // kDatum or kUnknown.
  std::optional<RecordingChoice> recordings;
  // Draws of the datums of kDatum, with the seeds 1, 2, ...
  int recording_draws = 3;
  // Where vehicles are made. If absent, a private server is started and
  // stopped.
  std::optional<ChannelOptions> server;
  // The settings of the vehicles that are made for the drives; the frame
  // follows from the files. Every field is set.
  v1::VehicleSettings settings;
  UncertaintyOptions uncertainty;
  // `excluded_nodes` follows from `exclude_meters` and the node spacing.
  Judging judging;
  // CandidateOptions.exhaustive.
  bool exhaustive = false;
  double exclude_meters = 150.0;
  // Whether to measure the baselines beside the settings.
  bool baselines = false;
  // Measured one after the other in place of the settings' own, each of them
  // also as the length of the excluded recent path.
  std::vector<double> sequence_lengths;
  // Measured one after the other in place of `uncertainty.claimed_scale`, which
  // is then 1. Not together with `sequence_lengths`.
  std::vector<double> claimed_scales;
  // Each drive's estimate is drawn anew for each of these; if there are none,
  // it is streamed as it is.
  std::vector<std::uint64_t> seeds;
  // Error of the rate of each estimate's heading, radians per second, added to
  // what was recorded or drawn.
  double gyro_bias = 0.0;
  // If set, estimates are fixes drawn along the truth with these errors, once
  // for each of `seeds` or with seed 1; claimed as the fixes state them and,
  // unless flags say otherwise, INDEPENDENT.
  std::optional<FixNoise> fix_noise;
  // Whether to tell the service which accepted candidates are right and which
  // are wrong. With `recordings`: the first that is right in each of the others
  // alone, and only checks behind the first of these count.
  bool verify = false;
  // How this verifier errs; without `recordings`.
  VerifierErrors verifier_errors;
  // How often everything is done, with the same answers each time. At least 1.
  int repeats = 1;
  // Whether to print a line for each check.
  bool verbose = false;
  // Where to write the map of the first drive; no map if empty.
  std::string map;
  // Directory for precision_recall.svg and reliability.svg, made where there is
  // none; no plots if empty.
  std::string plots;
  // Whether to keep the vehicles; a private server takes them along when it
  // stops.
  bool keep_vehicles = false;
  // Called with the server's address after everything has been printed, before
  // a private server is stopped; an error is that of the evaluation. May be
  // empty.
  std::function<absl::Status(const std::string&)> before_undoing;
  // Id of the vehicle, where only one is made. If empty, ids are made of the
  // drives' names, and unique.
  std::string vehicle;
};

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_EVALUATION_EVALUATE_OPTIONS_H_
