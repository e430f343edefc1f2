// The joint covariance of the errors of all nodes of a drive by dead reckoning,
// dense, with closures applied to it one after the other as updates of a Kalman
// filter.
#ifndef REVISIT_TESTS_ORACLE_JOINT_ERRORS_H_
#define REVISIT_TESTS_ORACLE_JOINT_ERRORS_H_

#include <Eigen/LU>
#include <cstdint>
#include <vector>

#include "core/drive/pose_graph.h"
#include "tests/oracle/error_chain.h"
#include "tests/oracle/wide_state.h"

namespace revisit::oracle {

class JointErrors {
 public:
  // Standard deviations are `inflation` times those of the nodes, between which
  // each step adds what is missing.
  JointErrors(const core::PoseGraph& graph, int dimensions, double inflation)
      : d_(dimensions), nodes_(graph.size()) {
    std::vector<core::Pose> path;
    std::vector<WideMatrix> claimed;
    for (core::NodeIndex i = 0; i < nodes_; ++i) {
      path.push_back(graph.pose(i));
      claimed.push_back(static_cast<Wide>(inflation) * inflation *
                        WideCovarianceOf(graph.covariance(i), d_));
    }
    const ErrorChain chain(path, claimed[0], [&](std::size_t i) {
      const WideMatrix f =
          WideLever(static_cast<Wide>(path[i].x) - path[i - 1].x,
                    static_cast<Wide>(path[i].y) - path[i - 1].y, d_);
      return WideMatrix(claimed[i] - f * claimed[i - 1] * f.transpose());
    });
    joint_ = WideMatrix::Zero(At(nodes_), At(nodes_));
    for (core::NodeIndex i = 0; i < nodes_; ++i) {
      for (core::NodeIndex j = 0; j < nodes_; ++j) {
        joint_.block(At(i), At(j), d_, d_) = chain.Cross(i, j);
      }
    }
  }

  // Shows e_query - lever e_matched up to an error of this covariance.
  void Show(core::NodeIndex query, core::NodeIndex matched,
            const WideMatrix& lever, const WideMatrix& tolerance) {
    WideMatrix h = WideMatrix::Zero(d_, At(nodes_));
    h.middleCols(At(query), d_) += WideMatrix::Identity(d_, d_);
    h.middleCols(At(matched), d_) -= lever;
    const WideMatrix crossed = joint_ * h.transpose();
    const WideMatrix innovation = h * crossed + tolerance;
    joint_ -= crossed * innovation.inverse() * crossed.transpose();
  }

  // The mean over the nodes of the variances of x and y together.
  Wide MeanPositionVariance() const {
    Wide sum = 0.0L;
    for (core::NodeIndex i = 0; i < nodes_; ++i) {
      sum += joint_(At(i), At(i)) + joint_(At(i) + 1, At(i) + 1);
    }
    return sum / static_cast<Wide>(nodes_);
  }

 private:
  Eigen::Index At(core::NodeIndex i) const {
    return static_cast<Eigen::Index>(i) * d_;
  }

  int d_;
  core::NodeIndex nodes_;
  WideMatrix joint_;
};

}  // namespace revisit::oracle

#endif  // REVISIT_TESTS_ORACLE_JOINT_ERRORS_H_
