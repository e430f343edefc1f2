// The list of noise models, and the only place that tells them apart.
// noise_model.h says what else a new one needs.
#ifndef REVISIT_CORE_NOISE_MODELS_H_
#define REVISIT_CORE_NOISE_MODELS_H_

#include "core/geometry/state_matrix.h"
#include "core/noise/correlated_fixes.h"
#include "core/noise/dead_reckoning.h"
#include "core/noise/filter.h"
#include "core/noise/independent_fixes.h"
#include "core/noise/noise_model.h"

namespace revisit::core {

// Calls visit(model) with the model itself: a type that has
//
//   static constexpr NoiseModel Row();
//   // Gamma, and Cov(e_later, e_earlier), of two poses.
//   static StateMatrix<D> Difference(const PathPair<D>&, double meters);
//   static StateMatrix<D> Cross(const PathPair<D>&, double meters);
//   // The noise of a step from the earlier to the later pose: what follows of
//   // it for every step, and what means of it are of (covariances.h).
//   static StateMatrix<D> OfStep(const PathPair<D>&, double meters);
//   static StepNoise<D> Split(const StateMatrix<D>& mean);
//
// `meters` is Correlation::meters.
template <typename Visit>
decltype(auto) WithModel(CorrelationModel model, const Visit& visit) {
  switch (model) {
    case CorrelationModel::kDeadReckoning:
      break;
    case CorrelationModel::kIndependent:
      return visit(IndependentFixes());
    case CorrelationModel::kFilter:
      return visit(Filter());
    case CorrelationModel::kCorrelatedFixes:
      return visit(CorrelatedFixes());
  }
  return visit(DeadReckoning());
}

}  // namespace revisit::core

#endif  // REVISIT_CORE_NOISE_MODELS_H_
