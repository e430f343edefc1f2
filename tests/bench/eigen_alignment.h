// What somebody would write from the paper with Eigen at hand: Eq. 2 and 3 by
// inverse and determinant, Algorithm 1 line by line. The reference of the
// benchmarks, and only there: the tests' oracles are independent of it.
#ifndef REVISIT_TESTS_BENCH_EIGEN_ALIGNMENT_H_
#define REVISIT_TESTS_BENCH_EIGEN_ALIGNMENT_H_

#include <Eigen/Core>
#include <Eigen/LU>
#include <cmath>
#include <limits>
#include <vector>

#include "core/drive/pose_graph.h"
#include "core/geometry/heading.h"
#include "core/geometry/pose.h"
#include "core/geometry/state_matrix.h"
#include "core/search/alignment/log_similarity.h"

namespace revisit::bench {

// `Size` is 3, 4 or Eigen::Dynamic.
template <int Size>
struct EigenNode {
  Eigen::Matrix<double, Size, 1> mean;
  Eigen::Matrix<double, Size, Size> covariance;
};

template <int Size, int D>
std::vector<EigenNode<Size>> EigenNodes(const core::PoseGraph& graph) {
  std::vector<EigenNode<Size>> nodes;
  for (core::NodeIndex i = 0; i < graph.size(); ++i) {
    const core::Node node = graph.node(i);
    nodes.push_back(
        {core::ToVector<D>(node.pose), core::ToMatrix<D>(node.covariance)});
  }
  return nodes;
}

// With the cross-covariance of dead reckoning; `later` is the query.
template <int Size>
double EigenLogSimilarity(const EigenNode<Size>& later,
                          const EigenNode<Size>& earlier,
                          const core::PlaceTolerance& tolerance) {
  using Matrix = Eigen::Matrix<double, Size, Size>;
  using Vector = Eigen::Matrix<double, Size, 1>;
  const auto size = later.mean.size();
  const auto heading = size - 1;
  Matrix psi = Matrix::Identity(size, size);
  psi(0, heading) = -(later.mean(1) - earlier.mean(1));
  psi(1, heading) = later.mean(0) - earlier.mean(0);
  const Matrix cross = earlier.covariance * psi.transpose();
  Matrix gamma =
      earlier.covariance + later.covariance - cross - cross.transpose();
  for (Eigen::Index i = 0; i < heading; ++i) {
    gamma(i, i) += tolerance.position_meters * tolerance.position_meters;
  }
  gamma(heading, heading) +=
      tolerance.heading_radians * tolerance.heading_radians;
  Vector d = later.mean - earlier.mean;
  d(heading) = core::WrapHeading(d(heading));
  return -0.5 * std::log(gamma.determinant()) -
         0.5 * d.dot(gamma.inverse() * d);
}

// Algorithm 1, with the emission of line 5 as Eq. 4 has it. Edges between
// consecutive nodes only. The best path; `steps` nodes.
template <int Size>
std::vector<Eigen::Index> LiteralAlgorithm1(
    const std::vector<EigenNode<Size>>& nodes, Eigen::Index query,
    Eigen::Index steps, const core::PlaceTolerance& tolerance) {
  const Eigen::Index history = query - steps + 1;
  const auto node = [&nodes](Eigen::Index i) -> const EigenNode<Size>& {
    return nodes[static_cast<std::size_t>(i)];
  };
  Eigen::MatrixXd scores(history, steps);
  Eigen::Matrix<Eigen::Index, Eigen::Dynamic, Eigen::Dynamic> before(history,
                                                                     steps);
  for (Eigen::Index i = 0; i < history; ++i) {
    scores(i, 0) = EigenLogSimilarity(node(history), node(i), tolerance);
    before(i, 0) = i;
  }
  const auto log_transition = [history](Eigen::Index from) {
    const int degree = (from > 0) + (from + 1 < history);
    return -std::log(degree);
  };
  for (Eigen::Index j = 1; j < steps; ++j) {
    for (Eigen::Index i = 0; i < history; ++i) {
      double best = -std::numeric_limits<double>::infinity();
      Eigen::Index from = i;
      for (const Eigen::Index h : {i - 1, i + 1}) {
        if (h < 0 || h >= history) continue;
        const double score = scores(h, j - 1) + log_transition(h);
        if (score > best) {
          best = score;
          from = h;
        }
      }
      scores(i, j) =
          best + EigenLogSimilarity(node(history + j), node(i), tolerance);
      before(i, j) = from;
    }
  }
  std::vector<Eigen::Index> path(static_cast<std::size_t>(steps));
  Eigen::Index at = 0;
  scores.col(steps - 1).maxCoeff(&at);
  for (Eigen::Index j = steps - 1; j >= 0; --j) {
    path[static_cast<std::size_t>(j)] = at;
    at = before(at, j);
  }
  return path;
}

}  // namespace revisit::bench

#endif  // REVISIT_TESTS_BENCH_EIGEN_ALIGNMENT_H_
