#include "client/trajectory/drive_poses.h"

#include <algorithm>
#include <utility>

#include "absl/strings/str_cat.h"
#include "client/formats/times.h"
#include "client/revisit/printable_text.h"
#include "client/terminal/terminal.h"
#include "client/trajectory/local_pose.h"
#include "google/protobuf/timestamp.pb.h"

namespace revisit::client {

namespace {

void SetStamp(std::int64_t time, google::protobuf::Timestamp* stamp) {
  const std::int64_t nanos =
      (time % kNanosecondsPerSecond + kNanosecondsPerSecond) %
      kNanosecondsPerSecond;
  stamp->set_seconds((time - nanos) / kNanosecondsPerSecond);
  stamp->set_nanos(static_cast<std::int32_t>(nanos));
}

void SetPosition(const Sample& sample, v1::Pose* pose) {
  if (sample.geodetic.has_value()) {
    v1::GeodeticPosition* geodetic = pose->mutable_geodetic();
    geodetic->set_latitude_degrees(sample.geodetic->latitude_degrees);
    geodetic->set_longitude_degrees(sample.geodetic->longitude_degrees);
    geodetic->set_height_meters(sample.geodetic->height_meters);
  } else {
    v1::LocalPosition* local = pose->mutable_local();
    local->set_x_meters(sample.estimate.x);
    local->set_y_meters(sample.estimate.y);
    local->set_z_meters(sample.z);
  }
}

void SetCovariance(const ClaimedUncertainty& uncertainty, bool spatial,
                   v1::Covariance* covariance) {
  const auto& [xx, xy, xh, yy, yh, hh] = uncertainty.planar;
  if (spatial) {
    const double zz = uncertainty.z_variance;
    const auto& [xz, yz, zh] = uncertainty.z_mixed;
    covariance->set_form(v1::COVARIANCE_FORM_SPATIAL_10);
    for (const double value : {xx, xy, xz, xh, yy, yz, yh, zz, zh, hh}) {
      covariance->add_values(value);
    }
  } else {
    covariance->set_form(v1::COVARIANCE_FORM_PLANAR_6);
    for (const double value : {xx, xy, xh, yy, yh, hh}) {
      covariance->add_values(value);
    }
  }
}

}  // namespace

v1::Pose MakePose(const Sample& sample, const ClaimedUncertainty& uncertainty,
                  v1::StateSpace state_space, std::uint64_t sequence) {
  v1::Pose pose;
  pose.set_sequence(sequence);
  if (sample.time_nanoseconds.has_value()) {
    SetStamp(*sample.time_nanoseconds, pose.mutable_stamp());
  }
  SetPosition(sample, &pose);
  if (sample.quaternion.has_value()) {
    SetQuaternion(*sample.quaternion, &pose);
  } else {
    pose.set_heading_radians(sample.estimate.heading);
  }
  SetCovariance(uncertainty, state_space == v1::STATE_SPACE_SPATIAL,
                pose.mutable_covariance());
  return pose;
}

absl::StatusOr<v1::Pose> MakeNextPose(
    const Sample& sample, v1::StateSpace state_space, std::uint64_t sequence,
    RecordingStarts* starts, UncertaintyClaims* claims,
    const std::function<void(const std::string& note)>& tell) {
  auto begun = starts->Next(sample);
  if (!begun.ok()) return begun.status();
  if (begun->has_value()) {
    claims->BeginFrame();
    if (!(*begun)->note.empty()) tell((*begun)->note);
  }
  const auto claim = claims->Next(sample);
  if (!claim.ok()) return claim.status();
  v1::Pose pose = MakePose(sample, *claim, state_space, sequence);
  if (begun->has_value()) {
    *pose.mutable_recording_start() = std::move((*begun)->start);
  }
  return pose;
}

void AddErrorTransition(const Sample& sample, v1::Pose* pose) {
  for (const double entry : *sample.error_transition) {
    pose->add_error_transition(entry);
  }
}

void AppendPoses(const Drive& drive,
                 const std::vector<ClaimedUncertainty>& uncertainty,
                 const RecordingsOfDrive& starts,
                 const v1::VehicleSettings& settings, const SampleRange& range,
                 std::size_t batch_poses, PoseStream* stream) {
  const bool filter =
      settings.correlation_model() == v1::CORRELATION_MODEL_FILTER;
  for (std::size_t next = range.begin; next < range.end;) {
    v1::PoseBatch batch;
    const std::size_t end = std::min(range.end, next + batch_poses);
    for (; next < end; ++next) {
      const Sample& sample = drive.samples[next];
      v1::Pose* pose = batch.add_poses();
      *pose =
          MakePose(sample, uncertainty[next], settings.state_space(), next + 1);
      const auto start = starts.find(next);
      // A filter that begins anew has none to tell.
      if (filter && next > 0 && start == starts.end()) {
        AddErrorTransition(sample, pose);
      }
      if (start != starts.end())
        *pose->mutable_recording_start() = start->second;
    }
    if (!stream->Append(std::move(batch)).ok()) return;
  }
}

std::string WarningText(const v1::Warning& warning) {
  return absl::StrCat("warning: ", Printable(warning.message()));
}

std::string JumpText(const v1::Jump& jump) {
  return absl::StrCat("jump of ", Fixed(jump.distance_meters(), 1),
                      " m before sequence ", jump.sequence());
}

}  // namespace revisit::client
