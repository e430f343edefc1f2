// Lists of the vehicles of a group, read page after page.
#ifndef REVISIT_CLIENT_TRAJECTORY_STORED_GROUPS_H_
#define REVISIT_CLIENT_TRAJECTORY_STORED_GROUPS_H_

#include <string>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "client/revisit/client.h"
#include "revisit/v1/group.pb.h"

namespace revisit::client {

// All pages of the frames that are asked for, as one. ABORTED if the group
// changed meanwhile.
absl::StatusOr<v1::ListFrameTransformsResponse> ReadFrameTransforms(
    const Client& client, v1::ListFrameTransformsRequest request);

// Adds all loop closures of a group, or all its rejected candidates, by name.
// `group` is a resource name. DATA_LOSS if some are damaged; the others are
// there all the same.
absl::Status ReadPairs(const Client& client, const std::string& group,
                       v1::ListInterVehicleLoopClosuresResponse* links);
absl::Status ReadPairs(
    const Client& client, const std::string& group,
    v1::ListInterVehicleRejectedCandidatesResponse* rejections);

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_TRAJECTORY_STORED_GROUPS_H_
