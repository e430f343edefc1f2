#include "core/search/alignment/path_axes.h"

#include <cstddef>

#include "core/geometry/heading.h"
#include "core/noise/similarity_model.h"

namespace revisit::core {

// For one end, SearchBounds says where B = (2 / w) E comes from. For those
// around it, B also has the covariance of how far they are apart.
template <int D>
PathAxes<D>::PathAxes(const RecentPath<D>& recent, double heading,
                      double apart_meters)
    : recent_(recent),
      heading_(heading),
      apart_meters_(apart_meters),
      turn_(TurnAbout<D>(heading)),
      certainties_(static_cast<std::size_t>(recent.size()) * kMostEntries) {
  for (std::int64_t t = recent.size(); t-- > 0;) {
    PackLower<D>(
        Turned(recent.filter().EndCertainty(t)),
        certainties_.data() + static_cast<std::size_t>(t) * kMostEntries);
  }
  PackLower<D>(Turned((2.0 / recent.weight()) * recent.filter().EndShift()),
               of_end_.shift);
  PackLower<D>(MostCertainty(), of_end_.certainty);
  of_end_.least_left = kLeastUncertaintyLeft;
  of_ends_around_ = of_end_;
  StateMatrix<D> apart = StateMatrix<D>::Zero();
  AddTolerance<D>({apart_meters, kPi}, &apart);
  double entries[kMostEntries] = {};
  PackLower<D>(apart, entries);
  for (std::size_t i = 0; i < kMostEntries; ++i) {
    of_ends_around_.shift[i] += entries[i];
  }
}

template class PathAxes<3>;
template class PathAxes<4>;

}  // namespace revisit::core
