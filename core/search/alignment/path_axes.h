// The recent path in the axes in which it is compared with a history: what its
// shape filter knows of the end, turned by the heading that the query has in
// the history's frame.
#ifndef REVISIT_CORE_SEARCH_ALIGNMENT_PATH_AXES_H_
#define REVISIT_CORE_SEARCH_ALIGNMENT_PATH_AXES_H_

#include <cstdint>
#include <vector>

#include "core/geometry/state_matrix.h"
#include "core/search/alignment/recent_path.h"
#include "core/search/alignment/similarity_kernel.h"

namespace revisit::core {

// Share of an end's covariance that its path cannot take away.
inline constexpr double kLeastUncertaintyLeft = 1e-3;

template <int D>
class PathAxes {
 public:
  // The path must outlive this. Neighbours of an end are at most so far from it
  // in each direction, m.
  PathAxes(const RecentPath<D>& recent, double heading, double apart_meters);

  double heading() const { return heading_; }
  double apart_meters() const { return apart_meters_; }
  // For each step of the path, kMostEntries each: by how much a path of so many
  // steps shrinks the covariance of its end.
  const double* certainties() const { return certainties_.data(); }
  // By how much the longest path shrinks that covariance: no path shrinks it
  // more.
  StateMatrix<D> MostCertainty() const {
    return Turned(recent_.filter().EndCertainty(recent_.size() - 1));
  }
  // B such that a path which shifts its end by s after `steps` steps has a
  // weighted log-likelihood ratio that is less for it by 1/2 s^T B^-1 s or
  // more.
  StateMatrix<D> FurtherShift(std::int64_t steps) const {
    return Turned(recent_.filter().EndShiftAfter(steps) / recent_.weight());
  }
  // A shift in the axes of the vehicle at the end.
  StateVector<D> TurnedShift(const StateVector<D>& shift) const {
    return turn_ * shift;
  }

  // How much paths can change one end, and any of its neighbours
  // (SearchBounds).
  const ChangeBound& of_end() const { return of_end_; }
  const ChangeBound& of_ends_around() const { return of_ends_around_; }

 private:
  // A covariance in the axes of the vehicle at the end.
  StateMatrix<D> Turned(const StateMatrix<D>& covariance) const {
    return core::Turned<D>(covariance, turn_(0, 0), turn_(1, 0));
  }

  const RecentPath<D>& recent_;
  double heading_;
  double apart_meters_;
  // By the heading, about z.
  StateMatrix<D> turn_;
  std::vector<double> certainties_;
  ChangeBound of_end_;
  ChangeBound of_ends_around_;
};

// The lower triangle, row by row, as the kernels take it.
template <int D>
void PackLower(const StateMatrix<D>& matrix, double* entries) {
  for (int r = 0; r < D; ++r) {
    for (int c = 0; c <= r; ++c) *entries++ = matrix(r, c);
  }
}

}  // namespace revisit::core

#endif  // REVISIT_CORE_SEARCH_ALIGNMENT_PATH_AXES_H_
