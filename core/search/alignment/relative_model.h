// The assumptions of a relative alignment (relative.h) about roads, drift and
// odometers, and which ends it looks for.
#ifndef REVISIT_CORE_SEARCH_ALIGNMENT_RELATIVE_MODEL_H_
#define REVISIT_CORE_SEARCH_ALIGNMENT_RELATIVE_MODEL_H_

#include <cstddef>
#include <optional>
#include <vector>

#include "core/drive/block_bounds.h"
#include "core/drive/confirmed_loop.h"
#include "core/drive/motion_history.h"
#include "core/drive/node_range.h"
#include "core/noise/similarity_model.h"
#include "core/search/alignment/log_similarity.h"
#include "core/search/alignment/relation.h"
#include "core/search/alignment/scored_ends.h"
#include "core/search/alignment/shape_filter.h"

namespace revisit::core {

// Roads not driven are taken to lie within this range of height, m.
inline constexpr double kRoadHeightRange = 20.0;

// Cost of a slip (a node stayed at, or skipped), nats: odometers that agree to
// one in a hundred slip once in a hundred nodes, and -ln(1/100) is 4.6.
inline constexpr double kSlipCost = 4.6;

// Innovations beyond this squared Mahalanobis distance end the overlap of two
// paths. On the same road, chi-square with 3 degrees of freedom exceeds it once
// in 900 steps.
inline constexpr double kSquaredInnovationLimit = 16.0;

// Paths of one end that are walked on side by side.
inline constexpr std::size_t kMostPaths = 4;

// A scale that the true standard deviations may have to those of `similarity`,
// and how probable that is.
struct WeighedScale {
  double scale = 1.0;
  double log_weight = 0.0;
};

struct RelativeModel {
  // How the two end poses are compared (the anchor). Direction and form are
  // ignored.
  SimilarityModel similarity;
  // The anchor is a mixture: of these scales, none being 1 alone, and of the
  // drift as claimed, with the weight that these drifts leave, and as each of
  // them shows it; none unless NoiseModel::lets_belief_begin. Weights of scales
  // sum to 1, those of drifts to less than 1. Drifts, and the last closure, are
  // those of the query's own recording, and do not count in others: what is
  // known there, their relation says.
  std::vector<WeighedScale> scales;
  std::vector<WeighedDrift> drifts;
  ShapeModel shape;
  double spacing_meters = 2.0;
  double road_spacing_meters = 200.0;
  // How much of the log-odds comes by chance (Chance::log_odds()).
  double log_chance = 0.0;
  bool same_direction = true;
  bool opposite_direction = false;
  // The loop closure that has shown the drift; none unless
  // NoiseModel::closures_show_drift. Both nodes
  // at or before the query.
  std::optional<ConfirmedLoop> last_confirmed;
  // Whether paths are walked over confirmed loop closures.
  bool over_loops = true;
  // Whether ends tell their odds under each scale (RelativeAlignment).
  bool tell_scales = false;
  // Ends are left out whose odds are below this share (given as its logarithm)
  // of the greatest odds, or of a new place's odds of 1 if these are more.
  // Above -infinity, the search skips such ends where it can rule them out
  // early: by where their block lies, by their own pose and covariance, or by a
  // path that cannot make up for these.
  double least_log_share = kImpossible;
  // Ends whose log-odds are surely less than this are sampled (relative.h).
  // kImpossible where each is looked at, as where neighbours do not err alike
  // (NoiseModel). Takes the history's indexes.
  double most_log_odds_sampled = kImpossible;
};

// The term that turns a log-similarity in Gaussian form into log-odds against a
// new place: the logarithm of the Gaussian's constant, less ln rho. rho is the
// density of nodes on roads not driven, per m^2 and rad. Roads at a mean
// distance B hold 2 / B metres of road per square metre, with nodes at spacing
// s, and each can be driven both ways:
//
//   rho = (2 / B) (1 / s) 2 / (2 pi) = 2 / (pi B s).
//
// SPATIAL: spread evenly over kRoadHeightRange.
double LogNewPlaceTerm(const RelativeModel& model);

// The logarithm of how many nodes the world may hold: those of roads of this
// spacing on kWorldSquareMeters.
double LogWorldNodes(const RelativeModel& model);

}  // namespace revisit::core

#endif  // REVISIT_CORE_SEARCH_ALIGNMENT_RELATIVE_MODEL_H_
