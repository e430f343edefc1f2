#include "server/conversion/frames.h"

#include <iterator>

#include "core/geometry/state_matrix.h"
#include "server/conversion/names.h"
#include "server/fields/enums.h"

namespace revisit::server {
namespace {

constexpr EnumRow<v1::FrameState, core::FrameState> kFrameStates[] = {
    {v1::FRAME_STATE_SAME, core::FrameState::kSame},
    {v1::FRAME_STATE_AFTER, core::FrameState::kAfter},
    {v1::FRAME_STATE_DATUM, core::FrameState::kDatum},
    {v1::FRAME_STATE_PROVISIONAL, core::FrameState::kProvisional},
    {v1::FRAME_STATE_KNOWN, core::FrameState::kKnown},
    {v1::FRAME_STATE_NONE, core::FrameState::kNone}};
// Every state of the API but UNSPECIFIED has a row.
static_assert(std::size(kFrameStates) == v1::FrameState_ARRAYSIZE - 1);

// Recording and FrameTransform name these fields alike.
template <typename Message>
void EncodeRelation(const core::FrameRelation& relation, core::StateSpace space,
                    Message* message) {
  message->set_frame_state(EncodeFrameState(relation.state));
  if (!relation.is_tied()) return;
  EncodeStatePose(relation.transform, space, message->mutable_frame_pose());
  if (relation.state == core::FrameState::kSame) return;
  EncodeCovariance(core::ToCovariance<4>(relation.fixed + relation.drift +
                                         relation.known_drift),
                   space, message->mutable_frame_covariance());
  EncodeStatePose(relation.place, space, message->mutable_frame_reference());
}

}  // namespace

void EncodeCovariance(const core::Covariance& covariance,
                      core::StateSpace space, v1::Covariance* message) {
  if (space == core::StateSpace::kSpatial) {
    message->set_form(v1::COVARIANCE_FORM_SPATIAL_10);
    message->mutable_values()->Add(covariance.upper.begin(),
                                   covariance.upper.end());
    return;
  }
  message->set_form(v1::COVARIANCE_FORM_PLANAR_6);
  for (int r = 0; r < 3; ++r) {
    for (int c = r; c < 3; ++c) {
      message->add_values(
          covariance(core::StateIndex<3>(r), core::StateIndex<3>(c)));
    }
  }
}

void EncodeStatePose(const core::Pose& pose, core::StateSpace space,
                     v1::StatePose* message) {
  message->set_x_meters(pose.x);
  message->set_y_meters(pose.y);
  if (space == core::StateSpace::kSpatial) message->set_z_meters(pose.z);
  message->set_heading_radians(pose.heading);
}

v1::FrameState EncodeFrameState(core::FrameState state) {
  return ToProto(kFrameStates, state);
}

void EncodeFrame(const core::FrameRelation& relation, core::StateSpace space,
                 v1::Recording* message) {
  EncodeRelation(relation, space, message);
}

void EncodeFrameTransform(const KnownHistory& history, std::size_t k,
                          const core::FrameRelation& relation,
                          v1::FrameTransform* message) {
  message->set_vehicle(VehicleName(history.vehicle_id));
  message->set_vehicle_uid(history.config.uid);
  message->set_recording(RecordingName(
      history.vehicle_id, history.view->recordings[k].first_sequence));
  EncodeRelation(relation, history.config.drive.state_space, message);
  message->set_loop_closure_count(relation.links);
}

}  // namespace revisit::server
