#include "core/search/belief/drive_belief.h"

#include <algorithm>
#include <cmath>

#include "core/drive/node_range.h"
#include "core/search/belief/log_odds.h"

namespace revisit::core {
namespace {

// Scales less probable than this (e^-5) are left out.
constexpr double kLeastLogWeight = -5.0;

// A place is never taken to be surer than this: verifiers refuse some that look
// surer.
constexpr double kMostDriftProbability = 0.999;

// Probability of either side that ScaleEstimate's bounds cut off.
constexpr double kScaleTail = 0.05;

// A node that lies short of a mark by this share of the spacing counts as
// there.
constexpr double kMarkTolerance = 1e-9;

ByScale Sum(ByScale a, const ByScale& b) {
  for (std::size_t k = 0; k < kScales; ++k) a[k] += b[k];
  return a;
}

}  // namespace

std::int64_t MarkLine::LastBefore(NodeIndex node) const {
  return static_cast<std::int64_t>(
             std::floor(MetersTo(node) / spacing_meters + kMarkTolerance)) -
         1;
}

NodeIndex MarkLine::NodeOf(std::int64_t mark) const {
  const double at =
      (static_cast<double>(mark) - kMarkTolerance) * spacing_meters;
  return FirstWith(0, graph.size() - 1,
                   [&](NodeIndex i) { return MetersTo(i) >= at; });
}

double MarkLine::MetersTo(NodeIndex node) const {
  return graph.node(node).travelled_meters - dropped.MetersBefore(node);
}

ScaleMarks::ScaleMarks(std::int64_t last) {
  while (last / stride >= kMostScaleMarks) stride *= 2;
  for (std::int64_t mark = stride; mark <= last; mark += stride) {
    marks.push_back(mark);
  }
}

DriveBelief::DriveBelief() {
  for (std::size_t k = 0; k < kScales; ++k) {
    const double deviations = LogScale(k) / kLogScalePrior;
    log_density_[k] = -0.5 * deviations * deviations;
  }
}

void DriveBelief::LearnScale(const MarkEvidence& mark, std::int64_t stride) {
  const double share = std::min(1.0, kScaleShare * static_cast<double>(stride));
  for (std::size_t k = 0; k < kScales; ++k) {
    log_density_[k] += share * mark.log_evidence[k];
  }
}

void DriveBelief::LearnDrift(const PoseGraph& graph,
                             const Recordings& recordings,
                             const MarkEvidence& mark, double reach_meters) {
  if (!mark.matched) return;
  const double probability =
      std::exp(LogSum(Sum(log_density_, mark.log_matched_odds)) -
               LogSum(Sum(log_density_, mark.log_all_evidence)));
  if (!(probability >= kLeastDriftProbability)) return;
  const double shown = std::min(probability, kMostDriftProbability);
  const std::size_t recording = recordings.Of(*mark.matched);
  std::vector<WeighedDrift>& drifts = drifts_[recording];
  for (WeighedDrift& earlier : drifts) {
    earlier.log_weight += std::log1p(-shown);
  }
  std::vector<ConfirmedLoop>& pairs = pairs_[recording];
  if (pairs.size() == kMostPairs) pairs.erase(pairs.begin());
  pairs.push_back({mark.node, *mark.matched, nullptr});
  WeighedDrift drift;
  drift.pairs = pairs;
  drift.log_weight = std::log(shown);
  drift.reach = Common(NodesNearer(graph, *mark.matched, reach_meters),
                       recordings.NodesOf(recording, mark.node));
  drifts.push_back(drift);
  if (drifts.size() > kMostDrifts) {
    drifts.erase(
        std::min_element(drifts.begin(), drifts.end(),
                         [](const WeighedDrift& a, const WeighedDrift& b) {
                           return a.log_weight < b.log_weight;
                         }));
  }
}

std::vector<WeighedDrift> DriveBelief::drifts(std::size_t recording) const {
  const auto found = drifts_.find(recording);
  return found == drifts_.end() ? std::vector<WeighedDrift>() : found->second;
}

ByScale DriveBelief::Weights() const {
  const double all = LogSum(log_density_);
  ByScale weights;
  for (std::size_t k = 0; k < kScales; ++k) {
    weights[k] = std::exp(log_density_[k] - all);
  }
  return weights;
}

std::vector<WeighedScale> DriveBelief::AllScales() const {
  const double all = LogSum(log_density_);
  std::vector<WeighedScale> scales;
  for (std::size_t k = 0; k < kScales; ++k) {
    scales.push_back({std::exp(LogScale(k)), log_density_[k] - all});
  }
  return scales;
}

std::vector<WeighedScale> DriveBelief::Scales() const {
  std::vector<WeighedScale> scales = AllScales();
  scales.erase(std::remove_if(scales.begin(), scales.end(),
                              [](const WeighedScale& scale) {
                                return scale.log_weight < kLeastLogWeight;
                              }),
               scales.end());
  double sum = 0.0;
  for (const WeighedScale& scale : scales) sum += std::exp(scale.log_weight);
  for (WeighedScale& scale : scales) scale.log_weight -= std::log(sum);
  return scales;
}

ScaleEstimate DriveBelief::Scale() const {
  const ByScale weights = Weights();
  double mean = 0.0;
  for (std::size_t k = 0; k < kScales; ++k) mean += weights[k] * LogScale(k);
  std::size_t low = 0;
  for (double below = weights[0]; below < kScaleTail; below += weights[low]) {
    ++low;
  }
  std::size_t high = kScales - 1;
  for (double above = weights[high]; above < kScaleTail;
       above += weights[high]) {
    --high;
  }
  // Each scale stands for what lies within half a step of it.
  return {std::exp(mean), std::exp(LogScale(low) - 0.5 * kLogScaleStep),
          std::exp(LogScale(high) + 0.5 * kLogScaleStep)};
}

}  // namespace revisit::core
