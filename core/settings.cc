#include "core/settings.h"

#include <algorithm>
#include <cmath>

#include "core/base/number_text.h"

namespace revisit::core {
namespace {

void CheckRange(const char* field, double value, double lowest, double highest,
                std::vector<SettingProblem>* problems) {
  if (value >= lowest && value <= highest) return;
  problems->push_back({field, "got " + NumberText(value) + "; allowed is [" +
                                  NumberText(lowest) + ", " +
                                  NumberText(highest) + "]"});
}

void CheckProbability(const char* field, double value,
                      std::vector<SettingProblem>* problems) {
  if (value > 0.0 && value < 1.0) return;
  problems->push_back(
      {field, "got " + NumberText(value) + "; allowed is above 0 and below 1"});
}

constexpr double kLeastSpacingMeters = 0.01;
constexpr double kLongestStepMeters = 1e6;

// A spacing that is itself refused sets no bound on the step.
double LongestStep(double node_spacing_meters) {
  if (!(node_spacing_meters >= kLeastSpacingMeters)) return kLongestStepMeters;
  return std::min(kLongestStepMeters,
                  static_cast<double>(kMaxNodesPerStep) * node_spacing_meters);
}

void CheckSearch(const SearchOptions& options, double node_spacing_meters,
                 std::vector<SettingProblem>* problems) {
  // With a spacing that is itself refused, no length would be allowed.
  if (node_spacing_meters > 0.0 && std::isfinite(node_spacing_meters)) {
    CheckRange("sequence_length_meters", options.sequence_length_meters,
               node_spacing_meters,
               static_cast<double>(kMaxSequenceNodes) * node_spacing_meters,
               problems);
  }
  CheckProbability("gate_probability", options.gate_probability, problems);
  CheckRange("place_tolerance.position_meters",
             options.place_tolerance.position_meters, 0.0, 1000.0, problems);
  CheckRange("place_tolerance.heading_radians",
             options.place_tolerance.heading_radians, 0.0, 3.0, problems);
  CheckRange("candidate_separation_meters", options.candidate_separation_meters,
             0.0, 1e6, problems);
  CheckRange("max_candidates", options.max_candidates, 1, kMaxCandidates,
             problems);
  CheckRange("shape.tolerance.position_meters",
             options.shape.tolerance.position_meters, 0.01, 1000.0, problems);
  CheckRange("shape.tolerance.heading_radians",
             options.shape.tolerance.heading_radians, 0.001, 3.0, problems);
  CheckRange("shape.correlation_meters", options.shape.correlation_meters, 0.01,
             1e6, problems);
  CheckRange("road_spacing_meters", options.road_spacing_meters, 1.0, 1e6,
             problems);
  CheckProbability("acceptance_probability", options.acceptance_probability,
                   problems);
}

}  // namespace

std::vector<SettingProblem> FindProblems(const EngineSettings& settings) {
  std::vector<SettingProblem> problems;
  CheckRange("node_spacing_meters", settings.node_spacing_meters,
             kLeastSpacingMeters, 1000.0, &problems);
  CheckRange("check_interval_meters", settings.check_interval_meters,
             std::max(kLeastSpacingMeters, settings.node_spacing_meters), 1e5,
             &problems);
  CheckRange("max_step_meters", settings.max_step_meters, 0.01,
             LongestStep(settings.node_spacing_meters), &problems);
  CheckRange("max_inflation", settings.max_inflation, 1.0, 100.0, &problems);
  CheckSearch(settings.search, settings.node_spacing_meters, &problems);
  return problems;
}

std::vector<SettingProblem> FindProblems(const SearchOptions& options,
                                         const EngineSettings& vehicle) {
  std::vector<SettingProblem> problems;
  CheckSearch(options, vehicle.node_spacing_meters, &problems);
  if (options.correlation_model == CorrelationModel::kFilter &&
      vehicle.search.correlation_model != CorrelationModel::kFilter) {
    problems.push_back(
        {"correlation_model",
         "got FILTER; allowed only where the vehicle's own model "
         "is FILTER"});
  }
  return problems;
}

double DefaultMaxStep(double node_spacing_meters) {
  return std::min(EngineSettings{}.max_step_meters,
                  LongestStep(node_spacing_meters));
}

std::int64_t SequenceNodes(double sequence_length_meters,
                           double node_spacing_meters) {
  return std::max<std::int64_t>(
      1, std::llround(sequence_length_meters / node_spacing_meters));
}

}  // namespace revisit::core
