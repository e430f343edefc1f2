// The table of a vehicle's settings, and how it is read from and written to
// messages, the API's and the store's, by the names of their fields.
//
// To add a setting: a line in VisitSettings() that names its field, which is
// the same in all messages; how the rest is done: docs/how-it-works.md.
#ifndef REVISIT_SERVER_FIELDS_SETTINGS_TABLE_H_
#define REVISIT_SERVER_FIELDS_SETTINGS_TABLE_H_

#include <cstddef>
#include <string>
#include <vector>

#include "absl/status/statusor.h"
#include "core/settings.h"
#include "google/protobuf/message.h"
#include "server/fields/field_violations.h"
#include "server/sessions/vehicle_config.h"

namespace revisit::server {

// One value of an enum: its name, which is the same in all messages.
template <typename Own>
struct NamedValue {
  const char* name;
  Own own;
};
inline constexpr NamedValue<core::StateSpace> kStateSpaces[] = {
    {"STATE_SPACE_PLANAR", core::StateSpace::kPlanar},
    {"STATE_SPACE_SPATIAL", core::StateSpace::kSpatial}};
inline constexpr NamedValue<core::CorrelationModel> kCorrelationModels[] = {
    {"CORRELATION_MODEL_DEAD_RECKONING",
     core::CorrelationModel::kDeadReckoning},
    {"CORRELATION_MODEL_INDEPENDENT", core::CorrelationModel::kIndependent},
    {"CORRELATION_MODEL_FILTER", core::CorrelationModel::kFilter},
    {"CORRELATION_MODEL_CORRELATED_FIXES",
     core::CorrelationModel::kCorrelatedFixes}};
inline constexpr NamedValue<core::LikelihoodForm> kLikelihoodForms[] = {
    {"LIKELIHOOD_FORM_GAUSSIAN", core::LikelihoodForm::kGaussian},
    {"LIKELIHOOD_FORM_AS_PRINTED", core::LikelihoodForm::kAsPrinted}};
inline constexpr NamedValue<core::AlignmentKind> kAlignments[] = {
    {"ALIGNMENT_RELATIVE", core::AlignmentKind::kRelative},
    {"ALIGNMENT_COMPOSITE", core::AlignmentKind::kComposite}};
inline constexpr NamedValue<ChecksKept> kChecksKept[] = {
    {"STORED_CHECKS_ON_REQUEST", ChecksKept::kOnRequest},
    {"STORED_CHECKS_STORED", ChecksKept::kStored}};
inline constexpr NamedValue<CoordinateFrame> kCoordinateFrames[] = {
    {"COORDINATE_FRAME_LOCAL", CoordinateFrame::kLocal},
    {"COORDINATE_FRAME_GEODETIC", CoordinateFrame::kGeodetic}};

// Calls the visitor with each setting: the name of its field, and a pointer to
// its value in the config, which may be const. Violations are reported in this
// order.
template <typename Config, typename Visitor>
void VisitSettings(Config* config, Visitor* visitor) {
  auto* drive = &config->drive;
  visitor->Enum("state_space", kStateSpaces, &drive->state_space);
  visitor->Enum("coordinate_frame", kCoordinateFrames, &config->frame);
  // Behind the frame, which decides whether there may be one.
  visitor->Origin("geodetic_origin", config);
  visitor->Number("node_spacing_meters", &drive->node_spacing_meters);
  visitor->Number("check_interval_meters", &drive->check_interval_meters);
  visitor->Number("max_step_meters", &drive->max_step_meters);
  visitor->Switch("apply_inflation", &drive->apply_inflation);
  visitor->Number("max_inflation", &drive->max_inflation);
  visitor->Retention("retention", &drive->retention);
  visitor->Enum("checks", kChecksKept, &config->checks);
  visitor->Number("keep_probability", &config->keep_probability);
  visitor->Text("check_group", &config->check_group);

  auto* search = &drive->search;
  visitor->Enum("correlation_model", kCorrelationModels,
                &search->correlation_model);
  visitor->Number("fix_correlation_meters", &search->fix_correlation_meters);
  visitor->Enum("likelihood_form", kLikelihoodForms, &search->likelihood_form);
  visitor->Number("sequence_length_meters", &search->sequence_length_meters);
  visitor->Number("gate_probability", &search->gate_probability);
  visitor->Tolerance("place_tolerance", &search->place_tolerance);
  visitor->Number("candidate_separation_meters",
                  &search->candidate_separation_meters);
  visitor->Count("max_candidates", &search->max_candidates);
  visitor->Enum("alignment", kAlignments, &search->alignment);
  visitor->Number("acceptance_probability", &search->acceptance_probability);
  visitor->Switch("use_belief", &search->use_belief);
  visitor->Number("road_spacing_meters", &search->road_spacing_meters);
  visitor->Tolerance("shape_tolerance", &search->shape.tolerance);
  visitor->Number("shape_correlation_meters",
                  &search->shape.correlation_meters);
}

// Replaces the settings that a message gives. Settings for which the message
// has no field stay as they are: CandidateOptions lacks those that a search
// cannot override.
class SettingsReader {
 public:
  // The arguments must outlive this.
  SettingsReader(const google::protobuf::Message& message,
                 const FieldPath& path, Violations* violations);

  template <typename Own, std::size_t N>
  void Enum(const char* name, const NamedValue<Own> (&values)[N], Own* value) {
    const std::string* const given = GivenValue(name);
    if (given == nullptr) return;
    for (const NamedValue<Own>& known : values) {
      if (*given == known.name) {
        *value = known.own;
        return;
      }
    }
    RefuseValue(name);
  }
  void Number(const char* name, double* value);
  void Count(const char* name, int* value);
  void Switch(const char* name, bool* value);
  void Text(const char* name, std::string* value);
  // A tolerance that is given replaces both numbers.
  void Tolerance(const char* name, core::PlaceTolerance* value);
  void Origin(const char* name, VehicleConfig* config);
  void Retention(const char* name, core::RetentionOptions* value);

 private:
  // Null if the message has no such field.
  const google::protobuf::FieldDescriptor* Find(const char* name) const;
  // Null also if the field is absent.
  const google::protobuf::FieldDescriptor* FindGiven(const char* name) const;
  // The name of an enum's value, empty if it has none; null if the field is
  // unspecified.
  const std::string* GivenValue(const char* name) const;
  void RefuseValue(const char* name);

  const google::protobuf::Message& message_;
  const google::protobuf::Reflection& reflection_;
  const FieldPath& path_;
  Violations* const violations_;
};

// Sets every setting that the message has a field for.
class SettingsWriter {
 public:
  // The message must outlive this.
  explicit SettingsWriter(google::protobuf::Message* message);

  template <typename Own, std::size_t N>
  void Enum(const char* name, const NamedValue<Own> (&values)[N],
            const Own* value) {
    for (const NamedValue<Own>& known : values) {
      if (known.own == *value) SetEnum(name, known.name);
    }
  }
  void Number(const char* name, const double* value);
  void Count(const char* name, const int* value);
  void Switch(const char* name, const bool* value);
  // Absent where it is empty.
  void Text(const char* name, const std::string* value);
  void Tolerance(const char* name, const core::PlaceTolerance* value);
  void Origin(const char* name, const VehicleConfig* config);
  void Retention(const char* name, const core::RetentionOptions* value);

 private:
  const google::protobuf::FieldDescriptor* Find(const char* name) const;
  void SetEnum(const char* name, const char* value);

  google::protobuf::Message* const message_;
  const google::protobuf::Reflection& reflection_;
};

// The settings of any message that the table fits; fields left out take their
// defaults.
absl::StatusOr<VehicleConfig> ReadSettings(
    const google::protobuf::Message& settings, const FieldPath& path);
void WriteSettings(const VehicleConfig& config,
                   google::protobuf::Message* settings);

// Adds the problems that core found in settings that were read from this
// message. The range of a setting may depend on others, so that a default that
// nobody gave can be out of range.
void AddProblems(const std::vector<core::SettingProblem>& problems,
                 const google::protobuf::Message& settings,
                 const FieldPath& path, Violations* violations);

}  // namespace revisit::server

#endif  // REVISIT_SERVER_FIELDS_SETTINGS_TABLE_H_
