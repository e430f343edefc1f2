#include "client/cli/commands/vehicle_description.h"

#include "absl/strings/str_cat.h"

namespace revisit::client {
namespace {

// The key of KEY=VALUE. Keys have no "=".
std::string KeyOf(const std::string& label) {
  return label.substr(0, label.find('='));
}

}  // namespace

void AddDescription(const Command& command, VehicleDescription* description) {
  command.AddText("--display-name", "TEXT", &description->display_name,
                  "Name for people, which need not be unique");
  command.AddRepeatedText("--label", "KEY=VALUE", &description->labels,
                          "Label for programs of your own; repeat it for more");
}

void AddRemovedLabels(const Command& command, VehicleDescription* description) {
  command.AddRepeatedText("--remove-label", "KEY", &description->removed_labels,
                          "Label to be removed; repeat it for more");
}

std::string CheckDescription(const VehicleDescription& description) {
  for (const std::string& label : description.labels) {
    if (label.find('=') != std::string::npos && label[0] != '=') continue;
    return absl::StrCat("--label: got \"", label,
                        "\"; expected KEY=VALUE, such as site=north");
  }
  return "";
}

bool IsEmpty(const VehicleDescription& description) {
  return !description.display_name.has_value() && description.labels.empty() &&
         description.removed_labels.empty();
}

void Describe(const VehicleDescription& description, v1::Vehicle* vehicle) {
  if (description.display_name.has_value()) {
    vehicle->set_display_name(*description.display_name);
  }
  for (const std::string& label : description.labels) {
    (*vehicle->mutable_labels())[KeyOf(label)] =
        label.substr(label.find('=') + 1);
  }
}

void Describe(const VehicleDescription& description,
              v1::UpdateVehicleRequest* request) {
  Describe(description, request->mutable_vehicle());
  google::protobuf::FieldMask* const mask = request->mutable_update_mask();
  if (description.display_name.has_value()) mask->add_paths("display_name");
  for (const std::string& label : description.labels) {
    mask->add_paths(absl::StrCat("labels.", KeyOf(label)));
  }
  for (const std::string& key : description.removed_labels) {
    mask->add_paths(absl::StrCat("labels.", key));
  }
}

}  // namespace revisit::client
