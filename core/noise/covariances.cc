#include "core/noise/covariances.h"

#include "core/geometry/state_matrix.h"
#include "core/noise/models.h"

namespace revisit::core {

template <int D>
StateMatrix<D> DifferenceCovariance(const Correlation& correlation,
                                    const PathPair<D>& pair) {
  return WithModel(correlation.model, [&](auto model) -> StateMatrix<D> {
    return model.Difference(pair, correlation.meters);
  });
}

template <int D>
StateMatrix<D> CrossCovariance(const Correlation& correlation,
                               const PathPair<D>& pair) {
  return WithModel(correlation.model, [&](auto model) -> StateMatrix<D> {
    return model.Cross(pair, correlation.meters);
  });
}

template <int D>
StateMatrix<D> StepCovariance(const Correlation& correlation,
                              const PathPair<D>& step) {
  return WithModel(correlation.model, [&](auto model) -> StateMatrix<D> {
    return model.OfStep(step, correlation.meters);
  });
}

template <int D>
StepNoise<D> SplitStepCovariance(CorrelationModel model,
                                 const StateMatrix<D>& mean) {
  return WithModel(model, [&](auto of) { return of.template Split<D>(mean); });
}

template StateMatrix<3> DifferenceCovariance<3>(const Correlation&,
                                                const PathPair<3>&);
template StateMatrix<4> DifferenceCovariance<4>(const Correlation&,
                                                const PathPair<4>&);
template StateMatrix<3> CrossCovariance<3>(const Correlation&,
                                           const PathPair<3>&);
template StateMatrix<4> CrossCovariance<4>(const Correlation&,
                                           const PathPair<4>&);
template StateMatrix<3> StepCovariance<3>(const Correlation&,
                                          const PathPair<3>&);
template StateMatrix<4> StepCovariance<4>(const Correlation&,
                                          const PathPair<4>&);
template StepNoise<3> SplitStepCovariance<3>(CorrelationModel,
                                             const StateMatrix<3>&);
template StepNoise<4> SplitStepCovariance<4>(CorrelationModel,
                                             const StateMatrix<4>&);

}  // namespace revisit::core
