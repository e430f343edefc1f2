// How far apart two positions are, for comparisons.
#ifndef REVISIT_CORE_GEOMETRY_GAP_H_
#define REVISIT_CORE_GEOMETRY_GAP_H_

#include <cmath>

namespace revisit::core {

// The gap between two positions, in metres. Comparing its length takes no root,
// but where the squares are so close that rounding may decide.
class Gap {
 public:
  Gap(double x, double y) : x_(x), y_(y), squared_(x * x + y * y) {}

  bool IsBelow(double limit) const {
    return IsClose(limit) ? std::hypot(x_, y_) < limit
                          : squared_ < limit * limit;
  }
  bool IsAbove(double limit) const {
    return IsClose(limit) ? std::hypot(x_, y_) > limit
                          : squared_ > limit * limit;
  }

 private:
  // Far more than rounding makes of squares.
  static constexpr double kTolerance = 1e-12;

  bool IsClose(double limit) const {
    const double square = limit * limit;
    return std::abs(squared_ - square) <= kTolerance * square;
  }

  double x_;
  double y_;
  double squared_;
};

}  // namespace revisit::core

#endif  // REVISIT_CORE_GEOMETRY_GAP_H_
