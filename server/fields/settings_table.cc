#include "server/fields/settings_table.h"

#include <cstdint>
#include <limits>
#include <string>
#include <vector>

#include "absl/strings/str_cat.h"
#include "google/protobuf/duration.pb.h"
#include "server/fields/enums.h"
#include "server/fields/geodetic_frame.h"

namespace revisit::server {
namespace {

using google::protobuf::FieldDescriptor;
using google::protobuf::Message;

constexpr std::int64_t kNanosecondsPerSecond = 1'000'000'000;
// Longer durations are more nanoseconds than a number holds.
constexpr std::int64_t kMostSeconds = 9'000'000'000;

// A number of a message within a setting's.
double Part(const Message& message, const char* name) {
  return message.GetReflection()->GetDouble(
      message, message.GetDescriptor()->FindFieldByName(name));
}

void SetPart(const char* name, double value, Message* message) {
  message->GetReflection()->SetDouble(
      message, message->GetDescriptor()->FindFieldByName(name), value);
}

// The field of the messages that holds a setting of core's.
std::string FieldOf(const std::string& setting) {
  const std::string shape = "shape.";
  return setting.compare(0, shape.size(), shape) == 0
             ? absl::StrCat("shape_", setting.substr(shape.size()))
             : setting;
}

}  // namespace

// ---- Reading

SettingsReader::SettingsReader(const Message& message, const FieldPath& path,
                               Violations* violations)
    : message_(message),
      reflection_(*message.GetReflection()),
      path_(path),
      violations_(violations) {}

const FieldDescriptor* SettingsReader::Find(const char* name) const {
  return message_.GetDescriptor()->FindFieldByName(name);
}

const FieldDescriptor* SettingsReader::FindGiven(const char* name) const {
  const FieldDescriptor* const field = Find(name);
  const bool given = field != nullptr && reflection_.HasField(message_, field);
  return given ? field : nullptr;
}

const std::string* SettingsReader::GivenValue(const char* name) const {
  static const auto& unknown = *new std::string();
  const FieldDescriptor* const field = Find(name);
  if (field == nullptr) return nullptr;
  const int number = reflection_.GetEnumValue(message_, field);
  if (number == 0) return nullptr;
  const auto* const value = field->enum_type()->FindValueByNumber(number);
  return value == nullptr ? &unknown : &value->name();
}

void SettingsReader::RefuseValue(const char* name) {
  AddUnknownValue(reflection_.GetEnumValue(message_, Find(name)),
                  path_.Field(name), violations_);
}

void SettingsReader::Number(const char* name, double* value) {
  const FieldDescriptor* const field = FindGiven(name);
  if (field == nullptr) return;
  const double given = reflection_.GetDouble(message_, field);
  if (CheckFinite(given, path_.Field(name), violations_)) *value = given;
}

void SettingsReader::Count(const char* name, int* value) {
  const FieldDescriptor* const field = FindGiven(name);
  if (field != nullptr) *value = reflection_.GetInt32(message_, field);
}

void SettingsReader::Switch(const char* name, bool* value) {
  const FieldDescriptor* const field = FindGiven(name);
  if (field != nullptr) *value = reflection_.GetBool(message_, field);
}

void SettingsReader::Text(const char* name, std::string* value) {
  const FieldDescriptor* const field = FindGiven(name);
  if (field != nullptr) *value = reflection_.GetString(message_, field);
}

void SettingsReader::Tolerance(const char* name, core::PlaceTolerance* value) {
  const FieldDescriptor* const field = FindGiven(name);
  if (field == nullptr) return;
  const Message& given = reflection_.GetMessage(message_, field);
  const FieldPath path = path_.Field(name);
  const auto take = [&](const char* part, double* number) {
    const double part_given = Part(given, part);
    if (CheckFinite(part_given, path.Field(part), violations_)) {
      *number = part_given;
    }
  };
  take("position_meters", &value->position_meters);
  take("heading_radians", &value->heading_radians);
}

void SettingsReader::Origin(const char* name, VehicleConfig* config) {
  const FieldDescriptor* const field = FindGiven(name);
  if (field == nullptr) return;
  const Message& given = reflection_.GetMessage(message_, field);
  const GeodeticOrigin origin{Part(given, "latitude_degrees"),
                              Part(given, "longitude_degrees"),
                              Part(given, "height_meters")};
  const FieldPath path = path_.Field(name);
  CheckGeodetic(origin, path, violations_);
  if (config->frame == CoordinateFrame::kGeodetic) {
    config->origin = origin;
  } else {
    violations_->Add(kInvalidField, path,
                     "allowed only where the coordinate frame is GEODETIC");
  }
}

// A retention that is given replaces both parts.
void SettingsReader::Retention(const char* name,
                               core::RetentionOptions* value) {
  const FieldDescriptor* const field = FindGiven(name);
  if (field == nullptr) return;
  const Message& given = reflection_.GetMessage(message_, field);
  *value = {};
  value->max_passes = given.GetReflection()->GetInt32(
      given, given.GetDescriptor()->FindFieldByName("max_passes"));
  const FieldDescriptor* const age =
      given.GetDescriptor()->FindFieldByName("max_age");
  if (!given.GetReflection()->HasField(given, age)) return;
  google::protobuf::Duration duration;
  duration.CopyFrom(given.GetReflection()->GetMessage(given, age));
  // Ages that are no numbers of nanoseconds are out of range, like those that
  // are too long.
  const bool is_sound = duration.nanos() > -kNanosecondsPerSecond &&
                        duration.nanos() < kNanosecondsPerSecond &&
                        duration.seconds() > -kMostSeconds &&
                        duration.seconds() < kMostSeconds;
  value->max_age_ns =
      is_sound ? duration.seconds() * kNanosecondsPerSecond + duration.nanos()
               : std::numeric_limits<std::int64_t>::max();
}

absl::StatusOr<VehicleConfig> ReadSettings(const Message& settings,
                                           const FieldPath& path) {
  Violations violations;
  VehicleConfig config;
  SettingsReader reader(settings, path, &violations);
  VisitSettings(&config, &reader);
  core::DriveSettings& drive = config.drive;
  const FieldDescriptor* const max_step =
      settings.GetDescriptor()->FindFieldByName("max_step_meters");
  if (!settings.GetReflection()->HasField(settings, max_step)) {
    drive.max_step_meters = core::DefaultMaxStep(drive.node_spacing_meters);
  }
  std::vector<core::SettingProblem> problems = core::FindProblems(drive);
  // Written so that NaN is one.
  if (!(config.keep_probability >= 0.0 && config.keep_probability <= 1.0)) {
    problems.push_back(
        {"keep_probability",
         absl::StrCat("got ", config.keep_probability, "; allowed is [0, 1]")});
  }
  AddProblems(problems, settings, path, &violations);
  if (violations.count() > 0) return violations.ToStatus();
  return config;
}

void AddProblems(const std::vector<core::SettingProblem>& problems,
                 const Message& settings, const FieldPath& path,
                 Violations* violations) {
  for (const core::SettingProblem& problem : problems) {
    const std::string field = FieldOf(problem.field);
    const FieldDescriptor* const given =
        settings.GetDescriptor()->FindFieldByName(
            field.substr(0, field.find('.')));
    const bool left_out = given != nullptr &&
                          !settings.GetReflection()->HasField(settings, given);
    violations->Add(kInvalidField, path.Field(field.c_str()),
                    absl::StrCat(problem.description,
                                 left_out ? " (left out: its default)" : ""));
  }
}

// ---- Writing

SettingsWriter::SettingsWriter(Message* message)
    : message_(message), reflection_(*message->GetReflection()) {}

const FieldDescriptor* SettingsWriter::Find(const char* name) const {
  return message_->GetDescriptor()->FindFieldByName(name);
}

void SettingsWriter::SetEnum(const char* name, const char* value) {
  const FieldDescriptor* const field = Find(name);
  if (field == nullptr) return;
  const auto* const named = field->enum_type()->FindValueByName(value);
  reflection_.SetEnum(message_, field, named);
}

void SettingsWriter::Number(const char* name, const double* value) {
  const FieldDescriptor* const field = Find(name);
  if (field != nullptr) reflection_.SetDouble(message_, field, *value);
}

void SettingsWriter::Count(const char* name, const int* value) {
  const FieldDescriptor* const field = Find(name);
  if (field != nullptr) reflection_.SetInt32(message_, field, *value);
}

void SettingsWriter::Switch(const char* name, const bool* value) {
  const FieldDescriptor* const field = Find(name);
  if (field != nullptr) reflection_.SetBool(message_, field, *value);
}

void SettingsWriter::Text(const char* name, const std::string* value) {
  const FieldDescriptor* const field = Find(name);
  if (field == nullptr) return;
  reflection_.ClearField(message_, field);
  if (!value->empty()) reflection_.SetString(message_, field, *value);
}

void SettingsWriter::Tolerance(const char* name,
                               const core::PlaceTolerance* value) {
  const FieldDescriptor* const field = Find(name);
  if (field == nullptr) return;
  Message* const tolerance = reflection_.MutableMessage(message_, field);
  SetPart("position_meters", value->position_meters, tolerance);
  SetPart("heading_radians", value->heading_radians, tolerance);
}

void SettingsWriter::Origin(const char* name, const VehicleConfig* config) {
  const FieldDescriptor* const field = Find(name);
  if (field == nullptr) return;
  reflection_.ClearField(message_, field);
  if (!config->origin) return;
  Message* const origin = reflection_.MutableMessage(message_, field);
  SetPart("latitude_degrees", config->origin->latitude_degrees, origin);
  SetPart("longitude_degrees", config->origin->longitude_degrees, origin);
  SetPart("height_meters", config->origin->height_meters, origin);
}

void SettingsWriter::Retention(const char* name,
                               const core::RetentionOptions* value) {
  const FieldDescriptor* const field = Find(name);
  if (field == nullptr) return;
  reflection_.ClearField(message_, field);
  // Absent where everything is kept.
  if (*value == core::RetentionOptions()) return;
  Message* const retention = reflection_.MutableMessage(message_, field);
  const google::protobuf::Descriptor& parts = *retention->GetDescriptor();
  retention->GetReflection()->SetInt32(
      retention, parts.FindFieldByName("max_passes"), value->max_passes);
  if (!value->max_age_ns) return;
  google::protobuf::Duration age;
  age.set_seconds(*value->max_age_ns / kNanosecondsPerSecond);
  age.set_nanos(
      static_cast<std::int32_t>(*value->max_age_ns % kNanosecondsPerSecond));
  retention->GetReflection()
      ->MutableMessage(retention, parts.FindFieldByName("max_age"))
      ->CopyFrom(age);
}

void WriteSettings(const VehicleConfig& config, Message* settings) {
  SettingsWriter writer(settings);
  VisitSettings(&config, &writer);
}

}  // namespace revisit::server
