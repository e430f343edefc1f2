// How a vehicle's trajectory is kept and searched: the settings, their defaults
// and their ranges. How one is added: docs/how-it-works.md.
#ifndef REVISIT_CORE_SETTINGS_H_
#define REVISIT_CORE_SETTINGS_H_

#include <algorithm>
#include <cstdint>
#include <limits>
#include <string>
#include <vector>

#include "core/drive/retention.h"
#include "core/geometry/pose.h"
#include "core/noise/noise_model.h"
#include "core/search/alignment/log_similarity.h"
#include "core/search/alignment/shape_filter.h"

namespace revisit::core {

// How the recent path is compared with the history: relative.h, viterbi.h.
enum class AlignmentKind { kRelative, kComposite };

// The directions, against that of the recent path, in which passes of a place
// are sought.
enum class SearchDirection { kSame, kOpposite, kEither };

// How candidates are searched for. A vehicle has options of its own, and a
// single search may be given others.
struct SearchOptions {
  AlignmentKind alignment = AlignmentKind::kRelative;
  CorrelationModel correlation_model = CorrelationModel::kDeadReckoning;
  // Distance over which errors decorrelate (Correlation::meters).
  double fix_correlation_meters = Correlation::kUsualMeters;
  // For kComposite only.
  LikelihoodForm likelihood_form = LikelihoodForm::kGaussian;
  SearchDirection direction = SearchDirection::kSame;
  // Travelled distance before the query that is no history; it is rounded to a
  // number of nodes. These nodes are aligned with the history, and with
  // kRelative up to kOverlapSequences times as many where long overlaps tell
  // more (NoiseModel).
  double sequence_length_meters = 150.0;
  // Probability with which the gate accepts a true revisit.
  double gate_probability = 0.95;
  PlaceTolerance place_tolerance;
  // Least distance of candidates from each other and from the query, along the
  // path.
  double candidate_separation_meters = 10.0;
  // Most candidates that a search finds.
  int max_candidates = 5;
  // Whether candidates have their paths. Each is walked once more for it.
  bool tell_paths = true;
  // Nodes of the aligned path times nodes of the history times directions (2
  // for kEither) that the search may compare. A search that would have to
  // compare more finds nothing (EmptyReason::kTooMuchWork).
  std::int64_t max_comparisons = std::numeric_limits<std::int64_t>::max();

  // The options below are for kRelative only.
  ShapeModel shape;
  // Whether to find also candidates that are too improbable to be accepted,
  // which takes a look at the whole history.
  bool exhaustive = false;
  // Mean distance between roads that the vehicle has not driven.
  double road_spacing_meters = 200.0;
  // Least posterior probability of a stretch of road that is accepted.
  double acceptance_probability = 0.45;
  // Whether the search begins with what the drive has shown before
  // (drive_belief.h), where the noise model lets it and is the vehicle's own;
  // others begin with the claims as they are.
  bool use_belief = true;
};

struct DriveSettings {
  StateSpace state_space = StateSpace::kPlanar;
  // Travelled distance between two nodes.
  double node_spacing_meters = 2.0;
  // Travelled distance between two checks.
  double check_interval_meters = 50.0;
  // Longest step between two poses; a longer one is a jump.
  double max_step_meters = 100.0;
  // Whether searches multiply the claimed standard deviations by
  // Consistency::inflation, and the most that this may be.
  bool apply_inflation = false;
  double max_inflation = 10.0;
  SearchOptions search;
  // The part of the history that is kept.
  RetentionOptions retention;
};

// A relative alignment takes what agrees of so many sequences back from the
// query. The farther two paths run together, the surer it is that they are on
// one road and where along it: the last corner may lie farther back than one
// sequence. On the roads that were tried, more than two add nothing.
inline constexpr std::int64_t kOverlapSequences = 2;

inline constexpr double kLeastSpacingMeters = 0.01;
inline constexpr int kMaxCandidates = 100;
inline constexpr std::int64_t kMaxSequenceNodes = 1000;
inline constexpr std::int64_t kMaxNodesPerStep = 1000;

// A number among the settings, and its range.
struct NumberSetting {
  // Name of the field here, such as "place_tolerance.position_meters".
  const char* field;
  double value;
  double lowest;
  double highest;
  // Whether the number may be lowest or highest itself.
  bool takes_ends = true;
};

// The longest max_step_meters that is allowed with this spacing: a single pose
// must not add nodes without bound. A spacing that is itself refused sets no
// bound.
double LongestStep(double node_spacing_meters);

// All numbers among the settings with their ranges, in the order in which
// problems are reported; but see FindProblems() for sequence_length_meters.
inline std::vector<NumberSetting> NumbersOf(const DriveSettings& s) {
  return {{"node_spacing_meters", s.node_spacing_meters, kLeastSpacingMeters,
           1000.0},
          {"check_interval_meters", s.check_interval_meters,
           std::max(kLeastSpacingMeters, s.node_spacing_meters), 1e5},
          {"max_step_meters", s.max_step_meters, 0.01,
           LongestStep(s.node_spacing_meters)},
          {"max_inflation", s.max_inflation, 1.0, 100.0},
          {"retention.max_age",
           static_cast<double>(
               s.retention.max_age_ns.value_or(kLeastAgeNanoseconds)) /
               1e9,
           kLeastAgeNanoseconds / 1e9, kMostAgeNanoseconds / 1e9},
          {"retention.max_passes", static_cast<double>(s.retention.max_passes),
           0.0, kMostPasses}};
}
inline std::vector<NumberSetting> NumbersOf(const SearchOptions& o) {
  const PlaceTolerance& shape = o.shape.tolerance;
  return {
      {"fix_correlation_meters", o.fix_correlation_meters, 1.0, 1e6},
      {"gate_probability", o.gate_probability, 0.0, 1.0, false},
      {"place_tolerance.position_meters", o.place_tolerance.position_meters,
       0.0, 1000.0},
      {"place_tolerance.heading_radians", o.place_tolerance.heading_radians,
       0.0, 3.0},
      {"candidate_separation_meters", o.candidate_separation_meters, 0.0, 1e6},
      {"max_candidates", static_cast<double>(o.max_candidates), 1.0,
       kMaxCandidates},
      {"shape.tolerance.position_meters", shape.position_meters, 0.01, 1000.0},
      {"shape.tolerance.heading_radians", shape.heading_radians, 0.001, 3.0},
      {"shape.correlation_meters", o.shape.correlation_meters, 0.01, 1e6},
      {"road_spacing_meters", o.road_spacing_meters, 1.0, 1e6},
      {"acceptance_probability", o.acceptance_probability, 0.0, 1.0, false}};
}

// A setting that is out of range.
struct SettingProblem {
  // NumberSetting::field, or the name of another field.
  std::string field;
  // The value that was given and those that are allowed.
  std::string description;
};

// All problems of the settings; none if they are valid. A sequence has 1 to
// kMaxSequenceNodes nodes.
std::vector<SettingProblem> FindProblems(const DriveSettings& settings);
// All problems of the options of one search of a vehicle with these settings.
std::vector<SettingProblem> FindProblems(const SearchOptions& options,
                                         const DriveSettings& vehicle);

// Whether the same poses make another graph under the settings after than under
// those before.
bool MovesNodes(const DriveSettings& before, const DriveSettings& after);

// The default maximal step, or the longest that is allowed with this spacing if
// that is less.
double DefaultMaxStep(double node_spacing_meters);

// Nodes in a sequence of this length: at least 1.
std::int64_t SequenceNodes(double sequence_length_meters,
                           double node_spacing_meters);

}  // namespace revisit::core

#endif  // REVISIT_CORE_SETTINGS_H_
