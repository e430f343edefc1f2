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

// Which passes of a place are sought.
enum class SearchDirection { kSame, kOpposite, kEither };

// What a single search may decide for itself.
struct SearchOptions {
  AlignmentKind alignment = AlignmentKind::kRelative;
  CorrelationModel correlation_model = CorrelationModel::kDeadReckoning;
  // kComposite only.
  LikelihoodForm likelihood_form = LikelihoodForm::kGaussian;
  SearchDirection direction = SearchDirection::kSame;
  // Travelled distance that is aligned with the history: rounded to a number of
  // nodes, [1, kMaxSequenceNodes].
  double sequence_length_meters = 150.0;
  // In (0, 1).
  double gate_probability = 0.95;
  // Position [0, 1000] m, heading [0, 3] rad.
  PlaceTolerance place_tolerance;
  // Along the path, [0, 1e6] m.
  double candidate_separation_meters = 10.0;
  // [1, kMaxCandidates].
  int max_candidates = 5;
  // Whether candidates tell their paths, which are walked once more for it.
  bool tell_paths = true;
  // The rest is for kRelative.
  ShapeModel shape;
  // Whether to answer also what is too improbable to be accepted, which takes a
  // look at all of history.
  bool exhaustive = false;
  // Mean distance between roads not driven, [1, 1e6] m.
  double road_spacing_meters = 200.0;
  // In (0, 1).
  double acceptance_probability = 0.4;
  // Nodes of the sequence times nodes of the history, in each direction, that
  // the search may compare: beyond it answers with nothing.
  std::int64_t max_comparisons = std::numeric_limits<std::int64_t>::max();
};

struct EngineSettings {
  StateSpace state_space = StateSpace::kPlanar;
  // [0.01, 1000] m.
  double node_spacing_meters = 2.0;
  // At least the node spacing, at most 1e5 m.
  double check_interval_meters = 50.0;
  // [0.01, 1e6] m, and at most kMaxNodesPerStep node spacings: a single pose
  // must not bring nodes without end.
  double max_step_meters = 100.0;
  // Whether searches multiply the claimed standard deviations by
  // Consistency::inflation, and what that may come to: [1, 100].
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
  // What was got and what is allowed.
  std::string description;
};

// All problems; none means valid.
std::vector<SettingProblem> FindProblems(const EngineSettings& settings);
// The same for the options of one search of a vehicle with these settings.
std::vector<SettingProblem> FindProblems(const SearchOptions& options,
                                         const EngineSettings& vehicle);

// The usual maximal step, or the longest allowed with this spacing if that is
// less.
double DefaultMaxStep(double node_spacing_meters);

// Nodes in a sequence of this length: at least 1.
std::int64_t SequenceNodes(double sequence_length_meters,
                           double node_spacing_meters);

}  // namespace revisit::core

#endif  // REVISIT_CORE_SETTINGS_H_
