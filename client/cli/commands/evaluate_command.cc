#include "client/cli/commands/evaluate_command.h"

#include <memory>
#include <string>
#include <utility>
#include <vector>

#include "absl/strings/str_cat.h"
#include "client/cli/commands/reader_flags.h"
#include "client/cli/commands/shared_flags.h"
#include "client/cli/commands/vehicle_settings.h"
#include "client/cli/connection_hint.h"
#include "client/evaluation/evaluate_options.h"
#include "client/evaluation/run_evaluation.h"
#include "client/evaluation/simulation.h"
#include "client/formats/angles.h"

namespace revisit::client {
namespace {

constexpr char kDetails[] =
    "Streams the estimates of each drive through the service; the truth is not "
    "sent. Unless\n--server, --context, or a variable of theirs names a "
    "server, a private one is\nstarted and stopped.\n\n"
    "A check is a true loop if a node before the excluded recent path lies "
    "within the loop\ndistance and loop heading of the current true pose; "
    "a candidate is right by the same\ntest, in the plane also for vehicles "
    "of --state-space spatial. Precision and recall count\nthe first candidate "
    "of a check, if its verdict is ACCEPTED:\n"
    "  precision   accepted and right / accepted\n"
    "  recall      accepted and right / true loops\n"
    "  P interval, R interval  precision and recall of what is accepted with "
    "an interval that\n              holds the place, wherever in it the "
    "candidate is\n"
    "  top-1       right in first place / true loops, verdict aside\n"
    "  recall@5    right among the first five / true loops, verdict aside\n"
    "  recall p>=0.9  right in first place and stated at 0.9 or more / true "
    "loops\n"
    "  verify/loop  accepted candidates of any rank / loops found by them\n"
    "  looks/loop  looks at them, each of 20 m of the interval in which the "
    "place may lie / loops\n              seen by these looks\n"
    "  ECE p>=0.1  expected calibration error of the probabilities that are "
    "stated at 0.1 or more\n"
    "  ECE         that of all, which is small where most checks are no loops\n"
    "  P 95%, R 95%, F1 95%, ECE 95%  where 95 of 100 such figures lie, by "
    "drawing blocks of\n              ten checks of the drives anew\n"
    "With --recordings, candidates in the recording that asks do not count, "
    "and "
    "there are two more:\n"
    "  new roads   checks at which no other recording has a road of this "
    "heading within 40 m\n"
    "  accepted there  how often the first candidate was accepted nevertheless";

constexpr char kExamples[] =
    "  revisit evaluate kitti_05.csv\n"
    "  revisit evaluate drives/*.csv --baselines --plots plots\n"
    "  revisit evaluate drives/*.csv --sequence-lengths 100,150,200,300,400\n"
    "  revisit evaluate drives/*.csv --simulate 1-5 --claimed-scale 0.5 "
    "--no-use-belief\n"
    "  revisit evaluate drives/*.csv --claimed-scales 0.25,0.5,1,2,4\n"
    "  revisit evaluate drives/*.csv --gyro-bias 0.01\n"
    "  revisit evaluate drives/*.csv --fix-noise 3,60 --simulate 1-5\n"
    "  revisit evaluate drive.csv --verbose --map map.svg\n"
    "  revisit evaluate hills.csv --simulate 1-5 --state-space spatial\n"
    "  revisit evaluate filtered.csv --correlation-model filter\n"
    "  revisit evaluate day1.pos day2.pos --one-vehicle "
    "--truth ref1.csv ref2.csv\n"
    "  revisit evaluate monday.csv tuesday.csv --one-vehicle "
    "--recordings datum:10m,1deg --verify\n"
    "  revisit evaluate slam.txt --axes camera --truth poses.txt --truth-axes "
    "camera --rate 10 --truth-rate 10";

// The options, and flags that FinishOptions() turns into options.
struct EvaluateFlags {
  EvaluateOptions options;
  std::string simulated_seeds;
  // Metres and, if there is a second number, seconds.
  std::vector<double> fix_noise;
  // Metres and degrees.
  std::vector<double> measured;
};

void AddInputsAndOutputs(const Command& command, EvaluateOptions* options) {
  command.AddTexts("FILE", "TEXT", &options->files, "Drive files with truth")
      .Required();
  command.AddTexts("--truth", "FILE", &options->truth_files,
                   "The truth of each FILE, where it is not in the file: any "
                   "format that is read, or a receiver's reference with "
                   "columns such as \"GPS TOW (s)\"; --truth-axes and so on "
                   "say how");
  command.AddSwitch("--one-vehicle", &options->one_vehicle,
                    "Stream all files into one vehicle, one after the other");
  command.AddText(
      "--recordings", "RELATION",
      [options](const std::string& text) -> std::string {
        RecordingChoice choice;
        if (std::string allowed = ReadRecordingChoice(text, &choice);
            !allowed.empty()) {
          return allowed;
        }
        if (choice.kind == RecordingChoice::Kind::kSame) {
          return "what --one-vehicle does without it; or after, datum, unknown";
        }
        options->recordings = choice;
        return "";
      },
      "With --one-vehicle: each file is a recording in a frame of its own, as "
      "--recording of revisit stream, and each is once the last one, which "
      "asks "
      "for places in the others; the truths are in one frame. With datum, "
      "datums are drawn about the true starts");
  command.AddWholeNumber("--seeds", {1, 1000}, &options->recording_draws,
                         "Draws of the datums of --recordings datum (3)");
  command.AddSwitch("--verbose", &options->verbose,
                    "Print each check's best candidate");
  command.AddText("--map", "FILE", &options->map,
                  "Draw the map of the drive (one drive only): a page for a "
                  "browser if the name ends in .html, otherwise SVG");
  command.AddText("--plots", "DIR", &options->plots,
                  "Draw precision_recall.svg and reliability.svg there");
  command
      .AddWholeNumber("--repeat", {1, 1000}, &options->repeats,
                      "Do it all N times, fail unless all answers are the "
                      "same, and time them all")
      .ShowDefault();
  command.AddSwitch("--keep-vehicles", &options->keep_vehicles,
                    "Leave the vehicles on the server that was named");
  command.AddText("--vehicle", "ID", &options->vehicle,
                  "Id of the vehicle to create, where there is one only; "
                  "otherwise ids are made up");
}

void AddMeasurements(const Command& command, EvaluateFlags* flags) {
  const Words directions = {
      {"same", static_cast<int>(PassDirection::kSame)},
      {"opposite", static_cast<int>(PassDirection::kOpposite)},
      {"either", static_cast<int>(PassDirection::kEither)}};
  EvaluateOptions* const options = &flags->options;
  const Command group = command.Under("What is measured");
  group.AddSwitch("--baselines", &options->baselines,
                  "Beside the settings: nearest position, single pose, and the "
                  "paper's alignment without and with cross-covariance");
  group.AddPositiveNumbers(
      "--sequence-lengths", "M,M,...", &options->sequence_lengths,
      "Each of these instead of --sequence-length; each is the excluded recent "
      "path too");
  group.AddSwitch("--exhaustive", &options->exhaustive,
                  "Let searches look at all of history, and answer also what "
                  "is too improbable to be accepted");
  group.AddChoice("--direction", directions, &options->judging.direction,
                  "Which way the vehicle may have passed before (same)");
  group.AddText("--simulate", "SEEDS", &flags->simulated_seeds,
                "Draw each drive's estimate anew from the noise below along "
                "its truth (height: column gt_z), once for each seed, such as "
                "1-5");
  group.AddNumber(
      "--gyro-bias", "DEG_PER_S",
      [options](double degrees) {
        options->gyro_bias = degrees * kRadiansPerDegree;
      },
      "Add this error to the rate of each estimate's heading");
  group.AddPositiveNumbers(
      "--fix-noise", "M[,S]", &flags->fix_noise,
      "Instead of estimates, fixes drawn each second along the truth: standard "
      "deviation in x and y, and the seconds over which errors are correlated; "
      "claimed as independent unless --correlation-model says otherwise. "
      "--simulate has the seeds (1)");
  group.AddSwitch(
      "--verify", &options->verify,
      "Play the verifier: tell the service which accepted first "
      "candidates are right and which are wrong; with --recordings, "
      "of the first right one in each other recording alone, and "
      "count checks from then on");
  VerifierErrors* const errors = &options->verifier_errors;
  group.AddNumber("--verify-wrong", "SHARE", &errors->wrong,
                  "With --verify: the share of candidates of which the "
                  "opposite of the truth is said");
  group.AddNumber("--verify-silent", "SHARE", &errors->silent,
                  "With --verify: the share of candidates of which nothing is "
                  "said");
  group.AddPositiveNumbers(
      "--verify-measured", "M,DEG", &flags->measured,
      "With --verify: closures say how the poses lie to each other, with these "
      "standard deviations of noise, which are stated");
}

void AddJudging(const Command& command, EvaluateOptions* options) {
  Judging* const judging = &options->judging;
  const Command group = command.Under("Judging");
  group.AddNumber("--first-check", "M", &judging->first_check_meters,
                  "Earlier checks do not count; before two sequence lengths "
                  "there are none");
  group.AddSwitch("--only-revisited", &judging->only_revisited,
                  "Checks before the first true loop do not count, so that "
                  "figures are about a route that has been driven once");
  group.AddNumber("--exclude", "M", &options->exclude_meters,
                  "Recent path that is no history");
  group.AddNumber("--loop-distance", "M", &judging->loop_distance_meters,
                  "One place: true positions this near");
  group.AddNumber(
      "--loop-heading-degrees", "DEG",
      [judging](double degrees) {
        judging->loop_heading_radians = degrees * kRadiansPerDegree;
      },
      "One place: true headings this near (45)");
}

// Names what is wrong with the truth; empty if nothing is.
std::string CheckTruth(const EvaluateOptions& options) {
  return options.truth_files.empty() ||
                 options.truth_files.size() == options.files.size()
             ? ""
             : "--truth: expected one for each FILE";
}

// Names what is wrong with the recordings; empty if nothing is.
std::string CheckRecordings(const Command& command,
                            const EvaluateFlags& flags) {
  const EvaluateOptions& options = flags.options;
  if (!options.recordings.has_value()) {
    return command.Given("--seeds") ? "--seeds: goes with --recordings datum"
                                    : "";
  }
  if (!options.one_vehicle || options.files.size() < 2) {
    return "--recordings: goes with --one-vehicle and two files or more";
  }
  if (command.Given("--seeds") &&
      options.recordings->kind != RecordingChoice::Kind::kDatum) {
    return "--seeds: goes with --recordings datum, since nothing else is drawn";
  }
  for (const char* other :
       {"--baselines", "--simulate", "--fix-noise", "--map", "--vehicle"}) {
    if (command.Given(other)) {
      return absl::StrCat("--recordings: does not go with ", other);
    }
  }
  return "";
}

std::string CheckNumberOfDrives(const EvaluateOptions& options) {
  const bool one_drive = (options.files.size() == 1 || options.one_vehicle) &&
                         options.seeds.size() <= 1;
  if (!options.map.empty() && !one_drive) return "--map: takes one drive only";
  const bool one_vehicle = one_drive && !options.baselines &&
                           options.repeats <= 1 &&
                           options.sequence_lengths.size() <= 1 &&
                           options.claimed_scales.size() <= 1;
  if (!options.vehicle.empty() && !one_vehicle) {
    return "--vehicle: goes with what takes one vehicle only";
  }
  return "";
}

// Names what is wrong with the errors that are added or drawn; empty if nothing
// is.
std::string CheckErrorModels(const Command& command,
                             const EvaluateFlags& flags) {
  const EvaluateOptions& options = flags.options;
  if (options.gyro_bias != 0.0 &&
      options.uncertainty.source != UncertaintyOptions::Source::kModel) {
    return "--gyro-bias: goes with --uncertainty model only";
  }
  if (flags.fix_noise.empty()) return "";
  if (flags.fix_noise.size() > 2) {
    return "--fix-noise: expected metres, or metres and seconds, such as 3,60";
  }
  if (options.gyro_bias != 0.0) {
    return "--fix-noise: does not go with --gyro-bias, since fixes take their "
           "heading from the truth";
  }
  if (options.settings.state_space() == v1::STATE_SPACE_SPATIAL) {
    return "--fix-noise: does not go with --state-space spatial, since fixes "
           "are drawn in the plane";
  }
  if (command.Given("--uncertainty")) {
    return "--fix-noise: does not go with --uncertainty, since fixes bring "
           "their own";
  }
  return "";
}

// Names what is wrong with the verifier; empty if nothing is.
std::string CheckVerifier(const Command& command, const EvaluateFlags& flags) {
  const EvaluateOptions& options = flags.options;
  for (const char* name :
       {"--verify-wrong", "--verify-silent", "--verify-measured"}) {
    if (!command.Given(name)) continue;
    if (!options.verify) return absl::StrCat(name, ": goes with --verify");
    if (options.recordings.has_value()) {
      return absl::StrCat(name,
                          ": does not go with --recordings, where the verifier "
                          "says of each recording where it lies");
    }
  }
  const auto check_share = [](const char* name, double share) -> std::string {
    if (share >= 0.0 && share <= 1.0) return "";
    return absl::StrCat(name, ": expected a share in [0, 1], such as 0.1; got ",
                        share);
  };
  const VerifierErrors& errors = options.verifier_errors;
  std::string problem = check_share("--verify-wrong", errors.wrong);
  if (problem.empty()) problem = check_share("--verify-silent", errors.silent);
  if (!problem.empty() || flags.measured.empty()) return problem;
  if (flags.measured.size() != 2) {
    return "--verify-measured: expected metres and degrees, such as 0.5,1";
  }
  if (options.settings.state_space() == v1::STATE_SPACE_SPATIAL) {
    return "--verify-measured: does not go with --state-space spatial, since "
           "the truth is judged in the plane";
  }
  return "";
}

// Names what is wrong with the claimed scales; empty if nothing is.
std::string CheckScales(const Command& command,
                        const EvaluateOptions& options) {
  if (!(options.uncertainty.claimed_scale > 0.0)) {
    return "--claimed-scale: must be positive";
  }
  if (options.claimed_scales.empty()) return "";
  if (command.Given("--claimed-scale")) {
    return "--claimed-scales: stands in place of --claimed-scale; give one of "
           "the two";
  }
  if (!options.sequence_lengths.empty()) {
    return "--claimed-scales: does not go with --sequence-lengths; sweep one "
           "of the two at a time";
  }
  return "";
}

// Turns what is left of the flags into options and returns what is wrong with
// all of them together; empty if nothing is.
std::string FinishOptions(const Command& command, EvaluateFlags* flags) {
  EvaluateOptions& options = flags->options;
  if (!flags->simulated_seeds.empty()) {
    auto seeds = ParseSeeds(flags->simulated_seeds);
    if (!seeds.ok()) {
      return absl::StrCat("--simulate: ", seeds.status().message());
    }
    options.seeds = *std::move(seeds);
    if (options.uncertainty.source != UncertaintyOptions::Source::kModel) {
      return "--simulate: goes with --uncertainty model only";
    }
  }
  std::string problem = CheckErrorModels(command, *flags);
  if (problem.empty()) problem = CheckTruth(options);
  if (problem.empty()) problem = CheckRecordings(command, *flags);
  if (problem.empty()) problem = CheckNumberOfDrives(options);
  if (problem.empty()) problem = CheckVerifier(command, *flags);
  if (!problem.empty()) return problem;
  if (!flags->measured.empty()) {
    options.verifier_errors.measured = MeasurementNoise{
        flags->measured[0], flags->measured[1] * kRadiansPerDegree};
  }
  if (!flags->fix_noise.empty()) {
    options.fix_noise.emplace();
    options.fix_noise->meters = flags->fix_noise[0];
    if (flags->fix_noise.size() > 1) {
      options.fix_noise->correlation_seconds = flags->fix_noise[1];
    }
  }
  options.uncertainty_given = command.Given("--uncertainty");
  options.correlation_given = command.Given("--correlation-model");
  if (!(options.settings.node_spacing_meters() > 0.0)) {
    return "--node-spacing: must be positive";
  }
  return CheckScales(command, options);
}

}  // namespace

void AddEvaluateCommand(const Command& program,
                        const ConnectionFlags* connection) {
  const Command command = program.AddCommand(
      {"evaluate",
       "Measures candidates on recorded drives whose truth is known.", kDetails,
       kExamples});
  const auto flags = std::make_shared<EvaluateFlags>();
  EvaluateOptions* const options = &flags->options;
  AddInputsAndOutputs(command, options);
  AddReaderFlags(command, &options->reader);
  AddTruthReaderFlags(command, &options->truth_reader);
  AddMeasurements(command, flags.get());
  AddJudging(command, options);
  AddDriveSettings(command, &options->settings);
  AddUncertainty(command, &options->uncertainty);
  const Command claims = command.Under("Claimed uncertainty");
  claims.AddNumber("--claimed-scale", "FACTOR",
                   &options->uncertainty.claimed_scale,
                   "Claim every standard deviation this many times as large");
  claims.AddPositiveNumbers("--claimed-scales", "FACTOR,...",
                            &options->claimed_scales,
                            "Each of these instead of --claimed-scale, with a "
                            "row for each that holds all drives");
  const Check check = [command, flags] {
    return FinishOptions(command, flags.get());
  };
  const RunAlone run = [program, flags, connection](const Terminal& terminal) {
    // A current context alone is no wish to fill that server with drives.
    if (!program.Given("--server") && !program.Given("--context")) {
      return RunEvaluate(flags->options, terminal);
    }
    const auto server = ChooseServer(program, *connection);
    if (!server.ok()) return server.status();
    if (const auto channel = MakeChannelTo(*server); !channel.ok()) {
      return channel.status();
    }
    flags->options.server = server->options;
    const absl::Status status = RunEvaluate(flags->options, terminal);
    const std::string hint = ConnectionHint(status, *server);
    return hint.empty() ? status : WithHint(status, hint);
  };
  command.RunsAlone(run, check);
}

}  // namespace revisit::client
