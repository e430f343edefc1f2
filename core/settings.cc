#include "core/settings.h"

#include <algorithm>
#include <cmath>

#include "core/base/number_text.h"

namespace revisit::core {
namespace {

constexpr double kLongestStepMeters = 1e6;

void Check(const NumberSetting& number, std::vector<SettingProblem>* problems) {
  // Written so that not-a-number is out of range.
  const bool is_within =
      number.takes_ends
          ? number.value >= number.lowest && number.value <= number.highest
          : number.value > number.lowest && number.value < number.highest;
  if (is_within) return;
  const std::string lowest = NumberText(number.lowest);
  const std::string highest = NumberText(number.highest);
  problems->push_back(
      {number.field,
       "got " + NumberText(number.value) + "; allowed is " +
           (number.takes_ends ? "[" + lowest + ", " + highest + "]"
                              : "above " + lowest + " and below " + highest)});
}

void CheckSearch(const SearchOptions& options, double node_spacing_meters,
                 std::vector<SettingProblem>* problems) {
  // With a spacing that is itself refused, no length would be allowed.
  if (node_spacing_meters > 0.0 && std::isfinite(node_spacing_meters)) {
    Check({"sequence_length_meters", options.sequence_length_meters,
           node_spacing_meters,
           static_cast<double>(kMaxSequenceNodes) * node_spacing_meters},
          problems);
  }
  for (const NumberSetting& number : NumbersOf(options)) {
    Check(number, problems);
  }
}

}  // namespace

std::vector<SettingProblem> FindProblems(const DriveSettings& settings) {
  std::vector<SettingProblem> problems;
  for (const NumberSetting& number : NumbersOf(settings)) {
    Check(number, &problems);
  }
  CheckSearch(settings.search, settings.node_spacing_meters, &problems);
  return problems;
}

std::vector<SettingProblem> FindProblems(const SearchOptions& options,
                                         const DriveSettings& vehicle) {
  std::vector<SettingProblem> problems;
  CheckSearch(options, vehicle.node_spacing_meters, &problems);
  if (NoiseOf(options.correlation_model).carries_transitions &&
      !NoiseOf(vehicle.search.correlation_model).carries_transitions) {
    problems.push_back(
        {"correlation_model",
         "got FILTER; allowed only where the vehicle's own model "
         "is FILTER"});
  }
  return problems;
}

bool MovesNodes(const DriveSettings& before, const DriveSettings& after) {
  const auto carries_transitions = [](const DriveSettings& settings) {
    return NoiseOf(settings.search.correlation_model).carries_transitions;
  };
  return before.state_space != after.state_space ||
         before.node_spacing_meters != after.node_spacing_meters ||
         before.max_step_meters != after.max_step_meters ||
         carries_transitions(before) != carries_transitions(after);
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

}  // namespace revisit::core
