// The display name and the labels of a vehicle, as flags of `vehicle create`
// and `vehicle update`.
#ifndef REVISIT_CLIENT_CLI_COMMANDS_VEHICLE_DESCRIPTION_H_
#define REVISIT_CLIENT_CLI_COMMANDS_VEHICLE_DESCRIPTION_H_

#include <optional>
#include <string>
#include <vector>

#include "client/cli/flags.h"
#include "revisit/v1/pose_graph_service.pb.h"
#include "revisit/v1/vehicle.pb.h"

namespace revisit::client {

struct VehicleDescription {
  // Empty to remove the name.
  std::optional<std::string> display_name;
  // Each is KEY=VALUE.
  std::vector<std::string> labels;
  // Keys of labels to be removed.
  std::vector<std::string> removed_labels;
};

// Adds the flags that a new vehicle takes, and those of an existing one.
void AddDescription(const Command& command, VehicleDescription* description);
void AddRemovedLabels(const Command& command, VehicleDescription* description);

// Says what is wrong with the words of the flags; empty if nothing is.
std::string CheckDescription(const VehicleDescription& description);

bool IsEmpty(const VehicleDescription& description);

// Writes name and labels into the vehicle. REQUIRES: CheckDescription().
void Describe(const VehicleDescription& description, v1::Vehicle* vehicle);

// Adds the change to a request. REQUIRES: CheckDescription().
void Describe(const VehicleDescription& description,
              v1::UpdateVehicleRequest* request);

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_CLI_COMMANDS_VEHICLE_DESCRIPTION_H_
