// Where frames lie: poses, their covariances and the relations of frames.
#ifndef REVISIT_SERVER_CONVERSION_FRAMES_H_
#define REVISIT_SERVER_CONVERSION_FRAMES_H_

#include <cstddef>

#include "core/drive/frame_relation.h"
#include "core/drive/frame_state.h"
#include "core/geometry/pose.h"
#include "core/geometry/state_space.h"
#include "revisit/v1/candidate.pb.h"
#include "revisit/v1/geometry.pb.h"
#include "revisit/v1/group.pb.h"
#include "revisit/v1/recording.pb.h"
#include "server/fleet/known_history.h"

namespace revisit::server {

// PLANAR_6 or SPATIAL_10, by the state space.
void EncodeCovariance(const core::Covariance& covariance,
                      core::StateSpace space, v1::Covariance* message);
void EncodeStatePose(const core::Pose& pose, core::StateSpace space,
                     v1::StatePose* message);
v1::FrameState EncodeFrameState(core::FrameState state);

// `relation` is that of another recording, as it asks, to this one.
void EncodeFrame(const core::FrameRelation& relation, core::StateSpace space,
                 v1::Recording* message);
// Encodes recording `k` of the history. REQUIRES: k is below
// view->recordings.size().
void EncodeFrameTransform(const KnownHistory& history, std::size_t k,
                          const core::FrameRelation& relation,
                          v1::FrameTransform* message);

}  // namespace revisit::server

#endif  // REVISIT_SERVER_CONVERSION_FRAMES_H_
