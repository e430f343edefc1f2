// How a vehicle's trajectory is kept and searched.
#ifndef REVISIT_CORE_SETTINGS_H_
#define REVISIT_CORE_SETTINGS_H_

#include <cstdint>
#include <limits>
#include <string>
#include <vector>

#include "core/alignment/log_similarity.h"
#include "core/alignment/shape_filter.h"
#include "core/geometry/pose.h"
#include "core/graph/correlation.h"

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
  // For kComposite only.
  LikelihoodForm likelihood_form = LikelihoodForm::kGaussian;
  SearchDirection direction = SearchDirection::kSame;
  // Travelled distance that is aligned with the history: rounded to a number of
  // nodes, [1, kMaxSequenceNodes].
  double sequence_length_meters = 150.0;
  // Probability with which the gate accepts a true revisit, in (0, 1).
  double gate_probability = 0.95;
  // Position [0, 1000] m, heading [0, 3] rad.
  PlaceTolerance place_tolerance;
  // Least distance of candidates from each other and from the query, along the
  // path: [0, 1e6] m.
  double candidate_separation_meters = 10.0;
  // [1, kMaxCandidates].
  int max_candidates = 5;
  // Whether candidates have their paths. Each is walked once more for it.
  bool tell_paths = true;
  // Nodes of the sequence times nodes of the history, for each direction, that
  // the search may compare. Where it would have to compare more, it finds
  // nothing (EmptyReason::kTooMuchWork).
  std::int64_t max_comparisons = std::numeric_limits<std::int64_t>::max();

  // The options below are for kRelative only.
  ShapeModel shape;
  // Whether to find also candidates that are too improbable to be accepted,
  // which takes a look at the whole history.
  bool exhaustive = false;
  // Mean distance between roads not driven, [1, 1e6] m.
  double road_spacing_meters = 200.0;
  // Least posterior probability of a place that is accepted, in (0, 1).
  double acceptance_probability = 0.4;
};

struct EngineSettings {
  StateSpace state_space = StateSpace::kPlanar;
  // [0.01, 1000] m.
  double node_spacing_meters = 2.0;
  // At least the node spacing, at most 1e5 m.
  double check_interval_meters = 50.0;
  // A longer step is a jump: [0.01, 1e6] m, and at most kMaxNodesPerStep node
  // spacings, so that a single pose cannot add nodes without bound.
  double max_step_meters = 100.0;
  // Whether searches multiply the claimed standard deviations by
  // Consistency::inflation, and the most that this may be: [1, 100].
  bool apply_inflation = false;
  double max_inflation = 10.0;
  SearchOptions search;
};

inline constexpr int kMaxCandidates = 100;
inline constexpr std::int64_t kMaxSequenceNodes = 1000;
inline constexpr std::int64_t kMaxNodesPerStep = 1000;

// A setting that is out of range.
struct SettingProblem {
  // Name of the field here, such as "place_tolerance.position_meters".
  std::string field;
  // The value that was given and those that are allowed.
  std::string description;
};

// All problems of the settings; none if they are valid.
std::vector<SettingProblem> FindProblems(const EngineSettings& settings);
// All problems of the options of one search of a vehicle with these settings.
std::vector<SettingProblem> FindProblems(const SearchOptions& options,
                                         const EngineSettings& vehicle);

// The default maximal step, or the longest that is allowed with this spacing if
// that is less.
double DefaultMaxStep(double node_spacing_meters);

// Nodes in a sequence of this length: at least 1.
std::int64_t SequenceNodes(double sequence_length_meters,
                           double node_spacing_meters);

}  // namespace revisit::core

#endif  // REVISIT_CORE_SETTINGS_H_
