#include "core/drive/agreement.h"

#include "core/drive/confirmed_loop.h"
#include "core/drive/frame_relation.h"
#include "core/drive/pose_graph.h"
#include "core/geometry/frame_transform.h"
#include "core/geometry/quadratic_form.h"
#include "core/geometry/state_matrix.h"
#include "core/noise/chi_squared.h"
#include "core/noise/similarity_model.h"

namespace revisit::core {
namespace {

// `gamma` is inflated.
template <int D>
std::optional<Agreement> Judge(const StateVector<D>& difference,
                               const StateMatrix<D>& gamma,
                               const StateMatrix<D>& measurement,
                               double inflation) {
  const std::optional<QuadraticForm> form =
      Evaluate<D>(StateMatrix<D>(gamma + measurement), difference);
  if (!form) return std::nullopt;
  return Agreement{form->squared_mahalanobis, D,
                   ChiSquaredAbove(D, form->squared_mahalanobis), inflation};
}

template <int D>
std::optional<Agreement> AgreementIn(const PoseGraph& graph,
                                     const SimilarityModel& model,
                                     const ConfirmedLoop& loop) {
  const Innovation<D> innovation =
      InnovationOf<D>(graph, model.correlation, loop);
  return Judge<D>(innovation.difference,
                  model.inflation * model.inflation * innovation.gamma,
                  MeasurementCovariance<D>(*loop.measured), model.inflation);
}

template <int D>
std::optional<Agreement> AcrossIn(const RelatedFrames& frames,
                                  const FrameRelation& relation,
                                  const SimilarityModel& model,
                                  const ConfirmedLoop& loop) {
  const auto innovation =
      InnovationAcross<D>(frames, relation, loop, model.inflation);
  if (!innovation) return std::nullopt;
  const Pose matched = Compose(loop.measured->query.pose,
                               Inverse(loop.measured->measurement.relative));
  return Judge<D>(innovation->difference, innovation->gamma,
                  MeasuredFromQuery<D>(*loop.measured, matched),
                  model.inflation);
}

}  // namespace

std::optional<Agreement> AgreementOf(const PoseGraph& graph,
                                     const SimilarityModel& model,
                                     const ConfirmedLoop& loop) {
  return model.state_space == StateSpace::kPlanar
             ? AgreementIn<3>(graph, model, loop)
             : AgreementIn<4>(graph, model, loop);
}

std::optional<Agreement> AgreementAcross(const RelatedFrames& frames,
                                         const FrameRelation& relation,
                                         const SimilarityModel& model,
                                         const ConfirmedLoop& loop) {
  return model.state_space == StateSpace::kPlanar
             ? AcrossIn<3>(frames, relation, model, loop)
             : AcrossIn<4>(frames, relation, model, loop);
}

}  // namespace revisit::core
