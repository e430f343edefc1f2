// The settings of vehicles as flags and as text. A new setting is a row of
// kFlags in vehicle_settings.cc, which the commands follow, and a row of
// DescribeSettings().
#ifndef REVISIT_CLIENT_CLI_COMMANDS_VEHICLE_SETTINGS_H_
#define REVISIT_CLIENT_CLI_COMMANDS_VEHICLE_SETTINGS_H_

#include <string>
#include <utility>
#include <vector>

#include "client/cli/flags.h"
#include "revisit/v1/candidate.pb.h"
#include "revisit/v1/vehicle.pb.h"

namespace revisit::client {

// Flags for all settings of a vehicle. Those that are not given leave their
// field unset, so that the server's default counts.
void AddVehicleSettings(const Command& command, v1::VehicleSettings* settings);

// Flags for those settings that one search may replace.
void AddSearchSettings(const Command& command, v1::CandidateOptions* options);

// Flags for the settings of a vehicle of a drive file, whose frame is that of
// the file, but for those of what is kept. Here all settings that have a flag
// are set, so that what is measured does not depend on the server's defaults.
void AddDriveSettings(const Command& command, v1::VehicleSettings* settings);

// Sets what AddDriveSettings() sets where no flag is given.
void SetUsualSettings(v1::VehicleSettings* settings);

// The settings that are not what the help states as their defaults, as
// "flag=value" without dashes, such as "node-spacing=0.5".
std::vector<std::string> UnusualSettings(const v1::VehicleSettings& settings);

// Names and values for people.
std::vector<std::pair<std::string, std::string>> DescribeSettings(
    const v1::VehicleSettings& settings);

}  // namespace revisit::client

#endif  // REVISIT_CLIENT_CLI_COMMANDS_VEHICLE_SETTINGS_H_
