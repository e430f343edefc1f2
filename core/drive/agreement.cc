#include "core/drive/agreement.h"

#include "core/drive/confirmed_loop.h"
#include "core/drive/pose_graph.h"
#include "core/geometry/quadratic_form.h"
#include "core/geometry/state_matrix.h"
#include "core/noise/chi_squared.h"
#include "core/noise/similarity_model.h"

namespace revisit::core {
namespace {

template <int D>
std::optional<Agreement> AgreementIn(const PoseGraph& graph,
                                     const SimilarityModel& model,
                                     const ConfirmedLoop& loop) {
  const Innovation<D> innovation =
      InnovationOf<D>(graph, model.correlation, loop);
  const std::optional<QuadraticForm> form = Evaluate<D>(
      StateMatrix<D>(model.inflation * model.inflation * innovation.gamma +
                     MeasurementCovariance<D>(*loop.measured)),
      innovation.difference);
  if (!form) return std::nullopt;
  return Agreement{form->squared_mahalanobis, D,
                   ChiSquaredAbove(D, form->squared_mahalanobis),
                   model.inflation};
}

}  // namespace

std::optional<Agreement> AgreementOf(const PoseGraph& graph,
                                     const SimilarityModel& model,
                                     const ConfirmedLoop& loop) {
  return model.state_space == StateSpace::kPlanar
             ? AgreementIn<3>(graph, model, loop)
             : AgreementIn<4>(graph, model, loop);
}

}  // namespace revisit::core
