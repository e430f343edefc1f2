// revisit vehicle create|get|list|update|accept-loss|delete
#ifndef REVISIT_CLIENT_CLI_COMMANDS_VEHICLE_COMMAND_H_
#define REVISIT_CLIENT_CLI_COMMANDS_VEHICLE_COMMAND_H_

#include <cstdint>
#include <string>
#include <vector>

#include "absl/status/status.h"
#include "client/cli/commands/deletion.h"
#include "client/cli/commands/vehicle_description.h"
#include "client/cli/flags.h"
#include "client/revisit/client.h"
#include "client/terminal/terminal.h"

namespace revisit::client {

// Adds `vehicle` with all its commands.
void AddVehicleCommand(const Command& program);

// Every command prints the vehicle that results.
absl::Status RunVehicleCreate(const Client& client, const std::string& id,
                              const v1::VehicleSettings& settings,
                              const VehicleDescription& description,
                              const Terminal& terminal);
absl::Status RunVehicleGet(const Client& client, const std::string& id,
                           const Terminal& terminal);
// Lists the vehicles of all pages. As JSON: {"vehicles": [...]}.
absl::Status RunVehicleList(const Client& client, const Terminal& terminal);
// Changes the settings that are set, and no others, and the description.
// REQUIRES: there is something to change.
absl::Status RunVehicleUpdate(const Client& client, const std::string& id,
                              const v1::VehicleSettings& changes,
                              const VehicleDescription& description,
                              const Terminal& terminal);
// Ends the state DATA_LOSS. The server refuses a `durable_sequence` that is not
// the vehicle's.
absl::Status RunVehicleAcceptLoss(const Client& client, const std::string& id,
                                  std::uint64_t durable_sequence,
                                  const Terminal& terminal);
// Deletes vehicles, as RunDeletion() does.
absl::Status RunVehicleDelete(const Client& client,
                              const std::vector<std::string>& ids,
                              const Ask& ask, const Terminal& terminal);

// Prints a vehicle and its settings for people.
void PrintVehicle(const v1::Vehicle& vehicle, const Terminal& terminal);

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_CLI_COMMANDS_VEHICLE_COMMAND_H_
