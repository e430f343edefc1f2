// A recorded drive as messages of the service.
#ifndef REVISIT_CLIENT_CLI_DRIVE_POSES_H_
#define REVISIT_CLIENT_CLI_DRIVE_POSES_H_

#include <cstddef>
#include <cstdint>
#include <vector>

#include "client/cli/evaluation/dead_reckoning.h"
#include "client/formats/drive_file.h"
#include "revisit/v1/geometry.pb.h"
#include "revisit/v1/vehicle.pb.h"

namespace revisit::client {

// The pose of sample `index`, with sequence index + 1, for a vehicle of this
// state space. The truth does not take part.
v1::Pose MakePose(const Drive& drive,
                  const std::vector<ClaimedUncertainty>& uncertainty,
                  v1::StateSpace state_space, std::size_t index);

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_CLI_DRIVE_POSES_H_
