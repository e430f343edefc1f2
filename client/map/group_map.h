// The vehicles of a group beside the one whose map it is.
#ifndef REVISIT_CLIENT_MAP_GROUP_MAP_H_
#define REVISIT_CLIENT_MAP_GROUP_MAP_H_

#include <string>
#include <vector>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "client/map/server_map.h"
#include "client/revisit/client.h"
#include "client/terminal/terminal.h"
#include "revisit/v1/group.pb.h"

namespace revisit::client {

// Where the vehicles of a group lie in the frame of one of them, and what was
// confirmed and rejected between them.
struct GroupOnMap {
  // By vehicle and recording.
  std::vector<v1::FrameTransform> frames;
  std::vector<v1::InterVehicleLoopClosure> links;
  std::vector<v1::InterVehicleRejectedCandidate> rejections;
};

// Both are resource names. UNAVAILABLE as ListFrameTransforms.
absl::StatusOr<GroupOnMap> ReadGroup(const Client& client,
                                     const std::string& group,
                                     const std::string& vehicle);

// Adds the nodes of the others to a map that has none yet.
absl::Status AddOtherVehicles(const Client& client, const GroupOnMap& group,
                              const std::string& vehicle,
                              const Terminal& terminal, ServerMap* map);

// Carries all nodes to the frame of the vehicle's last recording, with a colour
// and a label for each recording. REQUIRES: the map has the vehicle's own nodes
// behind those of the others.
void PlaceVehicles(const GroupOnMap& group, const std::string& vehicle,
                   ServerMap* map);

// Adds what was confirmed and rejected between vehicles that are on the map.
void AddPairs(const GroupOnMap& group, const std::string& vehicle,
              ServerMap* map);

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_MAP_GROUP_MAP_H_
