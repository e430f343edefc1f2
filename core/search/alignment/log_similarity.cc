#include "core/search/alignment/log_similarity.h"

#include <algorithm>
#include <cassert>
#include <cmath>

#include "core/geometry/heading.h"
#include "core/geometry/state_matrix.h"

namespace revisit::core {
namespace {

double Exponent(LikelihoodForm form) {
  return form == LikelihoodForm::kAsPrinted ? 1.0 : 0.5;
}

template <int D>
double LogSimilarity(LikelihoodForm form, const StateMatrix<D>& gamma,
                     const StateVector<D>& d) {
  const std::optional<QuadraticForm> terms = Evaluate<D>(gamma, d);
  if (!terms) return kImpossible;
  return -0.5 * terms->log_determinant -
         Exponent(form) * terms->squared_mahalanobis;
}

template <int D>
double PairSimilarity(const PoseGraph& graph, const SimilarityModel& model,
                      NodeIndex i, NodeIndex j) {
  return LogSimilarity<D>(
      model.form,
      ToleratedCovariance<D>(
          model, DifferenceCovariance<D>(graph, model.correlation, i, j)),
      ToVector<D>(PassDifference(model, graph.pose(i), graph.pose(j))));
}

template <int D>
void FilterColumn(const PoseGraph& graph, const SimilarityModel& model,
                  NodeIndex query, NodeIndex count, double* column) {
  const Pose query_pose = graph.pose(query);
  VisitDifferenceCovariances<D>(
      graph, model.correlation, query, count,
      [&](NodeIndex i, const StateMatrix<D>& gamma) {
        column[i] = LogSimilarity<D>(
            model.form, ToleratedCovariance<D>(model, gamma),
            ToVector<D>(PassDifference(model, query_pose, graph.pose(i))));
      });
}

}  // namespace

double LogSimilarity(const PoseGraph& graph, const SimilarityModel& model,
                     NodeIndex i, NodeIndex j) {
  return model.state_space == StateSpace::kPlanar
             ? PairSimilarity<3>(graph, model, i, j)
             : PairSimilarity<4>(graph, model, i, j);
}

KernelQuery MakeKernelQuery(const PoseGraph& graph,
                            const SimilarityModel& model, NodeIndex query) {
  const NoiseModel& noise = model.correlation.noise();
  assert(noise.has_closed_form());
  const Node node = graph.node(query);
  const double position = model.tolerance.position_meters;
  const double heading = model.tolerance.heading_radians;
  KernelQuery kernel_query;
  kernel_query.pose = node.pose;
  kernel_query.covariance = node.covariance;
  kernel_query.state_space = model.state_space;
  kernel_query.form = noise.form;
  kernel_query.opposite = model.direction == Direction::kOpposite;
  kernel_query.variance_scale = model.inflation * model.inflation;
  kernel_query.position_variance = position * position;
  kernel_query.heading_variance = heading * heading;
  kernel_query.exponent = Exponent(model.form);
  return kernel_query;
}

void LogSimilarityColumn(const PoseGraph& graph, const SimilarityModel& model,
                         NodeIndex query, NodeIndex count,
                         std::vector<double>* column) {
  assert(count <= query);
  column->resize(static_cast<std::size_t>(count));
  double* const out = column->data();
  if (model.correlation.noise().has_closed_form()) {
    VisitBlockSimilarities(
        graph, model, query, count,
        [out, count](NodeIndex first, const BlockSimilarity& part) {
          constexpr auto kSize = static_cast<NodeIndex>(NodeBlock::kSize);
          std::copy_n(part.log_similarity.data(),
                      std::min(kSize, count - first), out + first);
        });
  } else if (model.state_space == StateSpace::kPlanar) {
    FilterColumn<3>(graph, model, query, count, out);
  } else {
    FilterColumn<4>(graph, model, query, count, out);
  }
}

}  // namespace revisit::core
