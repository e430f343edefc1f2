// Poses and findings of a vehicle, read page after page.
#ifndef REVISIT_CLIENT_TRAJECTORY_STORED_POSES_H_
#define REVISIT_CLIENT_TRAJECTORY_STORED_POSES_H_

#include <cstdint>
#include <functional>
#include <string>
#include <vector>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "client/revisit/client.h"
#include "revisit/v1/geometry.pb.h"
#include "revisit/v1/loop_closure.pb.h"
#include "revisit/v1/pose_graph_service.pb.h"
#include "revisit/v1/recording.pb.h"
#include "revisit/v1/vehicle.pb.h"

namespace revisit::client {

// Calls `visit` for each pose, by sequence; a status but OK from it ends the
// visits and is returned. `vehicle` is a resource name.
absl::Status VisitPoses(
    const Client& client, const std::string& vehicle, v1::PoseView view,
    const std::function<absl::Status(const v1::Pose&)>& visit);

// The same for each pose in both views. ABORTED if these have not got the same
// poses, because the vehicle was changed meanwhile.
absl::Status VisitBothViews(
    const Client& client, const std::string& vehicle,
    const std::function<absl::Status(const v1::Pose& current,
                                     const v1::Pose& as_sent)>& visit);

// All of them, by name. `vehicle` is a resource name.
absl::StatusOr<std::vector<v1::LoopClosure>> ReadLoopClosures(
    const Client& client, const std::string& vehicle);
absl::StatusOr<std::vector<v1::RejectedCandidate>> ReadRejectedCandidates(
    const Client& client, const std::string& vehicle);

// All recordings, the oldest first. `vehicle` is a resource name.
absl::StatusOr<std::vector<v1::Recording>> ReadRecordings(
    const Client& client, const std::string& vehicle);

// The recording that holds a pose; null if there is none.
const v1::Recording* RecordingOf(const std::vector<v1::Recording>& recordings,
                                 std::uint64_t sequence);

// The vehicle of this resource name.
absl::StatusOr<v1::Vehicle> ReadVehicle(const Client& client,
                                        const std::string& vehicle);

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_TRAJECTORY_STORED_POSES_H_
