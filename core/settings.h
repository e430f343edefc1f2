// How a vehicle's trajectory is kept and searched: the settings, their defaults
// and what follows from them. Their ranges: settings_table.h. How one is added:
// docs/how-it-works.md.
#ifndef REVISIT_CORE_SETTINGS_H_
#define REVISIT_CORE_SETTINGS_H_

#include <cstdint>
#include <limits>
#include <optional>
#include <string>
#include <vector>

#include "core/drive/node_index.h"
#include "core/geometry/state_space.h"
#include "core/noise/comparison.h"
#include "core/noise/noise_model.h"

namespace revisit::core {

// How the recent path is compared with the history: relative.h, viterbi.h.
enum class AlignmentKind { kRelative, kComposite };

// The directions, against that of the recent path, in which passes of a place
// are sought.
enum class SearchDirection { kSame, kOpposite, kEither };

// How far the shape of one pass may stray from that of another
// (shape_filter.h).
struct ShapeModel {
  // Standard deviations by which each node strays, beside the drift: position
  // [0.01, 1000] m, heading [0.001, 3] rad.
  PlaceTolerance tolerance{1.0, 0.06};
  // Distance over which nodes stray together, [0.01, 1e6] m.
  double correlation_meters = 20.0;

  bool operator==(const ShapeModel& other) const {
    return tolerance == other.tolerance &&
           correlation_meters == other.correlation_meters;
  }
};

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
  // compare more finds nothing (EmptyReason::kTooMuchWork). The drive's own
  // history counts whole, since how much of it can matter depends on marks that
  // may not be known yet; of other drives, each recording that is not passed
  // over whole (far_histories.h).
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

// The most passes of a place that one can ask to keep.
inline constexpr int kMostPasses = 20;

// Least and greatest age that one can ask to keep: a second, and 100 years of
// 365 days.
inline constexpr std::int64_t kLeastAgeNanoseconds = 1'000'000'000;
inline constexpr std::int64_t kMostAgeNanoseconds =
    std::int64_t{100} * 365 * 24 * 3600 * 1'000'000'000;

// The part of the history that is kept (retention.h).
struct RetentionOptions {
  // The greatest age (stamps.h). A node without a stamp has no age.
  std::optional<std::int64_t> max_age_ns;
  // Passes of each place in each direction that are kept; 0: all. At most
  // kMostPasses.
  int max_passes = 0;
};

inline bool operator==(const RetentionOptions& a, const RetentionOptions& b) {
  return a.max_age_ns == b.max_age_ns && a.max_passes == b.max_passes;
}

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
  RetentionOptions retention;
};

// A relative alignment takes what agrees of so many sequences back from the
// query. The farther two paths run together, the surer it is that they are on
// one road and where along it: the last corner may lie farther back than one
// sequence. On the roads that were tried, more than two add nothing.
inline constexpr std::int64_t kOverlapSequences = 2;

// Marks whose places are remembered (mark.h): over a longer way, the drift
// becomes another.
inline constexpr std::int64_t kDriftMarks = 24;

inline constexpr double kLeastSpacingMeters = 0.01;
inline constexpr int kMaxCandidates = 100;
inline constexpr std::int64_t kMaxSequenceNodes = 1000;
inline constexpr std::int64_t kMaxNodesPerStep = 1000;

// A setting that is out of range.
struct SettingProblem {
  // SettingRow::field (settings_table.h).
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

// Parts of a drive that are made anew where settings change, beside answers of
// searches, which may follow any option. A sum of these.
enum Remade : unsigned {
  kRemadeNothing = 0,
  // The nodes: the same poses make another graph.
  kRemadeNodes = 1,
  // The statistics of the nodes' motion (motion_history.h).
  kRemadeMotionHistory = 2,
  // The evidence of marks (mark.h).
  kRemadeMarks = 4,
  // The judgement of confirmed loop closures (consistency.h).
  kRemadeConsistency = 8,
  // Which nodes are to be kept (retention.h).
  kRemadeKept = 16,
};

// The sum of what the settings that differ say of themselves in the table.
// Where nothing is said, what is there stays as it is, to the last bit.
unsigned RemadeBetween(const DriveSettings& before, const DriveSettings& after);
// Whether the same poses make another graph.
bool MovesNodes(const DriveSettings& before, const DriveSettings& after);

// The options with which the marks of a vehicle are searched that has these of
// its own. They tell apart what marks depend on: all others are at their
// defaults.
SearchOptions MarkOptions(const SearchOptions& own);

// Whether a search with these options, of a vehicle with these settings, begins
// with a belief (drive_belief.h). Marks show scale and drift under the
// vehicle's own noise model, so they say nothing about another.
bool BeginsWithBelief(const SearchOptions& options,
                      const DriveSettings& vehicle);

// The correlation that the options ask for.
Correlation CorrelationOf(const SearchOptions& options);

// The longest max_step_meters that is allowed with this spacing: a single pose
// must not add nodes without bound. A spacing that is itself refused sets no
// bound.
double LongestStep(double node_spacing_meters);
// The default maximal step, or the longest that is allowed with this spacing if
// that is less.
double DefaultMaxStep(double node_spacing_meters);

// Nodes in a sequence of this length: at least 1.
std::int64_t SequenceNodes(double sequence_length_meters,
                           double node_spacing_meters);

// Steps of the stretches whose turns are compared: they are as long as the
// correlation distance, but no longer than a path of `steps` nodes, so that
// like is compared with like.
NodeIndex StretchNodes(const ShapeModel& model, double spacing_meters,
                       std::int64_t steps);

// Meters of path between the marks of a vehicle.
double MarkSpacing(const DriveSettings& settings);

}  // namespace revisit::core

#endif  // REVISIT_CORE_SETTINGS_H_
