// The covariances of two poses of one path under any noise model.
#ifndef REVISIT_CORE_NOISE_COVARIANCES_H_
#define REVISIT_CORE_NOISE_COVARIANCES_H_

#include "core/geometry/pose.h"
#include "core/geometry/state_matrix.h"
#include "core/noise/noise_model.h"
#include "core/noise/path_pair.h"

namespace revisit::core {

// Gamma: the covariance of the difference of the two errors.
template <int D>
StateMatrix<D> DifferenceCovariance(const Correlation& correlation,
                                    const PathPair<D>& pair);

// Cov(e_later, e_earlier).
template <int D>
StateMatrix<D> CrossCovariance(const Correlation& correlation,
                               const PathPair<D>& pair);

// Drift and jitter of one step from the earlier pose to the later one, in one
// matrix, since no entry has both; in the axes of the local frame. Drift is the
// covariance of the error that the step adds to that of dead reckoning.
template <int D>
StateMatrix<D> StepCovariance(const Correlation& correlation,
                              const PathPair<D>& step);

// Tells drift and jitter apart in a mean of StepCovariance().
template <int D>
StepNoise<D> SplitStepCovariance(CorrelationModel model,
                                 const StateMatrix<D>& mean);

}  // namespace revisit::core

#endif  // REVISIT_CORE_NOISE_COVARIANCES_H_
