// The recent path as a relative alignment compares it with the history: its
// shape filter, in the forms that the kernels take. Computed once per query and
// shared by all paths of all histories, in both directions.
#ifndef REVISIT_CORE_SEARCH_ALIGNMENT_RECENT_PATH_H_
#define REVISIT_CORE_SEARCH_ALIGNMENT_RECENT_PATH_H_

#include <cstddef>
#include <cstdint>
#include <vector>

#include "core/geometry/pose.h"
#include "core/geometry/state_matrix.h"
#include "core/search/alignment/query.h"
#include "core/search/alignment/relative_model.h"
#include "core/search/alignment/shape_filter.h"
#include "core/search/alignment/similarity_kernel.h"
#include "core/search/alignment/walk_kernel.h"

namespace revisit::core {

// Share of an end's covariance that its path cannot take away.
inline constexpr double kLeastUncertaintyLeft = 1e-3;

template <int D>
class RecentPath {
 public:
  RecentPath(const Query& query, const RelativeModel& model);

  // Nodes of the path.
  std::int64_t size() const { return filter_.size(); }
  const ShapeFilter<D>& filter() const { return filter_; }
  // Heading of the end.
  double heading() const { return heading_; }
  // w, which discounts the log-likelihood ratio.
  double weight() const { return weight_; }
  // Step t of the walk.
  const WalkStep& step(std::int64_t t) const {
    return steps_[static_cast<std::size_t>(t)];
  }
  // Log-likelihood ratio of a path without any innovation: none has more.
  double most_log_likelihood_ratio() const { return steps_[0].to_come; }

  // For each step, kMostEntries each: by how much a path of so many steps
  // shrinks the covariance of its end, in the axes of the local frame.
  const double* certainties() const { return certainties_.data(); }
  // By how much the longest path shrinks that covariance, in the axes of the
  // local frame: no path shrinks it more.
  StateMatrix<D> MostCertainty() const {
    return ToFrame(filter_.EndCertainty(size() - 1));
  }
  // B such that a path which shifts its end by s after `steps` steps has a
  // weighted log-likelihood ratio that is less for it by 1/2 s^T B^-1 s or
  // more; in the axes of the local frame.
  StateMatrix<D> FurtherShift(std::int64_t steps) const {
    return ToFrame(filter_.EndShiftAfter(steps) / weight_);
  }
  // A covariance or shift in the axes of the vehicle at the end, in those of
  // the local frame.
  StateMatrix<D> ToFrame(const StateMatrix<D>& covariance) const;
  StateVector<D> ShiftToFrame(const StateVector<D>& shift) const {
    return turn_ * shift;
  }

 private:
  ShapeFilter<D> filter_;
  double heading_;
  // By the heading, about z.
  StateMatrix<D> turn_;
  double weight_;
  std::vector<WalkStep> steps_;
  std::vector<double> certainties_;
};

// The lower triangle, row by row, as the kernels take it.
template <int D>
void PackLower(const StateMatrix<D>& matrix, double* entries) {
  for (int r = 0; r < D; ++r) {
    for (int c = 0; c <= r; ++c) *entries++ = matrix(r, c);
  }
}

}  // namespace revisit::core

#endif  // REVISIT_CORE_SEARCH_ALIGNMENT_RECENT_PATH_H_
