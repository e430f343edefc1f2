#include "core/noise/similarity_model.h"

#include "core/geometry/heading.h"

namespace revisit::core {

Pose PassDifference(const SimilarityModel& model, const Pose& a,
                    const Pose& b) {
  Pose difference = Difference(a, b);
  if (model.direction == Direction::kOpposite) {
    difference.heading = WrapHeading(difference.heading + kPi);
  }
  return difference;
}

}  // namespace revisit::core
