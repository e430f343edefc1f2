// By what rules two poses are compared, apart from how uncertain they are
// (similarity_model.h).
#ifndef REVISIT_CORE_NOISE_COMPARISON_H_
#define REVISIT_CORE_NOISE_COMPARISON_H_

#include <cstddef>

namespace revisit::core {

// The factor c of the squared Mahalanobis distance in a log-similarity
// (log_similarity.h): 1/2, or 1 as the paper prints it.
enum class LikelihoodForm { kGaussian, kAsPrinted };

// The direction in which the history was driven, against the recent path.
enum class Direction { kSame, kOpposite };

// Index of a direction in arrays of two.
constexpr std::size_t IndexOf(Direction direction) {
  return direction == Direction::kSame ? 0 : 1;
}

// How far apart two passes of one place may truly be: standard deviations,
// whose squares are added to the diagonal of Gamma (R).
struct PlaceTolerance {
  double position_meters = 2.0;
  double heading_radians = 0.1;

  bool operator==(const PlaceTolerance& other) const {
    return position_meters == other.position_meters &&
           heading_radians == other.heading_radians;
  }
};

}  // namespace revisit::core

#endif  // REVISIT_CORE_NOISE_COMPARISON_H_
