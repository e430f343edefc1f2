// Nodes of maps as the server exports them.
#ifndef REVISIT_CLIENT_MAP_MAP_NODES_H_
#define REVISIT_CLIENT_MAP_MAP_NODES_H_

#include <cstddef>
#include <cstdint>
#include <string>
#include <vector>

#include "absl/status/statusor.h"
#include "client/map/map_contents.h"
#include "client/revisit/client.h"
#include "client/terminal/terminal.h"
#include "revisit/v1/vehicle.pb.h"

namespace revisit::client {

// Adds the nodes of a vehicle, each in the frame of its recording, behind those
// that there are. `vehicle` is a resource name.
absl::StatusOr<v1::Vehicle> ReadMapNodes(const Client& client,
                                         const std::string& vehicle,
                                         const Terminal& terminal,
                                         std::vector<MapNode>* nodes);

// The node in [begin, end), those of one vehicle, that stands for a pose: the
// last one at or before it, which is within a node spacing of the one that the
// service links. REQUIRES: begin < end.
std::size_t MapNodeAt(const std::vector<MapNode>& nodes, std::size_t begin,
                      std::size_t end, std::uint64_t sequence);

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_MAP_MAP_NODES_H_
