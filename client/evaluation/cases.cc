#include "client/evaluation/cases.h"

#include <cstddef>
#include <string>
#include <utility>

#include "absl/strings/str_cat.h"
#include "client/evaluation/simulation.h"
#include "client/formats/truth_file.h"
#include "client/terminal/terminal.h"
#include "client/trajectory/recording_starts.h"

namespace revisit::client {
namespace {

// The first position of a file, where local coordinates of fixes begin; nothing
// if positions are local already.
absl::StatusOr<std::optional<GeodeticPosition>> OriginOf(
    const std::string& file, const ReaderOptions& options) {
  ReaderOptions first = options;
  first.keep_without_heading = true;
  const auto reader = OpenSamples(file, first);
  if (!reader.ok()) return reader.status();
  const auto sample = (*reader)->Next();
  if (!sample.ok()) return sample.status();
  return (*sample)->geodetic;
}

// Adds lines to the report on the poses and positions that a drive lost.
void NoteLeftOut(const Drive& drive, const WithoutTruth& without,
                 std::vector<std::string>* notes) {
  const auto trimmed = [&](std::size_t poses, double seconds,
                           const char* where) {
    if (poses == 0) return;
    notes->push_back(absl::StrCat(drive.name, ": ", poses, " poses, ",
                                  Fixed(seconds, 1), " s, ", where,
                                  " are left out."));
  };
  trimmed(without.poses_before, without.seconds_before,
          "before the truth begins");
  trimmed(without.poses_after, without.seconds_after, "after the truth ends");
  if (drive.left_out.standing > 0) {
    notes->push_back(absl::StrCat(drive.name, ": ", drive.left_out.standing,
                                  " positions at which the vehicle stood are "
                                  "left out."));
  }
  if (drive.left_out.wrong_checksums > 0) {
    notes->push_back(absl::StrCat(drive.name, ": ",
                                  drive.left_out.wrong_checksums,
                                  " sentences with a wrong checksum are left "
                                  "out."));
  }
}

absl::StatusOr<Drive> ReadOne(const EvaluateOptions& options, std::size_t i,
                              const std::optional<GeodeticPosition>& origin,
                              std::vector<std::string>* notes) {
  ReaderOptions reader = options.reader;
  reader.origin = origin;
  auto drive = ReadDriveFile(options.files[i], reader);
  if (!drive.ok()) return drive;
  WithoutTruth without;
  if (!options.truth_files.empty()) {
    const auto truth =
        ReadTruth(options.truth_files[i], options.truth_reader, origin);
    if (!truth.ok()) return truth.status();
    const auto added = AddTruth(*truth, &*drive);
    if (!added.ok()) return added.status();
    without = *added;
  }
  NoteLeftOut(*drive, without, notes);
  if (drive->truth.empty()) {
    return absl::InvalidArgumentError(
        absl::StrCat(options.files[i],
                     ": expected the truth, which an evaluation needs: the "
                     "columns gt_x, gt_y, gt_yaw, or --truth FILE"));
  }
  return drive;
}

absl::StatusOr<std::vector<Drive>> ReadDrives(const EvaluateOptions& options,
                                              std::vector<std::string>* notes) {
  std::vector<Drive> drives;
  std::optional<GeodeticPosition> origin;
  for (std::size_t i = 0; i < options.files.size(); ++i) {
    if (!origin.has_value() || !options.one_vehicle) {
      const auto first = OriginOf(options.files[i], options.reader);
      if (!first.ok()) return first.status();
      origin = *first;
    }
    auto drive = ReadOne(options, i, origin, notes);
    if (!drive.ok()) return drive.status();
    const auto& samples = drive->samples;
    if (!drives.empty() && samples.front().geodetic.has_value() !=
                               drives.front().samples[0].geodetic.has_value()) {
      return absl::InvalidArgumentError(absl::StrCat(
          options.files[i],
          ": expected the same kind of positions as in the first file"));
    }
    drives.push_back(*std::move(drive));
  }
  return drives;
}

// One drive after the other, as one.
Drive Join(std::vector<Drive> drives) {
  Drive all = std::move(drives[0]);
  for (std::size_t i = 1; i < drives.size(); ++i) {
    absl::StrAppend(&all.name, "+", drives[i].name);
    all.samples.insert(all.samples.end(), drives[i].samples.begin(),
                       drives[i].samples.end());
    all.truth.insert(all.truth.end(), drives[i].truth.begin(),
                     drives[i].truth.end());
  }
  return all;
}

bool IsFilter(const EvaluateOptions& options) {
  return options.settings.correlation_model() == v1::CORRELATION_MODEL_FILTER;
}

// An error unless each sample behind the first has an error transition for a
// vehicle of FILTER, and the vehicle is planar, as those of files are.
absl::Status CheckTransitions(const EvaluateOptions& options,
                              const Drive& drive) {
  if (!IsFilter(options)) return absl::OkStatus();
  if (options.settings.state_space() == v1::STATE_SPACE_SPATIAL) {
    return absl::InvalidArgumentError(
        "--correlation-model filter: goes with --state-space planar, since "
        "files have the error transitions of planar vehicles");
  }
  for (std::size_t i = 1; i < drive.samples.size(); ++i) {
    if (drive.samples[i].error_transition.has_value()) continue;
    return absl::InvalidArgumentError(absl::StrCat(
        drive.name,
        ": expected an error transition with every pose, as --correlation-model"
        " filter needs (columns fxx, fxy, fxt, fyx, fyy, fyt, ftx, fty, ftt); "
        "estimates that are drawn anew have none"));
  }
  return absl::OkStatus();
}

// The start that a drive's recording brings; nothing where it is the first one
// and has no datum.
std::optional<v1::RecordingStart> StartOf(const EvaluateOptions& options,
                                          const Drive& drive, bool is_first,
                                          std::uint64_t seed) {
  const RecordingChoice& choice = *options.recordings;
  const bool has_datum = choice.kind == RecordingChoice::Kind::kDatum;
  if (is_first && !has_datum) return std::nullopt;
  v1::RecordingStart start =
      MakeRecordingStart(choice, drive.name, options.settings.state_space());
  if (!has_datum) return start;
  const PlanarPose datum =
      DrawDatum(drive, choice.size->meters, choice.size->radians, seed);
  v1::StatePose* const pose = start.mutable_datum()->mutable_pose();
  pose->set_x_meters(datum.x);
  pose->set_y_meters(datum.y);
  pose->set_heading_radians(datum.heading);
  return start;
}

// The drives as recordings of one vehicle, of which this one is the last.
absl::StatusOr<Case> MakeRecordings(const EvaluateOptions& options,
                                    const std::vector<Drive>& drives,
                                    std::size_t asking, std::uint64_t seed) {
  std::vector<std::size_t> order;
  for (std::size_t i = 0; i < drives.size(); ++i) {
    if (i != asking) order.push_back(i);
  }
  order.push_back(asking);
  Case made;
  made.drive.name = drives[asking].name;
  for (const std::size_t i : order) {
    const Drive& drive = drives[i];
    const std::size_t first = made.drive.samples.size();
    if (i == asking) made.asking_from = first;
    if (auto start = StartOf(options, drive, first == 0, seed)) {
      made.starts[first] = *std::move(start);
    }
    const auto claims = ClaimUncertainty(drive, options.uncertainty);
    if (!claims.ok()) return claims.status();
    made.uncertainty.insert(made.uncertainty.end(), claims->begin(),
                            claims->end());
    made.drive.samples.insert(made.drive.samples.end(), drive.samples.begin(),
                              drive.samples.end());
    made.drive.truth.insert(made.drive.truth.end(), drive.truth.begin(),
                            drive.truth.end());
  }
  return made;
}

// Each drive once as the one that asks, for each draw.
absl::StatusOr<std::vector<Case>> MakeAllRecordings(
    const EvaluateOptions& options, std::vector<Drive> drives) {
  std::vector<Case> cases;
  for (Drive& drive : drives) {
    if (options.gyro_bias != 0.0) AddGyroBias(options.gyro_bias, &drive);
    const absl::Status transitions = CheckTransitions(options, drive);
    if (!transitions.ok()) return transitions;
  }
  const bool draws = options.recordings->kind == RecordingChoice::Kind::kDatum;
  for (std::size_t asking = 0; asking < drives.size(); ++asking) {
    for (int seed = 1; seed <= (draws ? options.recording_draws : 1); ++seed) {
      auto made = MakeRecordings(options, drives, asking,
                                 static_cast<std::uint64_t>(seed));
      if (!made.ok()) return made.status();
      if (draws) made->seed = seed;
      cases.push_back(*std::move(made));
    }
  }
  return cases;
}

void Settle(const std::vector<Drive>& drives, EvaluateOptions* options) {
  options->geodetic = drives[0].samples[0].geodetic.has_value();
  if (options->geodetic) {
    options->settings.set_coordinate_frame(v1::COORDINATE_FRAME_GEODETIC);
  } else if (!options->fix_noise.has_value() && !IsFilter(*options)) {
    return;
  }
  if (!options->uncertainty_given) {
    options->uncertainty.source = UncertaintyOptions::Source::kFixes;
  }
  if (!options->correlation_given &&
      options->uncertainty.source == UncertaintyOptions::Source::kFixes) {
    options->settings.set_correlation_model(v1::CORRELATION_MODEL_INDEPENDENT);
  }
}

// Says that the model is claimed where the files have claims of their own.
void NoteUnusedCovariances(const std::vector<Drive>& drives,
                           EvaluateOptions* options) {
  const bool drawn = !options->seeds.empty() || options->fix_noise.has_value();
  if (options->uncertainty_given || drawn ||
      options->uncertainty.source != UncertaintyOptions::Source::kModel) {
    return;
  }
  for (const Drive& drive : drives) {
    if (!drive.samples.front().covariance.has_value()) continue;
    options->file_notes.push_back(
        "Claimed: errors of dead reckoning by the model; the covariances that "
        "files have are claimed with --uncertainty file.");
    return;
  }
}

// Adds a drive as it is, or as it is drawn with each seed.
void AddCases(const EvaluateOptions& options, Drive drive,
              std::vector<Case>* cases) {
  std::vector<std::uint64_t> seeds = options.seeds;
  if (seeds.empty() && options.fix_noise.has_value()) seeds = {1};
  if (seeds.empty()) {
    Case recorded;
    recorded.drive = std::move(drive);
    cases->push_back(std::move(recorded));
    return;
  }
  for (const std::uint64_t seed : seeds) {
    Case drawn;
    drawn.drive = options.fix_noise.has_value()
                      ? SimulateFixes(drive, *options.fix_noise, seed)
                      : SimulateDeadReckoning(drive, options.uncertainty, seed);
    drawn.seed = seed;
    cases->push_back(std::move(drawn));
  }
}

}  // namespace

absl::StatusOr<std::vector<Case>> ReadCases(EvaluateOptions* options) {
  auto read = ReadDrives(*options, &options->file_notes);
  if (!read.ok()) return LocalError(read.status());
  std::vector<Drive> drives = *std::move(read);
  Settle(drives, options);
  NoteUnusedCovariances(drives, options);
  if (options->geodetic) {
    const char* const flag = !options->seeds.empty()          ? "--simulate"
                             : options->gyro_bias != 0.0      ? "--gyro-bias"
                             : options->fix_noise.has_value() ? "--fix-noise"
                                                              : nullptr;
    if (flag != nullptr) {
      return LocalError(absl::InvalidArgumentError(absl::StrCat(
          flag, " goes with local positions; --frame local makes them")));
    }
  }
  if (options->recordings.has_value()) {
    if (options->geodetic) {
      return LocalError(absl::InvalidArgumentError(
          "--recordings: geodetic positions are in one frame whatever was "
          "recorded when; --frame local makes others"));
    }
    auto recordings = MakeAllRecordings(*options, std::move(drives));
    if (!recordings.ok()) return LocalError(recordings.status());
    return recordings;
  }
  if (options->one_vehicle) drives = {Join(std::move(drives))};
  std::vector<Case> cases;
  for (Drive& drive : drives) AddCases(*options, std::move(drive), &cases);
  for (Case& one : cases) {
    if (options->gyro_bias != 0.0) AddGyroBias(options->gyro_bias, &one.drive);
    const absl::Status transitions = CheckTransitions(*options, one.drive);
    if (!transitions.ok()) return LocalError(transitions);
    auto uncertainty = ClaimUncertainty(one.drive, options->uncertainty);
    if (!uncertainty.ok()) return LocalError(uncertainty.status());
    one.uncertainty = *std::move(uncertainty);
  }
  return cases;
}

}  // namespace revisit::client
