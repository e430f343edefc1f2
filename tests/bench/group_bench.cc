#include "tests/bench/group_bench.h"

#include <benchmark/benchmark.h>

#include <cstddef>
#include <memory>
#include <random>
#include <string>
#include <utility>
#include <vector>

#include "core/drive/drive.h"
#include "core/drive/joined_drives.h"
#include "core/drive/pose_graph.h"
#include "core/geometry/heading.h"
#include "core/geometry/pose.h"
#include "core/geometry/recording_start.h"
#include "core/search/search.h"
#include "core/search/search_scope.h"
#include "core/settings.h"
#include "tests/bench/roads.h"

namespace revisit::bench {
namespace {

// As in group_histories.py: so many vehicles have driven the same streets, the
// next ones those of another site.
constexpr std::size_t kDrivesASite = 10;
constexpr double kSiteMeters = 3000.0;
constexpr double kDatumMeters = 10.0;

// A group takes longer to make than its searches take.
constexpr int kSearches = 30;

// Dead reckoning that a datum has placed, or smoothed satellite fixes of 3 m,
// which err by themselves.
enum class Places { kDatums, kFixes };

std::vector<core::PoseSample> SamplesOf(core::NodeIndex nodes, Places places) {
  if (places == Places::kDatums) return RecordRoads(nodes, 1);
  std::vector<core::PoseSample> samples;
  const core::PoseGraph graph = MakeSmoothRoads(nodes);
  for (core::NodeIndex i = 0; i < graph.size(); ++i) {
    core::PoseSample& sample = samples.emplace_back();
    sample.sequence = graph.node(i).sequence;
    sample.pose = graph.pose(i);
    sample.covariance = graph.covariance(i);
  }
  return samples;
}

std::shared_ptr<const core::RecordingStart> DatumOf(std::size_t drive,
                                                    Places places) {
  auto start = std::make_shared<core::RecordingStart>();
  start->relation = core::RecordingRelation::kDatum;
  start->datum.x = kSiteMeters * static_cast<double>(drive / kDrivesASite);
  // Frames of fixes are those of the receivers, which all have.
  const double meters = places == Places::kDatums ? kDatumMeters : 0.1;
  const double radians = places == Places::kDatums ? core::kPi / 180.0 : 1e-4;
  for (const int i : {0, 1, 2}) start->covariance(i, i) = meters * meters;
  start->covariance(3, 3) = radians * radians;
  return start;
}

struct Group {
  Group(Places places, std::size_t drives, core::NodeIndex nodes)
      : asking(SettingsFor(places)) {
    const std::vector<core::PoseSample> samples = SamplesOf(nodes, places);
    asking.Append(samples, samples.back().sequence);
    std::vector<core::JoinedDrive> joined;
    for (std::size_t d = 0; d < drives; ++d) {
      core::Drive drive(SettingsFor(places));
      drive.Append(samples, samples.back().sequence);
      joined.push_back({drive.View(1.0), DatumOf(d, places)});
    }
    scope = {std::make_shared<const core::JoinedDrives>(
                 std::move(joined), std::vector<core::FrameLink>()),
             drives / 2, /*exclude_own=*/true};
  }

  static core::DriveSettings SettingsFor(Places places) {
    core::DriveSettings settings;
    if (places == Places::kFixes) {
      settings.search.correlation_model = core::CorrelationModel::kIndependent;
    }
    return settings;
  }

  core::Drive asking;
  core::SearchScope scope;
};

// Searches of one drive in all others.
void SearchGroup(benchmark::State& state, Places places) {
  const auto drives = static_cast<std::size_t>(state.range(0));
  const core::NodeIndex nodes = state.range(1);
  const Group group(places, drives, nodes);
  core::Search search(&group.asking);
  const core::NodeIndex query = group.asking.graph().size() - 1;
  const auto ask = [&] {
    return search.At(query, group.asking.settings().search, group.scope,
                     nullptr);
  };
  // The first one also learns what is kept.
  const auto answer = ask();
  for (auto _ : state) benchmark::DoNotOptimize(ask());
  state.counters["considered"] = static_cast<double>(answer->nodes_considered);
  state.counters["pruned"] = static_cast<double>(answer->nodes_pruned);
}

}  // namespace

void RegisterGroupSearches() {
  for (const auto& [name, places] : {std::pair("datums", Places::kDatums),
                                     std::pair("fixes", Places::kFixes)}) {
    benchmark::RegisterBenchmark(
        ("BM_Search/group/" + std::string(name)).c_str(), SearchGroup, places)
        ->Args({20, 1000})
        ->Args({500, 2000})
        ->Args({500, 10'000})
        ->Iterations(kSearches)
        ->Unit(benchmark::kMillisecond);
  }
}

}  // namespace revisit::bench
