#include "core/search/alignment/recent_path.h"

#include "core/geometry/state_matrix.h"

namespace revisit::core {

template <int D>
RecentPath<D>::RecentPath(const Query& query, const RelativeModel& model)
    : filter_(query, model.similarity.correlation, model.shape,
              model.similarity.tolerance, model.spacing_meters,
              model.similarity.inflation),
      weight_(ShapeWeight(model.shape, model.spacing_meters)),
      steps_(static_cast<std::size_t>(query.steps)) {
  for (std::size_t t = steps_.size(); t-- > 0;) {
    const auto number = static_cast<std::int64_t>(t);
    WalkStep& step = steps_[t];
    step = filter_.Kernel(number);
    step.settled = 2.0 * kSlipCost;
    if (t + 1 < steps_.size()) {
      const WalkStep& next = steps_[t + 1];
      step.to_come = next.to_come + next.surprise;
    }
  }
}

template class RecentPath<3>;
template class RecentPath<4>;

}  // namespace revisit::core
