// Joint covariance of the errors of all nodes of a drive, propagated whole from
// node to node, and a node's estimate conditioned on a closure elsewhere.
#ifndef REVISIT_TESTS_ORACLE_ERROR_CHAIN_H_
#define REVISIT_TESTS_ORACLE_ERROR_CHAIN_H_

#include <cstdint>
#include <utility>
#include <vector>

#include "core/geometry/pose.h"
#include "tests/oracle/wide_state.h"

namespace revisit::oracle {

class ErrorChain {
 public:
  // Dead reckoning along a path; `step_noise(i)` is what the step to pose i
  // adds.
  template <typename StepNoise>
  ErrorChain(const std::vector<core::Pose>& path, const WideMatrix& start,
             const StepNoise& step_noise)
      : d_(static_cast<int>(start.rows())),
        joint_(WideMatrix::Zero(Size(path), Size(path))) {
    joint_.topLeftCorner(d_, d_) = start;
    for (std::size_t i = 1; i < path.size(); ++i) {
      const int at = static_cast<int>(i) * d_;
      const WideMatrix f =
          WideLever(static_cast<Wide>(path[i].x) - path[i - 1].x,
                    static_cast<Wide>(path[i].y) - path[i - 1].y, d_);
      // With all errors before it.
      const WideMatrix row = f * joint_.block(at - d_, 0, d_, at);
      joint_.block(at, 0, d_, at) = row;
      joint_.block(0, at, at, d_) = row.transpose();
      joint_.block(at, at, d_, d_) =
          f * joint_.block(at - d_, at - d_, d_, d_) * f.transpose() +
          step_noise(i);
    }
  }

  WideMatrix Cross(std::int64_t i, std::int64_t j) const {
    return joint_.block(static_cast<int>(i) * d_, static_cast<int>(j) * d_, d_,
                        d_);
  }

  // Mean and covariance of (e_q - e_j), given that (e_c - lever e_m) + r is y
  // with r of covariance `tolerance`; all errors multiplied by `inflation`.
  std::pair<WideVector, WideMatrix> Condition(std::int64_t q, std::int64_t j,
                                              std::int64_t c, std::int64_t m,
                                              const WideVector& y,
                                              const WideMatrix& tolerance,
                                              double inflation,
                                              const WideMatrix& lever) const {
    const std::int64_t nodes[] = {q, j, c, m};
    WideMatrix four(4 * d_, 4 * d_);
    for (int a = 0; a < 4; ++a) {
      for (int b = 0; b < 4; ++b) {
        four.block(a * d_, b * d_, d_, d_) = static_cast<Wide>(inflation) *
                                             inflation *
                                             Cross(nodes[a], nodes[b]);
      }
    }
    const WideMatrix one = WideMatrix::Identity(d_, d_);
    const WideMatrix none = WideMatrix::Zero(d_, d_);
    WideMatrix both(2 * d_, 4 * d_);
    both << one, -one, none, none, none, none, one, -lever;
    WideMatrix joint = both * four * both.transpose();
    joint.bottomRightCorner(d_, d_) += tolerance;
    const WideMatrix mixed = joint.topRightCorner(d_, d_);
    const Eigen::LLT<WideMatrix> known(
        WideMatrix(joint.bottomRightCorner(d_, d_)));
    return {mixed * known.solve(y),
            joint.topLeftCorner(d_, d_) -
                mixed * known.solve(WideMatrix(mixed.transpose()))};
  }

 private:
  Eigen::Index Size(const std::vector<core::Pose>& path) const {
    return static_cast<Eigen::Index>(path.size()) * d_;
  }

  int d_;
  WideMatrix joint_;
};

}  // namespace revisit::oracle

#endif  // REVISIT_TESTS_ORACLE_ERROR_CHAIN_H_
