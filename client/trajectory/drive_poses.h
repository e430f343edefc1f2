// A recorded drive as messages of the service.
#ifndef REVISIT_CLIENT_TRAJECTORY_DRIVE_POSES_H_
#define REVISIT_CLIENT_TRAJECTORY_DRIVE_POSES_H_

#include <cstddef>
#include <cstdint>
#include <functional>
#include <map>
#include <string>
#include <vector>

#include "absl/status/statusor.h"
#include "client/formats/drive_file.h"
#include "client/revisit/pose_stream.h"
#include "client/trajectory/dead_reckoning.h"
#include "client/trajectory/recording_starts.h"
#include "revisit/v1/geometry.pb.h"
#include "revisit/v1/vehicle.pb.h"

namespace revisit::client {

// Makes the pose of a sample for a vehicle of this state space. Truth and error
// transition are left out.
v1::Pose MakePose(const Sample& sample, const ClaimedUncertainty& uncertainty,
                  v1::StateSpace state_space, std::uint64_t sequence);

// Makes the pose of the next sample of a drive, with what it claims and, where
// a recording begins with it, its start; errors are then claimed anew. `tell`
// is called with the note of such a start, if it has one. Errors are those of
// the two.
absl::StatusOr<v1::Pose> MakeNextPose(
    const Sample& sample, v1::StateSpace state_space, std::uint64_t sequence,
    RecordingStarts* starts, UncertaintyClaims* claims,
    const std::function<void(const std::string& note)>& tell);

// Adds the error transition of a planar sample.
// REQUIRES: the sample has one.
void AddErrorTransition(const Sample& sample, v1::Pose* pose);

// Samples from `begin` to before `end`.
struct SampleRange {
  std::size_t begin = 0;
  std::size_t end = 0;
};

// The recordings that begin in a drive, by the indices of their first samples.
using RecordingsOfDrive = std::map<std::size_t, v1::RecordingStart>;

// Appends these samples to a vehicle of these settings in batches, the pose of
// sample i with sequence i + 1, and with error transitions if its correlation
// model is FILTER. Stops early if the stream has failed; PoseStream::Finish()
// then says why.
void AppendPoses(const Drive& drive,
                 const std::vector<ClaimedUncertainty>& uncertainty,
                 const RecordingsOfDrive& starts,
                 const v1::VehicleSettings& settings, const SampleRange& range,
                 std::size_t batch_poses, PoseStream* stream);

// Reports a jump to people.
std::string JumpText(const v1::Jump& jump);

// Reports a server's warning to people.
std::string WarningText(const v1::Warning& warning);

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_TRAJECTORY_DRIVE_POSES_H_
