// Which coordinates the state of a pose has (pose.h).
#ifndef REVISIT_CORE_GEOMETRY_STATE_SPACE_H_
#define REVISIT_CORE_GEOMETRY_STATE_SPACE_H_

namespace revisit::core {

enum class StateSpace { kPlanar, kSpatial };

constexpr int DegreesOfFreedom(StateSpace space) {
  return space == StateSpace::kPlanar ? 3 : 4;
}

}  // namespace revisit::core

#endif  // REVISIT_CORE_GEOMETRY_STATE_SPACE_H_
