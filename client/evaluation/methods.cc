#include "client/evaluation/methods.h"

#include <algorithm>
#include <cmath>
#include <utility>

#include "absl/strings/str_cat.h"
#include "client/answers/names.h"
#include "client/formats/angles.h"
#include "client/formats/course.h"
#include "client/terminal/terminal.h"

namespace revisit::client {
namespace {

std::vector<Method> MethodsAt(const EvaluateOptions& options,
                              double sequence_length_meters,
                              double exclude_meters) {
  Method given;
  given.name = options.settings.alignment() == v1::ALIGNMENT_COMPOSITE
                   ? "composite"
                   : "relative";
  given.settings = options.settings;
  given.settings.set_sequence_length_meters(sequence_length_meters);
  given.judging = options.judging;
  given.judging.excluded_nodes =
      std::llround(exclude_meters / options.settings.node_spacing_meters());
  given.sequence_length_meters = sequence_length_meters;
  if (!options.baselines) return {given};

  const auto composite = [&](const char* name, v1::CorrelationModel model) {
    Method method = given;
    method.name = name;
    method.settings.set_alignment(v1::ALIGNMENT_COMPOSITE);
    method.settings.set_correlation_model(model);
    return method;
  };
  Method single =
      composite("single pose", options.settings.correlation_model());
  single.source = Method::Source::kServiceBeyondRecentPath;
  single.settings.set_sequence_length_meters(
      options.settings.node_spacing_meters());
  single.settings.set_max_candidates(100);
  Method nearest = given;
  nearest.name = "nearest position";
  nearest.source = Method::Source::kNearestPosition;
  return {
      composite("paper, independent", v1::CORRELATION_MODEL_INDEPENDENT),
      composite("paper, dead reckoning", v1::CORRELATION_MODEL_DEAD_RECKONING),
      single, given, nearest};
}

// The methods once for each claimed scale. `main` becomes the index of the one
// that it named at the honest scale or, if there is none, at the first.
std::vector<Method> AtEachScale(const std::vector<Method>& methods,
                                const std::vector<double>& scales,
                                std::size_t* main) {
  std::vector<Method> all;
  const std::size_t of_scale = *main;
  for (const double scale : scales) {
    if (scale == 1.0) *main = all.size() + of_scale;
    for (Method method : methods) {
      method.claimed_scale = scale;
      all.push_back(std::move(method));
    }
  }
  return all;
}

// Adds notes on the methods that are measured one beside the other.
void AddNotesOnMethods(const EvaluateOptions& options,
                       std::vector<std::string>* notes) {
  if (!options.sequence_lengths.empty()) {
    notes->push_back(absl::StrCat(
        "Sequence lengths: the recent path that is no history is as long as "
        "the sequence, so that true loops differ too; checks begin at two "
        "sequence lengths or ",
        Fixed(options.judging.first_check_meters, 0),
        " m, whichever is later."));
  }
  if (!options.claimed_scales.empty()) {
    notes->push_back(
        "Claimed scales: every standard deviation is claimed this many times "
        "as large, with the same settings; one row holds all drives.");
  }
  if (options.baselines) {
    notes->push_back(
        "nearest position: estimates within 15 m, all accepted. single pose: "
        "the best log-similarity of one node. paper: the log-similarities of "
        "all nodes of the sequence summed, without and with "
        "cross-covariance.");
  }
}

// Adds notes on errors that are drawn or added, and on the claims about them.
void AddNotesOnErrors(const EvaluateOptions& options,
                      std::vector<std::string>* notes) {
  if (options.fix_noise.has_value()) {
    const FixNoise& noise = *options.fix_noise;
    notes->push_back(absl::StrCat(
        "Fixes: drawn each second along the true paths with errors of ",
        Fixed(noise.meters, 1), " m in x and y, ",
        noise.correlation_seconds > 0.0
            ? absl::StrCat("correlated over ",
                           Fixed(noise.correlation_seconds, 0), " s")
            : "independent",
        ", and of ", Fixed(noise.heading, 2), " rad in heading; claimed as ",
        NameOf(options.settings.correlation_model()), "; ",
        std::max<std::size_t>(options.seeds.size(), 1), " seeds."));
  } else if (!options.seeds.empty()) {
    notes->push_back(absl::StrCat(
        "Simulated: estimates drawn along the true paths, ",
        options.seeds.size(), " seeds; one row holds all seeds of a drive."));
  }
  if (options.gyro_bias != 0.0) {
    notes->push_back(
        absl::StrCat("Gyro bias: estimates turn by ",
                     Fixed(options.gyro_bias / kRadiansPerDegree, 4),
                     " degrees a second more than they did; this is claimed "
                     "nowhere."));
  }
  if (options.uncertainty.claimed_scale != 1.0) {
    notes->push_back(
        absl::StrCat("Claimed standard deviations are multiplied by ",
                     Fixed(options.uncertainty.claimed_scale, 3), "."));
  }
}

// How the verifier erred, for behind "..., wrong ones were rejected".
std::string VerifierErrorsText(const VerifierErrors& errors) {
  std::string text;
  if (errors.silent > 0.0) {
    absl::StrAppend(&text, "; of ", Fixed(100.0 * errors.silent, 0),
                    " % nothing was said");
  }
  if (errors.wrong > 0.0) {
    absl::StrAppend(&text, "; of ", Fixed(100.0 * errors.wrong, 0),
                    " % of the others the opposite");
  }
  if (errors.measured) {
    absl::StrAppend(
        &text, "; closures were measured to ",
        Fixed(errors.measured->meters, 2), " m and ",
        Fixed(errors.measured->heading_radians / kRadiansPerDegree, 2),
        " degrees");
  }
  return text;
}

}  // namespace

std::vector<Method> ChooseMethods(const EvaluateOptions& options,
                                  std::size_t* main) {
  if (options.sequence_lengths.empty()) {
    auto methods = MethodsAt(options, options.settings.sequence_length_meters(),
                             options.exclude_meters);
    *main = methods.size() > 1 ? methods.size() - 2 : 0;
    if (options.claimed_scales.empty()) return methods;
    return AtEachScale(methods, options.claimed_scales, main);
  }
  std::vector<Method> all;
  *main = 0;
  for (const double length : options.sequence_lengths) {
    for (Method& method : MethodsAt(options, length, length)) {
      all.push_back(std::move(method));
    }
    const bool own = length == options.settings.sequence_length_meters();
    if (own || &length == &options.sequence_lengths.front()) {
      *main = all.size() - (options.baselines ? 2 : 1);
    }
  }
  return all;
}

std::vector<std::string> NotesOn(const EvaluateOptions& options) {
  std::vector<std::string> notes;
  AddNotesOnMethods(options, &notes);
  AddNotesOnErrors(options, &notes);
  if (!options.settings.use_belief()) {
    notes.push_back(
        "No belief: every search begins with the covariances as claimed.");
  }
  if (options.recordings.has_value()) {
    notes.push_back(absl::StrCat(
        "Recordings: each drive once the last one of a vehicle, in a frame of "
        "its own behind those of the others; only places in these count.",
        options.recordings->kind == RecordingChoice::Kind::kDatum
            ? absl::StrCat(" Datums: drawn about the true starts, ",
                           options.recording_draws, " draws.")
            : ""));
  }
  if (options.verify && options.recordings.has_value()) {
    notes.push_back(
        "Verified: the first accepted candidate that is right in each other "
        "recording became a loop closure, without a measurement; only checks "
        "behind the first of these count.");
  } else if (options.verify) {
    notes.push_back(absl::StrCat(
        "Verified: accepted first candidates that are right became "
        "loop closures, wrong ones were rejected",
        VerifierErrorsText(options.verifier_errors), "."));
  }
  if (options.geodetic) {
    notes.push_back(absl::StrCat(
        "GNSS: the truth is the reference that was recorded beside it; heading "
        "is the direction of travel; epochs slower than ",
        Fixed(kStandstillMetersPerSecond, 1), " m/s are left out."));
  }
  notes.insert(notes.end(), options.file_notes.begin(),
               options.file_notes.end());
  return notes;
}

}  // namespace revisit::client
