// Poses as transforms of frames: the pose of one frame in another one. All are
// levelled, so only headings turn.
#ifndef REVISIT_CORE_GEOMETRY_FRAME_TRANSFORM_H_
#define REVISIT_CORE_GEOMETRY_FRAME_TRANSFORM_H_

#include <cmath>

#include "core/geometry/heading.h"
#include "core/geometry/pose.h"

namespace revisit::core {

// The pose in the outer frame of what is at `inner` in a frame that is at
// `frame` there.
inline Pose Compose(const Pose& frame, const Pose& inner) {
  const double c = std::cos(frame.heading);
  const double s = std::sin(frame.heading);
  return {frame.x + c * inner.x - s * inner.y,
          frame.y + s * inner.x + c * inner.y, frame.z + inner.z,
          WrapHeading(frame.heading + inner.heading)};
}

// The pose of the outer frame in the one that is at `frame` there.
inline Pose Inverse(const Pose& frame) {
  const double c = std::cos(frame.heading);
  const double s = std::sin(frame.heading);
  return {-c * frame.x - s * frame.y, s * frame.x - c * frame.y, -frame.z,
          WrapHeading(-frame.heading)};
}

}  // namespace revisit::core

#endif  // REVISIT_CORE_GEOMETRY_FRAME_TRANSFORM_H_
