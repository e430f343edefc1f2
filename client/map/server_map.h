// The map of a vehicle as its server knows it, by itself or among the vehicles
// of a group.
#ifndef REVISIT_CLIENT_MAP_SERVER_MAP_H_
#define REVISIT_CLIENT_MAP_SERVER_MAP_H_

#include <cstddef>
#include <optional>
#include <string>
#include <vector>

#include "absl/status/status.h"
#include "absl/status/statusor.h"
#include "client/map/map_contents.h"
#include "client/revisit/client.h"
#include "client/terminal/terminal.h"
#include "revisit/v1/candidate.pb.h"
#include "revisit/v1/vehicle.pb.h"

namespace revisit::client {

// The nodes of another vehicle on the map.
struct OtherVehicle {
  // The resource name.
  std::string name;
  std::size_t begin = 0;
  std::size_t end = 0;
};

struct ServerMap {
  v1::Vehicle vehicle;
  MapContents contents;
  // The group's vehicles that have nodes, which lie before the vehicle's own.
  std::vector<OtherVehicle> others = {};
};

// Nodes, loop closures and rejected candidates, without checks. FAILED_
// PRECONDITION if there is no node. `vehicle` is a resource name.
absl::StatusOr<ServerMap> ReadServerMap(const Client& client,
                                        const std::string& vehicle,
                                        const Terminal& terminal);

// The same with the paths of a group's other vehicles in its frame, and what
// was confirmed and rejected between them; without that within each of the
// others. `group` is a resource name. Those of vehicles that the caller may not
// read, or that cannot be compared with this one, are left out.
absl::StatusOr<ServerMap> ReadGroupMap(const Client& client,
                                       const std::string& vehicle,
                                       const std::string& group,
                                       const Terminal& terminal);

struct CheckSearches {
  // Travelled distance between two; the vehicle's own if absent.
  std::optional<double> interval_meters;
  // At most; a server that wants fewer is obeyed.
  double per_second = 100.0;
  v1::CandidateOptions options;
};

// Asks for candidates along the whole path, where a stream's checks would have
// fallen due, and adds them with one style per verdict of the first candidate.
absl::Status AddChecks(const Client& client, const CheckSearches& searches,
                       const Terminal& terminal, ServerMap* map);

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_MAP_SERVER_MAP_H_
