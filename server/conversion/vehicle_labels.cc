#include "server/conversion/vehicle_labels.h"

#include <algorithm>

#include "absl/strings/str_cat.h"
#include "google/protobuf/util/field_mask_util.h"

namespace revisit::server {
namespace {

constexpr char kOneLabel[] = "labels.";

bool IsLabelKey(const std::string& key) {
  const auto alphanumeric = [](char c) {
    return (c >= 'a' && c <= 'z') || (c >= '0' && c <= '9');
  };
  return !key.empty() && key.size() <= kMaxLabelKeyBytes &&
         alphanumeric(key.front()) && alphanumeric(key.back()) &&
         std::all_of(key.begin(), key.end(), [&](char c) {
           return alphanumeric(c) || c == '.' || c == '_' || c == '-' ||
                  c == '/';
         });
}

void CheckLabel(const std::string& key, const std::string& value,
                const FieldPath& labels, Violations* violations) {
  if (!IsLabelKey(key)) {
    violations->Add(kInvalidField, labels,
                    absl::StrCat("got the key ", Quoted(key.substr(0, 128)),
                                 "; a key is 1 to ", kMaxLabelKeyBytes,
                                 " lower-case letters, digits and any of "
                                 "._/- but for the first and the last"));
    return;
  }
  CheckText(value, kMaxLabelValueBytes, TextUse::kName,
            labels.Field(key.c_str()), violations);
}

}  // namespace

bool LabelsMask::Take(const std::string& path) {
  const std::string one = kOneLabel;
  if (path == "display_name") {
    display_name = true;
  } else if (path == "labels") {
    all_labels = true;
  } else if (path.size() > one.size() &&
             path.compare(0, one.size(), one) == 0) {
    keys.insert(path.substr(one.size()));
  } else {
    return false;
  }
  return true;
}

absl::Status UpdateLabels(const v1::Vehicle& vehicle, const LabelsMask& mask,
                          const FieldPath& path, VehicleConfig* config) {
  Violations violations;
  const FieldPath labels = path.Field("labels");
  if (mask.display_name) {
    CheckText(vehicle.display_name(), kMaxDisplayNameBytes, TextUse::kName,
              path.Field("display_name"), &violations);
    config->display_name = vehicle.display_name();
  }
  if (mask.all_labels) config->labels.clear();
  for (const std::string& key : mask.keys) {
    config->labels.erase(key);
    if (!IsLabelKey(key)) CheckLabel(key, "", labels, &violations);
  }
  for (const auto& [key, value] : vehicle.labels()) {
    if (!mask.all_labels && mask.keys.count(key) == 0) continue;
    CheckLabel(key, value, labels, &violations);
    config->labels[key] = value;
  }
  if (config->labels.size() > kMaxLabels) {
    violations.Add(kInvalidField, labels,
                   absl::StrCat("it would be ", config->labels.size(),
                                " labels; allowed are ", kMaxLabels));
  }
  return violations.ToStatus();
}

void EncodeLabels(const VehicleConfig& config, v1::Vehicle* vehicle) {
  vehicle->set_display_name(config.display_name);
  vehicle->mutable_labels()->insert(config.labels.begin(), config.labels.end());
}

void TrimToMask(const google::protobuf::FieldMask& mask, v1::Vehicle* vehicle) {
  LabelsMask named;
  google::protobuf::FieldMask fields;
  for (const std::string& path : mask.paths()) {
    // Single labels are no fields.
    if (!named.Take(path)) fields.add_paths(path);
  }
  if (named.display_name) fields.add_paths("display_name");
  if (named.all_labels || !named.keys.empty()) fields.add_paths("labels");
  google::protobuf::util::FieldMaskUtil::TrimMessage(fields, vehicle);
  if (named.all_labels) return;
  auto* const labels = vehicle->mutable_labels();
  for (auto label = labels->begin(); label != labels->end();) {
    label = named.keys.count(label->first) > 0 ? ++label : labels->erase(label);
  }
}

}  // namespace revisit::server
