// A verifier's measurement between the two poses of a loop closure.
#ifndef REVISIT_CORE_DRIVE_MEASURED_LOOP_H_
#define REVISIT_CORE_DRIVE_MEASURED_LOOP_H_

#include "core/geometry/pose.h"

namespace revisit::core {

// The pose of the query in the levelled body axes of the match (x forward, y
// left, z up), with the covariance of its error in these axes.
struct LoopMeasurement {
  Pose relative;
  Covariance covariance;
};

// A pose of the stream as it is estimated, in the local frame.
struct PoseEstimate {
  Pose pose;
  Covariance covariance;
};

// A measurement with the poses between which it was made: nodes lie beside
// them, by more than a good measurement is uncertain.
struct MeasuredLoop {
  LoopMeasurement measurement;
  PoseEstimate query;
  PoseEstimate matched;
};

}  // namespace revisit::core

#endif  // REVISIT_CORE_DRIVE_MEASURED_LOOP_H_
