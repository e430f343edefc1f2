// Sums of exponentials, most of whose terms are too small to count.
#ifndef REVISIT_CORE_SEARCH_ALIGNMENT_EXPONENTIAL_SUM_H_
#define REVISIT_CORE_SEARCH_ALIGNMENT_EXPONENTIAL_SUM_H_

#include <algorithm>
#include <cmath>

namespace revisit::core {

// A term that is smaller than a sum by this factor, as a logarithm, is less
// than half of the sum's last bit: 54 ln 2 is 37.4.
inline constexpr double kNegligible = 38.0;

// The sum of e^x over all x, added in their order, to the last bit.
class ExponentialSum {
 public:
  void Add(double x) {
    if (x < greatest_ - kNegligible) return;
    greatest_ = std::max(greatest_, x);
    sum_ += std::exp(x);
  }

  double value() const { return sum_; }

 private:
  // Below this, e^x is 0 in double precision.
  static constexpr double kUnderflow = -746.0;

  // The greatest x that was added, if it counts.
  double greatest_ = kUnderflow + kNegligible;
  double sum_ = 0.0;
};

}  // namespace revisit::core

#endif  // REVISIT_CORE_SEARCH_ALIGNMENT_EXPONENTIAL_SUM_H_
