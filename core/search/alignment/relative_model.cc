#include "core/search/alignment/relative_model.h"

#include <cmath>

#include "core/geometry/heading.h"

namespace revisit::core {

double LogNewPlaceTerm(const RelativeModel& model) {
  const int dimensions = DegreesOfFreedom(model.similarity.state_space);
  const double density =
      2.0 / (kPi * model.road_spacing_meters * model.spacing_meters) /
      (model.similarity.state_space == StateSpace::kSpatial ? kRoadHeightRange
                                                            : 1.0);
  return -0.5 * dimensions * std::log(2.0 * kPi) - std::log(density);
}

// 2 / B metres of road per square metre, each driven both ways.
double LogWorldNodes(const RelativeModel& model) {
  return std::log(4.0 * kWorldSquareMeters /
                  (model.road_spacing_meters * model.spacing_meters));
}

}  // namespace revisit::core
