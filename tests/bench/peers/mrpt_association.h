// MRPT's data association (mrpt::slam, Debian's libmrpt-slam-dev), apart from
// the rest since its headers are large.
#ifndef REVISIT_TESTS_BENCH_PEERS_MRPT_ASSOCIATION_H_
#define REVISIT_TESTS_BENCH_PEERS_MRPT_ASSOCIATION_H_

#include <cstddef>
#include <optional>
#include <vector>

namespace revisit::bench {

enum class AssociationMetric { kMahalanobis, kMatchingLikelihood };

// Nearest neighbour of one observation among predictions of dimension D:
// `differences` are theirs from the observation, `covariances` those of the
// differences, row-major, one after the other. Which one is associated, if any
// passes the chi-square test. By data_association_independent_predictions,
// which itself calls data_association_full_covariance on a dense matrix of (D
// N)^2 entries: of all that, one observation needs the blocks on the diagonal.
template <int D>
std::optional<std::size_t> AssociateNearest(
    const std::vector<double>& differences,
    const std::vector<double>& covariances, AssociationMetric metric,
    double probability);

struct JointAssociation {
  // The prediction that each observation has, if any.
  std::vector<std::optional<std::size_t>> predictions;
  std::size_t nodes_explored = 0;
};

// Joint compatibility branch and bound, data_association_full_covariance.
// States (x, y, heading) of observations and predictions, one after the other,
// headings such that their differences need no wrapping, and the row-major
// covariance of all predictions together.
JointAssociation AssociateJointly(const std::vector<double>& observations,
                                  const std::vector<double>& predictions,
                                  const std::vector<double>& covariance,
                                  double probability);

}  // namespace revisit::bench

#endif  // REVISIT_TESTS_BENCH_PEERS_MRPT_ASSOCIATION_H_
