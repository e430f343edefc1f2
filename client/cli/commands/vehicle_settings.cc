#include "client/cli/commands/vehicle_settings.h"

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstdlib>
#include <map>
#include <optional>

#include "absl/strings/str_cat.h"
#include "client/answers/exact_text.h"
#include "client/answers/names.h"
#include "client/terminal/terminal.h"
#include "google/protobuf/descriptor.h"
#include "google/protobuf/duration.pb.h"
#include "google/protobuf/message.h"
#include "google/protobuf/util/time_util.h"

namespace revisit::client {
namespace {

using google::protobuf::Descriptor;
using google::protobuf::EnumDescriptor;
using google::protobuf::FieldDescriptor;
using google::protobuf::Message;

// A setting as a flag. What the flag takes follows from the type of the field.
struct SettingFlag {
  const char* flag;
  // The field of VehicleSettings, and of CandidateOptions if it has one of this
  // name: then a search may replace the setting. A dot leads into a message.
  const char* field;
  // Stands for the number or name in the help; empty if the field holds none.
  const char* unit;
  const char* help;
  // The default that the help states and that evaluations set. Where a request
  // leaves the field unset, the server's default counts, whatever stands here.
  const char* usual;
  // The range of a whole number; only the server checks all other values.
  WholeRange range = {};
};

// In the order of the help.
constexpr SettingFlag kFlags[] = {
    {"--alignment", "alignment", "",
     "Shared drift counted once, or the paper's sum over all pairs of nodes",
     "relative"},
    {"--acceptance-probability", "acceptance_probability", "P",
     "Relative: least probability of an accepted candidate", "0.45"},
    {"--road-spacing", "road_spacing_meters", "M",
     "Relative: mean distance between roads not driven", "200"},
    {"--shape-tolerance-position", "shape_tolerance.position_meters", "M",
     "Relative: how far two passes of a road stray within a sequence", "1"},
    {"--shape-tolerance-heading", "shape_tolerance.heading_radians", "RAD",
     "Relative: how far the headings of two passes stray within a sequence",
     "0.06"},
    {"--shape-correlation", "shape_correlation_meters", "M",
     "Relative: distance over which two passes stray alike", "20"},
    {"--use-belief,!--no-use-belief", "use_belief", "",
     "Begin searches with what the drive has shown of its claims and its drift",
     "true"},
    {"--correlation-model", "correlation_model", "",
     "How the errors of two poses are correlated", "dead-reckoning"},
    {"--fix-correlation", "fix_correlation_meters", "M",
     "Correlated fixes: distance over which their errors decorrelate", "300"},
    {"--likelihood", "likelihood_form", "", "Form of the log-similarity",
     "gaussian"},
    {"--sequence-length", "sequence_length_meters", "M",
     "Travelled distance that is aligned with the history", "150"},
    {"--gate-probability", "gate_probability", "P",
     "Probability with which a true revisit passes the gate", "0.95"},
    {"--tolerance-position", "place_tolerance.position_meters", "M",
     "Standard deviation between the positions of two passes of one place",
     "2"},
    {"--tolerance-heading", "place_tolerance.heading_radians", "RAD",
     "Standard deviation between the headings of two passes of one place",
     "0.1"},
    {"--candidate-separation", "candidate_separation_meters", "M",
     "Least distance along the path between candidates", "10"},
    {"--max-candidates",
     "max_candidates",
     "N",
     "Most candidates of one answer",
     "5",
     {1, 100}},
    {"--node-spacing", "node_spacing_meters", "M",
     "Travelled distance between nodes", "2"},
    {"--check-interval", "check_interval_meters", "M",
     "Travelled distance between checks", "50"},
    {"--checks", "checks", "",
     "Whether checks are made where somebody asks, or all of them, and stored",
     "on-request"},
    {"--keep-probability", "keep_probability", "P",
     "Stored checks: least probability of a candidate that is kept", "0.05"},
    {"--check-group", "check_group", "GROUP",
     "Stored checks: look in the histories of this group's vehicles too; empty "
     "for no group",
     "none"},
    {"--max-step", "max_step_meters", "M",
     "Longest step between two poses; a longer one is a jump", "100"},
    {"--apply-inflation,!--no-apply-inflation", "apply_inflation", "",
     "Without a belief: widen the claimed uncertainty as confirmed loop "
     "closures ask for",
     "false"},
    {"--max-inflation", "max_inflation", "FACTOR",
     "Most by which the claimed uncertainty is widened", "10"},
    {"--max-passes",
     "retention.max_passes",
     "N",
     "Passes of each place that are kept, 0 for all; without --max-age beside "
     "it, poses of any age are",
     "0",
     {0, 20}},
    {"--max-age", "retention.max_age", "S",
     "Age against the newest pose beyond which poses are dropped; without "
     "--max-passes beside it, all passes are kept",
     "any"},
    {"--state-space", "state_space", "", "Coordinates that take part",
     "planar"},
    {"--frame", "coordinate_frame", "", "Kind of positions that are streamed",
     "local"},
};

// A field of the settings, or of a message in them.
struct SettingField {
  // Null where the field belongs to the settings themselves.
  const FieldDescriptor* outer = nullptr;
  const FieldDescriptor* field = nullptr;

  FieldDescriptor::CppType type() const { return field->cpp_type(); }

  // The message that the field belongs to.
  Message* HolderIn(Message* settings) const {
    return outer == nullptr
               ? settings
               : settings->GetReflection()->MutableMessage(settings, outer);
  }
};

// Nothing if there is no such field.
std::optional<SettingField> FindField(const Descriptor* settings,
                                      const std::string& path) {
  const std::size_t dot = path.find('.');
  SettingField found;
  if (dot == std::string::npos) {
    found.field = settings->FindFieldByName(path);
  } else {
    found.outer = settings->FindFieldByName(path.substr(0, dot));
    if (found.outer == nullptr) return std::nullopt;
    found.field =
        found.outer->message_type()->FindFieldByName(path.substr(dot + 1));
  }
  if (found.field == nullptr) return std::nullopt;
  return found;
}

// A row of the table, bound to the field of one message.
struct BoundSetting {
  const SettingFlag* row;
  SettingField field;
  // The words of an enum, such as "dead-reckoning" for DEAD_RECKONING; empty
  // for other types.
  Words words;
  Message* settings;

  void SetNumber(double value) const {
    Message* holder = field.HolderIn(settings);
    holder->GetReflection()->SetDouble(holder, field.field, value);
  }
  void SetWholeNumber(std::int64_t value) const {
    Message* holder = field.HolderIn(settings);
    holder->GetReflection()->SetInt32(holder, field.field,
                                      static_cast<std::int32_t>(value));
  }
  // Sets a duration. The server refuses what is out of range.
  void SetSeconds(double value) const {
    using google::protobuf::util::TimeUtil;
    constexpr double kMost = 1e11;
    const double seconds = std::clamp(value, -kMost, kMost);
    Message* holder = field.HolderIn(settings);
    holder->GetReflection()
        ->MutableMessage(holder, field.field)
        ->CopyFrom(TimeUtil::MillisecondsToDuration(
            static_cast<std::int64_t>(std::llround(1000.0 * seconds))));
  }
  void SetBool(bool value) const {
    Message* holder = field.HolderIn(settings);
    holder->GetReflection()->SetBool(holder, field.field, value);
  }
  void SetGroup(const std::string& id) const {
    Message* holder = field.HolderIn(settings);
    holder->GetReflection()->SetString(
        holder, field.field, id.empty() ? std::string() : GroupName(id));
  }
  void SetEnum(int value) const {
    Message* holder = field.HolderIn(settings);
    holder->GetReflection()->SetEnumValue(holder, field.field, value);
  }
};

// All rows whose field the message has.
std::vector<BoundSetting> Bind(Message* settings) {
  std::vector<BoundSetting> bound;
  for (const SettingFlag& row : kFlags) {
    const auto field = FindField(settings->GetDescriptor(), row.field);
    if (!field.has_value()) continue;
    Words words;
    if (field->type() == FieldDescriptor::CPPTYPE_ENUM) {
      words = WordsOf(field->field->enum_type());
    }
    bound.push_back({&row, *field, std::move(words), settings});
  }
  return bound;
}

Flag AddSettingFlag(const Command& command, const BoundSetting& setting) {
  const SettingFlag& row = *setting.row;
  const std::string help = absl::StrCat(row.help, " (", row.usual, ")");
  switch (setting.field.type()) {
    case FieldDescriptor::CPPTYPE_ENUM:
      return command.AddChoice(
          row.flag, setting.words,
          [setting](int value) { setting.SetEnum(value); }, help);
    case FieldDescriptor::CPPTYPE_BOOL:
      return command.AddSwitch(
          row.flag, [setting](bool value) { setting.SetBool(value); },
          row.help);
    case FieldDescriptor::CPPTYPE_INT32:
      return command.AddWholeNumber(
          row.flag, row.range,
          [setting](std::int64_t value) { setting.SetWholeNumber(value); },
          help);
    case FieldDescriptor::CPPTYPE_STRING:
      return command.AddText(
          row.flag, row.unit,
          [setting](const std::string& id) {
            setting.SetGroup(id);
            return std::string();
          },
          help);
    case FieldDescriptor::CPPTYPE_MESSAGE:
      return command.AddNumber(
          row.flag, row.unit,
          [setting](double value) { setting.SetSeconds(value); }, help);
    default:
      return command.AddNumber(
          row.flag, row.unit,
          [setting](double value) { setting.SetNumber(value); }, help);
  }
}

bool IsRetention(const BoundSetting& setting) {
  return std::string(setting.row->field).rfind("retention.", 0) == 0;
}

// Drives that are judged keep all poses that there ever were, and are asked
// check by check.
bool IsOfDrives(const BoundSetting& setting) {
  const std::string field = setting.row->field;
  return !IsRetention(setting) && field != "checks" &&
         field != "keep_probability" && field != "check_group";
}

// Whether the message says anything of it, unlike that of an older server.
bool IsTold(const BoundSetting& setting) {
  const FieldDescriptor* const outer = setting.field.outer;
  if (outer != nullptr &&
      !setting.settings->GetReflection()->HasField(*setting.settings, outer)) {
    return false;
  }
  const FieldDescriptor* const field = setting.field.field;
  const Message& holder = *setting.field.HolderIn(setting.settings);
  const google::protobuf::Reflection& fields = *holder.GetReflection();
  if (setting.field.type() == FieldDescriptor::CPPTYPE_ENUM) {
    return fields.GetEnumValue(holder, field) != 0;
  }
  return setting.field.type() == FieldDescriptor::CPPTYPE_MESSAGE ||
         !field->has_presence() || fields.HasField(holder, field);
}

void SetUsual(const BoundSetting& setting) {
  const char* const usual = setting.row->usual;
  switch (setting.field.type()) {
    case FieldDescriptor::CPPTYPE_ENUM:
      return setting.SetEnum(setting.words.at(usual));
    case FieldDescriptor::CPPTYPE_BOOL:
      return setting.SetBool(std::string(usual) == "true");
    case FieldDescriptor::CPPTYPE_INT32:
      return setting.SetWholeNumber(std::strtol(usual, nullptr, 10));
    case FieldDescriptor::CPPTYPE_STRING:
      return setting.SetGroup("");
    default:
      return setting.SetNumber(std::strtod(usual, nullptr));
  }
}

// Flags of a request. The service takes a tolerance whole: where a request gave
// one part of it, the other would be 0, so each part needs the other.
void AddRequestSettings(const Command& command, Message* settings) {
  std::map<const FieldDescriptor*, Flag> first_parts;
  for (const BoundSetting& setting : Bind(settings)) {
    const Flag flag = AddSettingFlag(command, setting);
    if (setting.field.outer == nullptr ||
        setting.field.type() != FieldDescriptor::CPPTYPE_DOUBLE) {
      continue;
    }
    const auto [first, is_first] =
        first_parts.emplace(setting.field.outer, flag);
    if (is_first) continue;
    flag.Needs(first->second);
    first->second.Needs(flag);
  }
}

Command UnderVehicleSettings(const Command& command) {
  return command.Under("Settings of the vehicle (and their defaults)");
}

// The value that the message has, as the flag takes it.
std::string ValueText(const BoundSetting& setting) {
  const Message& holder = *setting.field.HolderIn(setting.settings);
  const google::protobuf::Reflection& fields = *holder.GetReflection();
  const FieldDescriptor* const field = setting.field.field;
  switch (setting.field.type()) {
    case FieldDescriptor::CPPTYPE_ENUM: {
      const int value = fields.GetEnumValue(holder, field);
      for (const auto& [word, known] : setting.words) {
        if (known == value) return word;
      }
      return absl::StrCat(value);
    }
    case FieldDescriptor::CPPTYPE_BOOL:
      return fields.GetBool(holder, field) ? "true" : "false";
    case FieldDescriptor::CPPTYPE_INT32:
      return absl::StrCat(fields.GetInt32(holder, field));
    case FieldDescriptor::CPPTYPE_STRING: {
      const std::string group = fields.GetString(holder, field);
      return group.empty() ? setting.row->usual : IdOf(group);
    }
    case FieldDescriptor::CPPTYPE_MESSAGE:
      return fields.HasField(holder, field)
                 ? google::protobuf::util::TimeUtil::ToString(
                       static_cast<const google::protobuf::Duration&>(
                           fields.GetMessage(holder, field)))
                 : setting.row->usual;
    default:
      return Exact(fields.GetDouble(holder, field));
  }
}

std::string Meters(double value) { return absl::StrCat(Fixed(value, 2), " m"); }

std::string Text(const v1::Retention& retention) {
  std::string text =
      retention.max_passes() == 0
          ? "all passes"
          : absl::StrCat(retention.max_passes(), " passes of each place");
  if (retention.has_max_age()) {
    const auto seconds = google::protobuf::util::TimeUtil::DurationToSeconds(
        retention.max_age());
    absl::StrAppend(&text, ", at most ", seconds, " s old");
  }
  return text;
}

std::string Text(const v1::PlaceTolerance& tolerance) {
  return absl::StrCat(Meters(tolerance.position_meters()), ", ",
                      Fixed(tolerance.heading_radians(), 4), " rad");
}

}  // namespace

void AddVehicleSettings(const Command& command, v1::VehicleSettings* settings) {
  AddRequestSettings(UnderVehicleSettings(command), settings);
}

void AddSearchSettings(const Command& command, v1::CandidateOptions* options) {
  AddRequestSettings(command.Under("Instead of the vehicle's settings"),
                     options);
}

void AddDriveSettings(const Command& command, v1::VehicleSettings* settings) {
  SetUsualSettings(settings);
  const Command group = UnderVehicleSettings(command);
  for (const BoundSetting& setting : Bind(settings)) {
    if (!IsOfDrives(setting)) continue;
    if (setting.row->field == std::string("coordinate_frame")) continue;
    AddSettingFlag(group, setting);
  }
}

void SetUsualSettings(v1::VehicleSettings* settings) {
  for (const BoundSetting& setting : Bind(settings)) {
    if (IsOfDrives(setting)) SetUsual(setting);
  }
}

std::vector<std::string> UnusualSettings(const v1::VehicleSettings& settings) {
  v1::VehicleSettings actual = settings;
  v1::VehicleSettings usual;
  const std::vector<BoundSetting> usual_ones = Bind(&usual);
  for (const BoundSetting& setting : usual_ones) {
    if (!IsRetention(setting)) SetUsual(setting);
  }
  const std::vector<BoundSetting> actual_ones = Bind(&actual);
  std::vector<std::string> unusual;
  for (std::size_t i = 0; i < actual_ones.size(); ++i) {
    if (!IsTold(actual_ones[i])) continue;
    const std::string value = ValueText(actual_ones[i]);
    if (value == ValueText(usual_ones[i])) continue;
    // "--use-belief,!--no-use-belief" and "--frame" are the names of flags.
    const std::string flag = actual_ones[i].row->flag;
    unusual.push_back(
        absl::StrCat(flag.substr(2, flag.find(',') - 2), "=", value));
  }
  return unusual;
}

std::vector<std::pair<std::string, std::string>> DescribeSettings(
    const v1::VehicleSettings& settings) {
  return {
      {"state space", NameOf(settings.state_space())},
      {"correlation model", NameOf(settings.correlation_model())},
      {"fix correlation", Meters(settings.fix_correlation_meters())},
      {"alignment", NameOf(settings.alignment())},
      {"likelihood form", NameOf(settings.likelihood_form())},
      {"coordinate frame", NameOf(settings.coordinate_frame())},
      {"node spacing", Meters(settings.node_spacing_meters())},
      {"sequence length", Meters(settings.sequence_length_meters())},
      {"check interval", Meters(settings.check_interval_meters())},
      {"checks", NameOf(settings.checks())},
      {"keep probability", Fixed(settings.keep_probability(), 4)},
      {"check group",
       settings.check_group().empty() ? "none" : IdOf(settings.check_group())},
      {"maximal step", Meters(settings.max_step_meters())},
      {"gate probability", Fixed(settings.gate_probability(), 4)},
      {"acceptance probability", Fixed(settings.acceptance_probability(), 4)},
      {"place tolerance", Text(settings.place_tolerance())},
      {"shape tolerance", Text(settings.shape_tolerance())},
      {"shape correlation", Meters(settings.shape_correlation_meters())},
      {"road spacing", Meters(settings.road_spacing_meters())},
      {"belief", settings.use_belief() ? "used" : "not used"},
      {"candidate separation", Meters(settings.candidate_separation_meters())},
      {"maximal candidates", absl::StrCat(settings.max_candidates())},
      {"maximal inflation", Fixed(settings.max_inflation(), 2)},
      {"kept", Text(settings.retention())}};
}

}  // namespace revisit::client
