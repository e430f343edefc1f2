#include "core/settings.h"

#include <algorithm>
#include <cmath>
#include <type_traits>

#include "core/base/number_text.h"
#include "core/settings_table.h"

namespace revisit::core {
namespace {

constexpr double kLongestStepMeters = 1e6;

// Marks lie so close that a place found at one still tells the drift at the
// next.
constexpr double kMarksPerSequence = 3.0;

template <typename Number>
double NumberOf(Number value) {
  return static_cast<double>(value);
}

// The greatest age in seconds; without one, the least that there can be.
double NumberOf(const std::optional<std::int64_t>& max_age_ns) {
  return static_cast<double>(max_age_ns.value_or(kLeastAgeNanoseconds)) / 1e9;
}

void Check(const char* field, const SettingRange& range, double value,
           std::vector<SettingProblem>* problems) {
  // Written so that not-a-number is out of range.
  const bool is_within = range.takes_ends
                             ? value >= range.lowest && value <= range.highest
                             : value > range.lowest && value < range.highest;
  if (is_within) return;
  const std::string lowest = NumberText(range.lowest);
  const std::string highest = NumberText(range.highest);
  problems->push_back(
      {field,
       "got " + NumberText(value) + "; allowed is " +
           (range.takes_ends ? "[" + lowest + ", " + highest + "]"
                             : "above " + lowest + " and below " + highest)});
}

// Checks one setting of these after the other, as the table visits them.
template <typename Settings>
auto CheckEach(const Settings& settings,
               std::vector<SettingProblem>* problems) {
  return [&settings, problems](const SettingRow& row, const auto& get) {
    using Value = std::decay_t<decltype(get(settings))>;
    if constexpr (!std::is_enum_v<Value> && !std::is_same_v<Value, bool>) {
      if (row.range) {
        Check(row.field, *row.range, NumberOf(get(settings)), problems);
      }
    }
  };
}

}  // namespace

std::vector<SettingProblem> FindProblems(const DriveSettings& settings) {
  std::vector<SettingProblem> problems;
  VisitSettings(settings, CheckEach(settings, &problems));
  return problems;
}

std::vector<SettingProblem> FindProblems(const SearchOptions& options,
                                         const DriveSettings& vehicle) {
  std::vector<SettingProblem> problems;
  VisitOptions(vehicle.node_spacing_meters, CheckEach(options, &problems));
  if (NoiseOf(options.correlation_model).carries_transitions &&
      !NoiseOf(vehicle.search.correlation_model).carries_transitions) {
    problems.push_back(
        {"correlation_model",
         "got FILTER; allowed only where the vehicle's own model "
         "is FILTER"});
  }
  return problems;
}

unsigned RemadeBetween(const DriveSettings& before,
                       const DriveSettings& after) {
  unsigned remade = kRemadeNothing;
  VisitSettings(after, [&](const SettingRow& row, const auto& get) {
    if (!(get(before) == get(after))) remade |= row.remade;
  });
  return remade;
}

bool MovesNodes(const DriveSettings& before, const DriveSettings& after) {
  return (RemadeBetween(before, after) & kRemadeNodes) != 0;
}

SearchOptions MarkOptions(const SearchOptions& own) {
  SearchOptions options;
  VisitOptions(0.0, [&](const SettingRow& row, const auto& get) {
    if constexpr (std::is_lvalue_reference_v<decltype(get(options))>) {
      if ((row.remade & kRemadeMarks) != 0) get(options) = get(own);
    }
  });
  return options;
}

bool BeginsWithBelief(const SearchOptions& options,
                      const DriveSettings& vehicle) {
  return options.use_belief && options.alignment == AlignmentKind::kRelative &&
         options.correlation_model == vehicle.search.correlation_model &&
         NoiseOf(options.correlation_model).lets_belief_begin;
}

Correlation CorrelationOf(const SearchOptions& options) {
  return {options.correlation_model, options.fix_correlation_meters};
}

double LongestStep(double node_spacing_meters) {
  if (!(node_spacing_meters >= kLeastSpacingMeters)) return kLongestStepMeters;
  return std::min(kLongestStepMeters,
                  static_cast<double>(kMaxNodesPerStep) * node_spacing_meters);
}

double DefaultMaxStep(double node_spacing_meters) {
  return std::min(DriveSettings{}.max_step_meters,
                  LongestStep(node_spacing_meters));
}

std::int64_t SequenceNodes(double sequence_length_meters,
                           double node_spacing_meters) {
  return std::max<std::int64_t>(
      1, std::llround(sequence_length_meters / node_spacing_meters));
}

NodeIndex StretchNodes(const ShapeModel& model, double spacing_meters,
                       std::int64_t steps) {
  return std::max<NodeIndex>(
      1, std::min<NodeIndex>(steps - 1, std::llround(model.correlation_meters /
                                                     spacing_meters)));
}

double MarkSpacing(const DriveSettings& settings) {
  return std::max(settings.node_spacing_meters,
                  settings.search.sequence_length_meters / kMarksPerSequence);
}

}  // namespace revisit::core
