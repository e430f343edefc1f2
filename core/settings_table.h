// The table of settings: a row for each says its range, and what has to be made
// anew where it changes. Whatever depends on which settings there are follows
// from it.
//
// To add a setting: its field in settings.h, and its row here; how the rest is
// done: docs/how-it-works.md.
#ifndef REVISIT_CORE_SETTINGS_TABLE_H_
#define REVISIT_CORE_SETTINGS_TABLE_H_

#include <algorithm>
#include <cmath>
#include <optional>

#include "core/noise/noise_model.h"
#include "core/settings.h"

namespace revisit::core {

struct SettingRange {
  double lowest;
  double highest;
  // Whether the number may be lowest or highest itself.
  bool takes_ends = true;
};

struct SettingRow {
  // Name of the field in settings.h, such as "place_tolerance.position_meters".
  const char* field;
  // A sum of Remade.
  unsigned remade;
  // For numbers that have one.
  std::optional<SettingRange> range = std::nullopt;
};

// The nodes, and all that is made of them.
inline constexpr unsigned kRemadeWithNodes =
    kRemadeNodes | kRemadeMotionHistory | kRemadeMarks | kRemadeConsistency;

// Calls visit(row, get) for each option of searches, in the order in which
// problems are reported. get(options) is a reference to the field; where only a
// part of what a setting says makes something anew, there is one more row, and
// get(options) is this part, by value. A spacing that is itself refused sets no
// bound.
template <typename Visit>
void VisitOptions(double node_spacing_meters, const Visit& visit) {
  const auto row = [](const char* field, unsigned remade) {
    return SettingRow{field, remade};
  };
  const auto number = [](const char* field, unsigned remade,
                         const SettingRange& range) {
    return SettingRow{field, remade, range};
  };
  SettingRow length =
      row("sequence_length_meters", kRemadeMotionHistory | kRemadeMarks);
  if (node_spacing_meters > 0.0 && std::isfinite(node_spacing_meters)) {
    length.range = {
        node_spacing_meters,
        static_cast<double>(kMaxSequenceNodes) * node_spacing_meters};
  }
  visit(
      length, [](auto& o) -> auto& { return o.sequence_length_meters; });
  visit(
      row("alignment", kRemadeMarks | kRemadeConsistency),
      [](auto& o) -> auto& { return o.alignment; });
  visit(
      row("correlation_model",
          kRemadeMotionHistory | kRemadeMarks | kRemadeConsistency),
      [](auto& o) -> auto& { return o.correlation_model; });
  visit(row("correlation_model", kRemadeWithNodes), [](auto& o) {
    return NoiseOf(o.correlation_model).carries_transitions;
  });
  visit(row("correlation_model", kRemadeWithNodes),
        [](auto& o) { return NoiseOf(o.correlation_model).carries_claims(); });
  visit(
      number("fix_correlation_meters",
             kRemadeMotionHistory | kRemadeConsistency, {1.0, 1e6}),
      [](auto& o) -> auto& { return o.fix_correlation_meters; });
  visit(
      row("likelihood_form", kRemadeNothing),
      [](auto& o) -> auto& { return o.likelihood_form; });
  visit(
      row("direction", kRemadeMarks),
      [](auto& o) -> auto& { return o.direction; });
  visit(
      number("gate_probability", kRemadeConsistency, {0.0, 1.0, false}),
      [](auto& o) -> auto& { return o.gate_probability; });
  visit(
      number("place_tolerance.position_meters",
             kRemadeMarks | kRemadeConsistency, {0.0, 1000.0}),
      [](auto& o) -> auto& { return o.place_tolerance.position_meters; });
  visit(
      number("place_tolerance.heading_radians",
             kRemadeMarks | kRemadeConsistency, {0.0, 3.0}),
      [](auto& o) -> auto& { return o.place_tolerance.heading_radians; });
  visit(
      number("candidate_separation_meters", kRemadeMarks, {0.0, 1e6}),
      [](auto& o) -> auto& { return o.candidate_separation_meters; });
  visit(
      number("max_candidates", kRemadeNothing, {1.0, kMaxCandidates}),
      [](auto& o) -> auto& { return o.max_candidates; });
  visit(
      row("tell_paths", kRemadeNothing),
      [](auto& o) -> auto& { return o.tell_paths; });
  visit(
      row("max_comparisons", kRemadeNothing),
      [](auto& o) -> auto& { return o.max_comparisons; });
  visit(
      number("shape.tolerance.position_meters", kRemadeMarks, {0.01, 1000.0}),
      [](auto& o) -> auto& { return o.shape.tolerance.position_meters; });
  visit(
      number("shape.tolerance.heading_radians", kRemadeMarks, {0.001, 3.0}),
      [](auto& o) -> auto& { return o.shape.tolerance.heading_radians; });
  visit(
      number("shape.correlation_meters", kRemadeMotionHistory | kRemadeMarks,
             {0.01, 1e6}),
      [](auto& o) -> auto& { return o.shape.correlation_meters; });
  visit(
      row("exhaustive", kRemadeNothing),
      [](auto& o) -> auto& { return o.exhaustive; });
  visit(
      number("road_spacing_meters", kRemadeMarks, {1.0, 1e6}),
      [](auto& o) -> auto& { return o.road_spacing_meters; });
  visit(
      number("acceptance_probability", kRemadeNothing, {0.0, 1.0, false}),
      [](auto& o) -> auto& { return o.acceptance_probability; });
  visit(
      row("use_belief", kRemadeConsistency),
      [](auto& o) -> auto& { return o.use_belief; });
}

// The same for all settings of a vehicle, with the ranges that they have beside
// these.
template <typename Visit>
void VisitSettings(const DriveSettings& beside, const Visit& visit) {
  const double spacing = beside.node_spacing_meters;
  visit(
      SettingRow{"state_space", kRemadeWithNodes},
      [](auto& s) -> auto& { return s.state_space; });
  visit(
      SettingRow{"node_spacing_meters", kRemadeWithNodes,
                 SettingRange{kLeastSpacingMeters, 1000.0}},
      [](auto& s) -> auto& { return s.node_spacing_meters; });
  visit(
      SettingRow{"check_interval_meters", kRemadeNothing,
                 SettingRange{std::max(kLeastSpacingMeters, spacing), 1e5}},
      [](auto& s) -> auto& { return s.check_interval_meters; });
  visit(
      SettingRow{"max_step_meters", kRemadeWithNodes,
                 SettingRange{0.01, LongestStep(spacing)}},
      [](auto& s) -> auto& { return s.max_step_meters; });
  visit(
      SettingRow{"apply_inflation", kRemadeConsistency},
      [](auto& s) -> auto& { return s.apply_inflation; });
  visit(
      SettingRow{"max_inflation", kRemadeConsistency, SettingRange{1.0, 100.0}},
      [](auto& s) -> auto& { return s.max_inflation; });
  visit(
      SettingRow{
          "retention.max_age", kRemadeKept,
          SettingRange{kLeastAgeNanoseconds / 1e9, kMostAgeNanoseconds / 1e9}},
      [](auto& s) -> auto& { return s.retention.max_age_ns; });
  visit(
      SettingRow{"retention.max_passes", kRemadeKept,
                 SettingRange{0.0, kMostPasses}},
      [](auto& s) -> auto& { return s.retention.max_passes; });
  VisitOptions(spacing, [&](const SettingRow& row, const auto& get) {
    visit(row, [get](auto& s) -> decltype(auto) { return get(s.search); });
  });
}

}  // namespace revisit::core

#endif  // REVISIT_CORE_SETTINGS_TABLE_H_
