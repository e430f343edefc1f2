// How two poses of a vehicle lie to each other, with its uncertainty: the edges
// that an optimiser wants.
#ifndef REVISIT_CLIENT_TRAJECTORY_RELATIVE_POSE_H_
#define REVISIT_CLIENT_TRAJECTORY_RELATIVE_POSE_H_

#include <array>

#include "client/trajectory/local_pose.h"
#include "revisit/v1/loop_closure.pb.h"
#include "revisit/v1/vehicle.pb.h"

namespace revisit::client {

// A pose `to` as seen from a pose `from`, in the axes of `from`, levelled:
// the local frame turned about z by the heading of `from`.
struct RelativePose {
  // x, y, z in metres.
  std::array<double, 3> position = {};
  double heading = 0.0;
  // The covariance of these numbers' errors, in the same axes; positive
  // definite, but for z of a PLANAR vehicle.
  StateMatrix covariance = {};
};

// No step of a vehicle is known better than this in any direction. Optimisers
// take no edge without uncertainty.
inline constexpr double kLeastStepMeters = 1e-3;
inline constexpr double kLeastStepRadians = 1e-4;

struct Step {
  RelativePose relative;
  // Whether the covariance was raised to the least one in some direction.
  bool raised = false;
};

// From one pose to the next. The covariance is what the vehicle's correlation
// model leaves of the two poses' own: with S_i and S_j, the transition Psi of
// the model, and L, which carries the error of i over to j as one rigid body,
//
//   S_j + L S_i L^T - L S_i Psi^T - Psi S_i L^T
//
// which for DEAD_RECKONING, where Psi is L, is S_j - L S_i L^T: what the step
// has added. Under a model that the API of this client does not have, the two
// share nothing: Psi is 0.
Step StepBetween(const LocalPose& from, const LocalPose& to,
                 const v1::VehicleSettings& settings);

// A step of which nothing is known but how far it leads.
RelativePose JumpBetween(const LocalPose& from, const LocalPose& to);

// From the last pose of a recording to the first pose `to` of the one that
// begins where it ended: both lie at one place, as far as RecordingStart.after
// says, or the service where it does not.
RelativePose GapBefore(const LocalPose& to, const v1::RecordingStart& start,
                       v1::StateSpace state_space);

// From the first pose of a recording to the first one of a later one, both of
// which were placed by datums: as these say, whose errors count once where it
// is the same datum.
RelativePose DatumsBetween(const LocalPose& from, const v1::Datum& from_datum,
                           const LocalPose& to, const v1::Datum& to_datum,
                           v1::StateSpace state_space);

// From the matched pose to the query pose, as the closure's measurement says.
// Without one: the two lie at one place, with the uncertainty that searches
// assume, and head the same or the opposite way, whichever the estimates are
// nearer to.
RelativePose ClosureBetween(const v1::LoopClosure& closure,
                            const LocalPose& matched, const LocalPose& query);

// The inverse covariance of (x, y, heading), in the axes of `to`: the upper
// triangle by rows.
std::array<double, 6> PlanarInformation(const RelativePose& relative);

// A relative pose in the body's own axes.
struct SpatialEdge {
  std::array<double, 3> position = {};
  // x, y, z, w.
  std::array<double, 4> orientation = {};
  // The inverse covariance of position and of the rotation vector, in radians,
  // in the axes of `to`: the upper triangle by rows.
  std::array<double, 21> information = {};
};

// Roll and pitch are those of the two poses, taken to be as uncertain as the
// heading is.
SpatialEdge SpatialEdgeOf(const RelativePose& relative, const LocalPose& from,
                          const LocalPose& to);

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_TRAJECTORY_RELATIVE_POSE_H_
