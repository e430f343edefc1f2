// The display name and the labels of a vehicle.
#ifndef REVISIT_SERVER_CONVERSION_VEHICLE_LABELS_H_
#define REVISIT_SERVER_CONVERSION_VEHICLE_LABELS_H_

#include <cstddef>
#include <set>
#include <string>

#include "absl/status/status.h"
#include "google/protobuf/field_mask.pb.h"
#include "revisit/v1/vehicle.pb.h"
#include "server/fields/field_violations.h"
#include "server/sessions/vehicle_config.h"

namespace revisit::server {

inline constexpr std::size_t kMaxDisplayNameBytes = 256;
inline constexpr std::size_t kMaxLabels = 128;
inline constexpr std::size_t kMaxLabelKeyBytes = 63;
inline constexpr std::size_t kMaxLabelValueBytes = 128;

// Which of them an update names.
struct LabelsMask {
  bool display_name = false;
  bool all_labels = false;
  std::set<std::string> keys;

  // Whether the path is one of these; then it is taken up.
  bool Take(const std::string& path);
};

// Replaces what the mask names; what it names and the vehicle lacks is removed.
// INVALID_ARGUMENT, with all that is wrong, if the result is not allowed.
absl::Status UpdateLabels(const v1::Vehicle& vehicle, const LabelsMask& mask,
                          const FieldPath& path, VehicleConfig* config);

void EncodeLabels(const VehicleConfig& config, v1::Vehicle* vehicle);

// Leaves in an answer only what an update's mask names.
void TrimToMask(const google::protobuf::FieldMask& mask, v1::Vehicle* vehicle);

}  // namespace revisit::server

#endif  // REVISIT_SERVER_CONVERSION_VEHICLE_LABELS_H_
