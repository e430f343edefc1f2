// Under which noise, and by which rules, two nodes are compared.
#ifndef REVISIT_CORE_NOISE_SIMILARITY_MODEL_H_
#define REVISIT_CORE_NOISE_SIMILARITY_MODEL_H_

#include "core/geometry/pose.h"
#include "core/geometry/state_matrix.h"
#include "core/geometry/state_space.h"
#include "core/noise/comparison.h"
#include "core/noise/noise_model.h"

namespace revisit::core {

struct SimilarityModel {
  StateSpace state_space = StateSpace::kPlanar;
  Correlation correlation;
  LikelihoodForm form = LikelihoodForm::kGaussian;
  PlaceTolerance tolerance;
  Direction direction = Direction::kSame;
  // Multiplies the claimed standard deviations; at least 1.
  double inflation = 1.0;
};

// Adds R to gamma.
template <int D>
void AddTolerance(const PlaceTolerance& tolerance, StateMatrix<D>* gamma) {
  const double position = tolerance.position_meters;
  const double heading = tolerance.heading_radians;
  for (int i = 0; i + 1 < D; ++i) (*gamma)(i, i) += position * position;
  (*gamma)(D - 1, D - 1) += heading * heading;
}

// The claimed covariance of a difference, inflated, plus R.
template <int D>
StateMatrix<D> ToleratedCovariance(const SimilarityModel& model,
                                   const StateMatrix<D>& gamma) {
  StateMatrix<D> sum = (model.inflation * model.inflation) * gamma;
  AddTolerance<D>(model.tolerance, &sum);
  return sum;
}

// a - b, for kOpposite with one of the headings turned by pi.
Pose PassDifference(const SimilarityModel& model, const Pose& a, const Pose& b);

}  // namespace revisit::core

#endif  // REVISIT_CORE_NOISE_SIMILARITY_MODEL_H_
