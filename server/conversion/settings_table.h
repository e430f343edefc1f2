// The table of a vehicle's settings, and how it is read from and written to
// messages by the names of their fields.
//
// To add a setting: a line in VisitSettings() that names its field, which is
// the same in all messages; how the rest is done: docs/how-it-works.md.
#ifndef REVISIT_SERVER_CONVERSION_SETTINGS_TABLE_H_
#define REVISIT_SERVER_CONVERSION_SETTINGS_TABLE_H_

#include <cstddef>

#include "absl/status/statusor.h"
#include "core/settings.h"
#include "google/protobuf/message.h"
#include "revisit/v1/vehicle.pb.h"
#include "server/conversion/enums.h"
#include "server/conversion/field_violations.h"
#include "server/sessions/vehicle_config.h"

namespace revisit::server {

// The enums of the stored settings have the same numbers.
inline constexpr EnumRow<v1::StateSpace, core::StateSpace> kStateSpaces[] = {
    {v1::STATE_SPACE_PLANAR, core::StateSpace::kPlanar},
    {v1::STATE_SPACE_SPATIAL, core::StateSpace::kSpatial}};
inline constexpr EnumRow<v1::CorrelationModel, core::CorrelationModel>
    kCorrelationModels[] = {
        {v1::CORRELATION_MODEL_DEAD_RECKONING,
         core::CorrelationModel::kDeadReckoning},
        {v1::CORRELATION_MODEL_INDEPENDENT,
         core::CorrelationModel::kIndependent},
        {v1::CORRELATION_MODEL_FILTER, core::CorrelationModel::kFilter},
        {v1::CORRELATION_MODEL_CORRELATED_FIXES,
         core::CorrelationModel::kCorrelatedFixes}};
inline constexpr EnumRow<v1::LikelihoodForm, core::LikelihoodForm>
    kLikelihoodForms[] = {
        {v1::LIKELIHOOD_FORM_GAUSSIAN, core::LikelihoodForm::kGaussian},
        {v1::LIKELIHOOD_FORM_AS_PRINTED, core::LikelihoodForm::kAsPrinted}};
inline constexpr EnumRow<v1::Alignment, core::AlignmentKind> kAlignments[] = {
    {v1::ALIGNMENT_RELATIVE, core::AlignmentKind::kRelative},
    {v1::ALIGNMENT_COMPOSITE, core::AlignmentKind::kComposite}};
inline constexpr EnumRow<v1::CoordinateFrame, CoordinateFrame>
    kCoordinateFrames[] = {
        {v1::COORDINATE_FRAME_LOCAL, CoordinateFrame::kLocal},
        {v1::COORDINATE_FRAME_GEODETIC, CoordinateFrame::kGeodetic}};

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

  template <typename Proto, typename Own, std::size_t N>
  void Enum(const char* name, const EnumRow<Proto, Own> (&rows)[N],
            Own* value) {
    const auto* field = Find(name);
    if (field == nullptr) return;
    DecodeEnum(rows, reflection_.GetEnumValue(message_, field),
               path_.Field(name), value, violations_);
  }
  void Number(const char* name, double* value);
  void Count(const char* name, int* value);
  void Switch(const char* name, bool* value);
  // A tolerance that is given replaces both numbers.
  void Tolerance(const char* name, core::PlaceTolerance* value);
  void Origin(const char* name, VehicleConfig* config);
  void Retention(const char* name, core::RetentionOptions* value);

 private:
  // Null if the message has no such field.
  const google::protobuf::FieldDescriptor* Find(const char* name) const;
  // Null also if the field is absent.
  const google::protobuf::FieldDescriptor* FindGiven(const char* name) const;

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

  template <typename Proto, typename Own, std::size_t N>
  void Enum(const char* name, const EnumRow<Proto, Own> (&rows)[N],
            const Own* value) {
    SetEnum(name, ToProto(rows, *value));
  }
  void Number(const char* name, const double* value);
  void Count(const char* name, const int* value);
  void Switch(const char* name, const bool* value);
  void Tolerance(const char* name, const core::PlaceTolerance* value);
  void Origin(const char* name, const VehicleConfig* config);
  void Retention(const char* name, const core::RetentionOptions* value);

 private:
  const google::protobuf::FieldDescriptor* Find(const char* name) const;
  void SetEnum(const char* name, int number);

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

#endif  // REVISIT_SERVER_CONVERSION_SETTINGS_TABLE_H_
