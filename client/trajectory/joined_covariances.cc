#include "client/trajectory/joined_covariances.h"

#include <cmath>
#include <cstddef>

namespace revisit::client {
namespace {

// m c m', for matrices of the state.
StateMatrix Congruent(const StateMatrix& m, const StateMatrix& c) {
  const auto product = [](const StateMatrix& a, const StateMatrix& b,
                          bool transposed) {
    StateMatrix result = {};
    for (std::size_t row = 0; row < 4; ++row) {
      for (std::size_t column = 0; column < 4; ++column) {
        for (std::size_t k = 0; k < 4; ++k) {
          result[4 * row + column] +=
              a[4 * row + k] *
              (transposed ? b[4 * column + k] : b[4 * k + column]);
        }
      }
    }
    return result;
  };
  return product(product(m, c, false), m, true);
}

constexpr StateMatrix kIdentity = {1, 0, 0, 0, 0, 1, 0, 0,
                                   0, 0, 1, 0, 0, 0, 0, 1};

}  // namespace

StateMatrix JoinedCovariances::Next(const LocalPose& stored,
                                    const std::array<double, 3>& position,
                                    double heading) {
  if (last_ && stored.recording_start) {
    end_ = last_;
    turn_ = heading - stored.heading;
  }
  StateMatrix covariance = stored.covariance;
  if (end_) {
    const double c = std::cos(turn_);
    const double s = std::sin(turn_);
    StateMatrix turned = kIdentity;
    turned[0] = turned[5] = c;
    turned[1] = -s;
    turned[4] = s;
    StateMatrix lever = kIdentity;
    lever[3] = -(position[1] - end_->position[1]);
    lever[7] = position[0] - end_->position[0];
    covariance = Congruent(turned, covariance);
    const StateMatrix carried = Congruent(lever, end_->covariance);
    for (std::size_t i = 0; i < covariance.size(); ++i) {
      covariance[i] += carried[i];
    }
  }
  last_ = {position, covariance};
  return covariance;
}

}  // namespace revisit::client
