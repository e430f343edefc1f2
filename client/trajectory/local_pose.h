// Stored poses in the local frame of their vehicle.
#ifndef REVISIT_CLIENT_TRAJECTORY_LOCAL_POSE_H_
#define REVISIT_CLIENT_TRAJECTORY_LOCAL_POSE_H_

#include <array>
#include <cstdint>
#include <memory>
#include <optional>

#include "google/protobuf/timestamp.pb.h"
#include "revisit/v1/geometry.pb.h"
#include "revisit/v1/vehicle.pb.h"

namespace revisit::client {

// A matrix over (x, y, z, heading), row-major.
using StateMatrix = std::array<double, 16>;

// A covariance of any form, reduced to the state (x, y, z, heading). Without z
// in the form PLANAR_6. REQUIRES: as many numbers as the form has.
StateMatrix StateCovariance(const v1::Covariance& covariance);

// The other way, in the form SPATIAL_10 or PLANAR_6.
v1::Covariance ToCovariance(const StateMatrix& matrix, bool spatial);

// Sets Pose.error_transition, over the state of a spatial or planar vehicle.
void SetErrorTransition(const StateMatrix& matrix, bool spatial,
                        v1::Pose* pose);

// Sets Pose.quaternion to x, y, z, w.
void SetQuaternion(const std::array<double, 4>& orientation, v1::Pose* pose);

// An orientation (x, y, z, w) turned by this angle about the local z axis.
std::array<double, 4> Turned(const std::array<double, 4>& orientation,
                             double radians);

struct LocalPose {
  std::uint64_t sequence = 0;
  std::optional<google::protobuf::Timestamp> stamp;
  // x, y, z in metres.
  std::array<double, 3> position = {};
  // x, y, z, w: the rotation of the body's axes (forward, left, up) into the
  // local frame; about z alone where the pose has a heading alone.
  std::array<double, 4> orientation = {0.0, 0.0, 0.0, 1.0};
  // The direction of the body's forward axis, in radians.
  double heading = 0.0;
  // Rows and columns of z are 0 for a PLANAR vehicle.
  StateMatrix covariance = {};
  // Only where the pose has one.
  std::optional<StateMatrix> error_transition;
  // Where the pose is the first of a recording.
  std::optional<v1::RecordingStart> recording_start;
};

// A pose of a frame that lies so in another one, in that one: turned about z
// and moved.
LocalPose InOuterFrame(const LocalPose& pose, const v1::StatePose& frame);

// The local frame of one vehicle. Thread-compatible.
class LocalFrame {
 public:
  // Geodetic vehicles without an origin have no poses yet.
  explicit LocalFrame(const v1::VehicleSettings& settings);
  ~LocalFrame();

  LocalFrame(const LocalFrame&) = delete;
  LocalFrame& operator=(const LocalFrame&) = delete;

  // Geodetic positions, with their orientation and covariance, are turned into
  // East-North-Up at the vehicle's origin, as the service does it.
  LocalPose Localize(const v1::Pose& pose) const;

  // The longitude, latitude and height of a local position.
  // REQUIRES: a geodetic vehicle with an origin.
  v1::GeodeticPosition ToGeodetic(const std::array<double, 3>& position) const;

 private:
  struct Origin;
  const bool spatial_;
  std::unique_ptr<Origin> origin_;
};

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_TRAJECTORY_LOCAL_POSE_H_
