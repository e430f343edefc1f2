#include "server/conversion/vehicle_settings.h"

#include <set>
#include <string>
#include <vector>

#include "absl/strings/str_cat.h"
#include "server/base/status.h"
#include "server/conversion/names.h"
#include "server/conversion/vehicle_labels.h"
#include "server/fields/enums.h"
#include "server/fields/settings_table.h"

namespace revisit::server {
namespace {

using google::protobuf::FieldDescriptor;

constexpr EnumRow<v1::Direction, core::SearchDirection> kSearchDirections[] = {
    {v1::DIRECTION_SAME, core::SearchDirection::kSame},
    {v1::DIRECTION_OPPOSITE, core::SearchDirection::kOpposite},
    {v1::DIRECTION_EITHER, core::SearchDirection::kEither}};

// The fields of VehicleSettings that the mask names as paths below `vehicle`;
// all else that it names goes to `labels`.
absl::StatusOr<std::vector<const FieldDescriptor*>> MaskedSettings(
    const google::protobuf::FieldMask& mask, LabelsMask* labels) {
  const std::string prefix = "settings.";
  const auto* descriptor = v1::VehicleSettings::descriptor();
  const FieldPath path = FieldPath().Field("update_mask");
  std::set<const FieldDescriptor*> fields;
  Violations violations;
  if (mask.paths().empty()) {
    violations.Add(kInvalidField, path,
                   "required: name what changes, such as "
                   "\"settings.max_candidates\" or \"display_name\"");
  }
  for (int i = 0; i < mask.paths_size(); ++i) {
    const std::string& name = mask.paths(i);
    if (name == "settings") {
      for (int f = 0; f < descriptor->field_count(); ++f) {
        fields.insert(descriptor->field(f));
      }
      continue;
    }
    if (labels->Take(name)) continue;
    const auto* field =
        name.compare(0, prefix.size(), prefix) == 0
            ? descriptor->FindFieldByName(name.substr(prefix.size()))
            : nullptr;
    if (field == nullptr) {
      violations.Add(
          kInvalidField, path.At("paths", static_cast<std::size_t>(i)),
          absl::StrCat("got ", Quoted(name),
                       "; allowed are \"settings\" and \"settings.\" with the "
                       "name of a setting, which changes as a whole, "
                       "\"display_name\", \"labels\" and \"labels.\" with a "
                       "key"));
      continue;
    }
    fields.insert(field);
  }
  if (violations.count() > 0) return violations.ToStatus();
  return std::vector<const FieldDescriptor*>(fields.begin(), fields.end());
}

absl::Status SettingFixed(const char* setting,
                          const char* change = "cannot change") {
  const std::string field = absl::StrCat("settings.", setting);
  return Error(absl::StatusCode::kFailedPrecondition, "SETTING_FIXED",
               absl::StrCat(field, " ", change, ": the vehicle has poses"),
               {{"field", field}});
}

// Refuses changes that would give the stored poses another meaning.
absl::Status CheckFixedSettings(const VehicleConfig& current,
                                const VehicleConfig& updated) {
  const auto filter = [](const VehicleConfig& config) {
    return core::NoiseOf(config.drive.search.correlation_model)
        .carries_transitions;
  };
  if (updated.drive.state_space != current.drive.state_space) {
    return SettingFixed("state_space");
  }
  if (filter(updated) != filter(current)) {
    return SettingFixed("correlation_model",
                        filter(updated) ? "cannot become FILTER"
                                        : "cannot be other than FILTER");
  }
  if (updated.frame != current.frame) return SettingFixed("coordinate_frame");
  if (updated.origin != current.origin) return SettingFixed("geodetic_origin");
  return absl::OkStatus();
}

}  // namespace

absl::StatusOr<VehicleConfig> DecodeSettings(
    const v1::VehicleSettings& settings, const FieldPath& path) {
  absl::StatusOr<VehicleConfig> config = ReadSettings(settings, path);
  if (!config.ok() || config->check_group.empty()) return config;
  // The config has the id, as all of the server has.
  absl::StatusOr<std::string> group =
      ParseGroupName(config->check_group, path.Field("check_group"));
  if (!group.ok()) return group.status();
  config->check_group = *std::move(group);
  return config;
}

void EncodeSettings(const VehicleConfig& config,
                    v1::VehicleSettings* settings) {
  WriteSettings(config, settings);
  if (config.check_group.empty()) return;
  settings->set_check_group(GroupName(config.check_group));
}

absl::StatusOr<VehicleConfig> UpdateConfig(
    const VehicleConfig& current, bool has_poses, const v1::Vehicle& vehicle,
    const google::protobuf::FieldMask& update_mask) {
  LabelsMask labels;
  const auto fields = MaskedSettings(update_mask, &labels);
  if (!fields.ok()) return fields.status();
  v1::VehicleSettings merged;
  EncodeSettings(current, &merged);
  v1::VehicleSettings given = vehicle.settings();
  // A setting that is named but not given becomes unset, which decodes to its
  // default.
  v1::VehicleSettings::GetReflection()->SwapFields(&merged, &given, *fields);
  const FieldPath request;
  const FieldPath path = request.Field("vehicle");
  absl::StatusOr<VehicleConfig> updated =
      DecodeSettings(merged, path.Field("settings"));
  if (!updated.ok()) return updated.status();
  updated->create_time_ns = current.create_time_ns;
  updated->data_loss = current.data_loss;
  updated->damaged = current.damaged;
  updated->uid = current.uid;
  updated->display_name = current.display_name;
  updated->labels = current.labels;
  if (absl::Status status = UpdateLabels(vehicle, labels, path, &*updated);
      !status.ok()) {
    return status;
  }
  if (!has_poses) return updated;

  // By default the origin is that of the first pose, which is there already.
  if (!updated->origin) updated->origin = current.origin;
  if (absl::Status status = CheckFixedSettings(current, *updated);
      !status.ok()) {
    return status;
  }
  return updated;
}

bool SameSettings(const VehicleConfig& existing,
                  const VehicleConfig& requested) {
  v1::VehicleSettings a;
  v1::VehicleSettings b;
  EncodeSettings(existing, &a);
  EncodeSettings(requested, &b);
  if (!requested.origin) a.clear_geodetic_origin();
  return a.SerializeAsString() == b.SerializeAsString();
}

absl::StatusOr<core::SearchOptions> DecodeCandidateOptions(
    const v1::CandidateOptions& options, const VehicleConfig& config,
    const FieldPath& path) {
  Violations violations;
  VehicleConfig changed = config;
  // The reader looks fields up by name, which takes longer than all that
  // follows; most callers override nothing.
  if (options.ByteSizeLong() > 0) {
    SettingsReader reader(options, path, &violations);
    VisitSettings(&changed, &reader);
  }
  core::SearchOptions search = changed.drive.search;
  search.exhaustive = options.exhaustive();
  search.tell_paths = options.include_aligned_path();
  DecodeEnum(kSearchDirections, options.direction(), path.Field("direction"),
             &search.direction, &violations);
  AddProblems(core::FindProblems(search, config.drive), options, path,
              &violations);
  if (violations.count() > 0) return violations.ToStatus();
  return search;
}

}  // namespace revisit::server
