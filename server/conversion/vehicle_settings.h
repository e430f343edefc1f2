// The settings of vehicles and of single searches. The table of settings is in
// settings_table.h.
#ifndef REVISIT_SERVER_CONVERSION_VEHICLE_SETTINGS_H_
#define REVISIT_SERVER_CONVERSION_VEHICLE_SETTINGS_H_

#include "absl/status/statusor.h"
#include "core/settings.h"
#include "google/protobuf/field_mask.pb.h"
#include "revisit/v1/candidate.pb.h"
#include "revisit/v1/vehicle.pb.h"
#include "server/fields/field_violations.h"
#include "server/sessions/vehicle_config.h"

namespace revisit::server {

// Fields left out take their defaults. State, uid, creation time and labels are
// left alone.
absl::StatusOr<VehicleConfig> DecodeSettings(
    const v1::VehicleSettings& settings, const FieldPath& path);
void EncodeSettings(const VehicleConfig& config, v1::VehicleSettings* settings);

// The config with the settings, the display name and the labels replaced that
// the mask names. FAILED_PRECONDITION (SETTING_FIXED) for settings that cannot
// change once there are poses.
absl::StatusOr<VehicleConfig> UpdateConfig(
    const VehicleConfig& current, bool has_poses, const v1::Vehicle& vehicle,
    const google::protobuf::FieldMask& update_mask);

// Whether a vehicle was created, or could have been, with these settings: an
// origin that was left out is that of the first pose.
bool SameSettings(const VehicleConfig& existing,
                  const VehicleConfig& requested);

// The vehicle's own search with the changes that the options make.
absl::StatusOr<core::SearchOptions> DecodeCandidateOptions(
    const v1::CandidateOptions& options, const VehicleConfig& config,
    const FieldPath& path);

}  // namespace revisit::server

#endif  // REVISIT_SERVER_CONVERSION_VEHICLE_SETTINGS_H_
