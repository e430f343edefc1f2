#include "core/alignment/log_similarity.h"

#include <algorithm>
#include <cassert>
#include <cmath>

#include "core/geometry/heading.h"

namespace revisit::core {
namespace {

template <int D>
double LogSimilarity(LikelihoodForm form, const StateMatrix<D>& gamma,
                     const StateVector<D>& d) {
  const std::optional<QuadraticForm> terms = Evaluate<D>(gamma, d);
  if (!terms) return kImpossible;
  const double c = form == LikelihoodForm::kAsPrinted ? 1.0 : 0.5;
  return -0.5 * terms->log_determinant - c * terms->squared_mahalanobis;
}

template <int D>
double PairSimilarity(const PoseGraph& graph, const SimilarityModel& model,
                      NodeIndex i, NodeIndex j) {
  return LogSimilarity<D>(
      model.form,
      ToleratedCovariance<D>(
          model, DifferenceCovariance<D>(graph, model.correlation, i, j)),
      ToVector<D>(
          PassDifference(model, graph.node(i).pose, graph.node(j).pose)));
}

template <int D>
void Column(const PoseGraph& graph, const SimilarityModel& model,
            NodeIndex query, NodeIndex count, std::vector<double>* column) {
  const Pose& query_pose = graph.node(query).pose;
  column->resize(static_cast<std::size_t>(count));
  double* const out = column->data();
  VisitDifferenceCovariances<D>(
      graph, model.correlation, query, count,
      [&](NodeIndex i, const StateMatrix<D>& gamma) {
        out[i] = LogSimilarity<D>(
            model.form, ToleratedCovariance<D>(model, gamma),
            ToVector<D>(PassDifference(model, query_pose, graph.node(i).pose)));
      });
}

}  // namespace

Pose PassDifference(const SimilarityModel& model, const Pose& a,
                    const Pose& b) {
  Pose difference = Difference(a, b);
  if (model.direction == Direction::kOpposite) {
    difference.heading = WrapHeading(difference.heading + kPi);
  }
  return difference;
}

template <int D>
std::optional<QuadraticForm> Evaluate(const StateMatrix<D>& gamma,
                                      const StateVector<D>& d) {
  // gamma = L diag(pivot) L^T, L unit lower triangular; solved = L^-1 d.
  double lower[D][D];
  double pivot[D];
  double solved[D];
  QuadraticForm terms;
  double determinant = 1.0;
  for (int r = 0; r < D; ++r) {
    double p = gamma(r, r);
    double y = d(r);
    for (int c = 0; c < r; ++c) {
      double scaled = gamma(r, c);  // L(r,c) * pivot(c)
      for (int k = 0; k < c; ++k)
        scaled -= lower[r][k] * pivot[k] * lower[c][k];
      lower[r][c] = scaled / pivot[c];
      p -= lower[r][c] * scaled;
      y -= lower[r][c] * solved[c];
    }
    // Written so that NaN fails too.
    if (!(p > kPivotTolerance * gamma(r, r)) || !std::isfinite(p)) {
      return std::nullopt;
    }
    pivot[r] = p;
    solved[r] = y;
    determinant *= p;
    terms.squared_mahalanobis += y * y / p;
  }
  // Pivots of a valid graph lie within (1e-60, 1e40): their product is finite
  // and one logarithm does for all. Beyond that, one each.
  if (std::isnormal(determinant)) {
    terms.log_determinant = std::log(determinant);
  } else {
    for (int r = 0; r < D; ++r) terms.log_determinant += std::log(pivot[r]);
  }
  if (!std::isfinite(terms.squared_mahalanobis)) return std::nullopt;
  return terms;
}

template std::optional<QuadraticForm> Evaluate<3>(const StateMatrix<3>&,
                                                  const StateVector<3>&);
template std::optional<QuadraticForm> Evaluate<4>(const StateMatrix<4>&,
                                                  const StateVector<4>&);

double LogSimilarity(const PoseGraph& graph, const SimilarityModel& model,
                     NodeIndex i, NodeIndex j) {
  return model.state_space == StateSpace::kPlanar
             ? PairSimilarity<3>(graph, model, i, j)
             : PairSimilarity<4>(graph, model, i, j);
}

void LogSimilarityColumn(const PoseGraph& graph, const SimilarityModel& model,
                         NodeIndex query, NodeIndex count,
                         std::vector<double>* column) {
  assert(count <= query);
  if (model.state_space == StateSpace::kPlanar) {
    Column<3>(graph, model, query, count, column);
  } else {
    Column<4>(graph, model, query, count, column);
  }
}

}  // namespace revisit::core
