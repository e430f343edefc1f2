// Covariances of the poses of several recordings that an optimiser has brought
// into one frame, where its file states none.
//
// Each recording's own begin anew with its first pose, which says nothing of
// that frame, and claims that shrink contradict dead reckoning. So a recording
// goes on from where the one before it ended: to what its poses claim in their
// own frame, turned into the common one, comes the covariance of that end,
// carried along as one rigid body. It claims more than is left of the errors
// after an optimisation, as the stored covariances of one recording do.
#ifndef REVISIT_CLIENT_TRAJECTORY_JOINED_COVARIANCES_H_
#define REVISIT_CLIENT_TRAJECTORY_JOINED_COVARIANCES_H_

#include <array>
#include <optional>

#include "client/trajectory/local_pose.h"

namespace revisit::client {

class JoinedCovariances {
 public:
  // The covariance of the next pose, which is stored in the frame of its own
  // recording and has this position and heading in the common one.
  StateMatrix Next(const LocalPose& stored,
                   const std::array<double, 3>& position, double heading);

 private:
  struct Placed {
    std::array<double, 3> position = {};
    StateMatrix covariance = {};
  };

  // The last pose in the common frame.
  std::optional<Placed> last_;
  // The last pose of the recording before; none in the first one.
  std::optional<Placed> end_;
  // How the frame of the recording is turned in the common one.
  double turn_ = 0.0;
};

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_TRAJECTORY_JOINED_COVARIANCES_H_
