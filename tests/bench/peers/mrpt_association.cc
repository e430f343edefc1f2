#include "tests/bench/peers/mrpt_association.h"

#include <mrpt/math/CMatrixDynamic.h>
#include <mrpt/slam/data_association.h>

#include <algorithm>

namespace revisit::bench {
namespace {

mrpt::math::CMatrixDouble Matrix(const std::vector<double>& values,
                                 std::size_t columns) {
  mrpt::math::CMatrixDouble matrix(static_cast<int>(values.size() / columns),
                                   static_cast<int>(columns));
  std::copy(values.begin(), values.end(), matrix.data());
  return matrix;
}

}  // namespace

template <int D>
std::optional<std::size_t> AssociateNearest(
    const std::vector<double>& differences,
    const std::vector<double>& covariances, AssociationMetric metric,
    double probability) {
  mrpt::slam::TDataAssociationResults results;
  mrpt::slam::data_association_independent_predictions(
      Matrix(std::vector<double>(D), D), Matrix(differences, D),
      Matrix(covariances, D), results, mrpt::slam::assocNN,
      metric == AssociationMetric::kMahalanobis ? mrpt::slam::metricMaha
                                                : mrpt::slam::metricML,
      probability, /*DAT_ASOC_USE_KDTREE=*/false);
  const auto found = results.associations.find(0);
  if (found == results.associations.end()) return std::nullopt;
  return found->second;
}

template std::optional<std::size_t> AssociateNearest<3>(
    const std::vector<double>&, const std::vector<double>&, AssociationMetric,
    double);

JointAssociation AssociateJointly(const std::vector<double>& observations,
                                  const std::vector<double>& predictions,
                                  const std::vector<double>& covariance,
                                  double probability) {
  mrpt::slam::TDataAssociationResults results;
  mrpt::slam::data_association_full_covariance(
      Matrix(observations, 3), Matrix(predictions, 3),
      Matrix(covariance, predictions.size()), results, mrpt::slam::assocJCBB,
      mrpt::slam::metricMaha, probability, /*DAT_ASOC_USE_KDTREE=*/false);
  JointAssociation joint;
  joint.nodes_explored = results.nNodesExploredInJCBB;
  joint.predictions.resize(observations.size() / 3);
  for (const auto& [observation, prediction] : results.associations) {
    joint.predictions[observation] = prediction;
  }
  return joint;
}

}  // namespace revisit::bench
