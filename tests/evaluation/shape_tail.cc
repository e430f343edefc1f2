// How often the shape's likelihood ratio is wrong by how much (shape_filter.h):
// an honest one says t nats for the same road, on another road, at most about
// once in e^t nodes.
//
//   shape_tail DRIVE...
//
// Each check, every 50 m, is aligned with every node before its own sequence,
// whatever the two poses say of where they are. A node is on another road if it
// truly lies beyond kOtherMeters. Prints the share of such nodes above t nats,
// and that times e^t.
#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>
#include <iostream>
#include <vector>

#include "absl/strings/str_format.h"
#include "client/formats/drive_file.h"
#include "core/drive/drive.h"
#include "core/drive/pose_graph.h"
#include "core/geometry/pose.h"
#include "core/search/alignment/relative.h"
#include "core/settings.h"
#include "tests/evaluation/claimed_samples.h"

namespace {

using revisit::client::Drive;
using revisit::client::PlanarPose;
using namespace revisit::core;  // NOLINT: a program of one file.

// Beyond the stretch for which a candidate is answered.
constexpr double kOtherMeters = 40.0;
constexpr int kMostNats = 16;

struct Tail {
  std::int64_t nodes = 0;
  double sum_of_ratios = 0.0;
  // Nodes above t nats.
  std::array<std::int64_t, kMostNats + 1> above = {};

  void Add(double nats) {
    ++nodes;
    sum_of_ratios += std::exp(nats);
    for (int t = 0; t <= kMostNats && nats > t; ++t) {
      ++above[static_cast<std::size_t>(t)];
    }
  }
};

void AddChecks(const Drive& drive, Tail* tail) {
  DriveSettings settings;
  settings.check_interval_meters = 50.0;
  revisit::core::Drive driven(settings);
  const AppendResult appended =
      driven.Append(revisit::evaluation::SamplesOf(drive), 1);
  const PoseGraph& graph = driven.graph();
  std::vector<PlanarPose> truth;
  for (NodeIndex i = 0; i < graph.size(); ++i) {
    truth.push_back(
        drive.truth[static_cast<std::size_t>(graph.node(i).sequence) - 1]);
  }
  RelativeModel model;
  model.similarity.correlation.model = CorrelationModel::kDeadReckoning;
  model.shape = settings.search.shape;
  model.spacing_meters = settings.node_spacing_meters;
  const double weight = ShapeWeight(model.shape, model.spacing_meters);
  const auto sequence = static_cast<std::int64_t>(
      settings.search.sequence_length_meters / settings.node_spacing_meters);
  for (const NodeIndex query : appended.checks_due) {
    const NodeIndex history = query - sequence + 1;
    const std::int64_t steps = std::min(kOverlapSequences * sequence,
                                        query - graph.SegmentStart(query) + 1);
    if (steps < sequence || history <= 0) continue;
    const auto alignment =
        AlignRelative({graph, query, steps}, {graph, history}, model, nullptr);
    const PlanarPose& here = truth[static_cast<std::size_t>(query)];
    for (const ScoredEnd& end : alignment->ends(Direction::kSame)) {
      const PlanarPose& there = truth[static_cast<std::size_t>(end.node)];
      if (std::hypot(there.x - here.x, there.y - here.y) <= kOtherMeters) {
        continue;
      }
      tail->Add(weight * alignment->match(Direction::kSame, end.node)
                             .log_likelihood_ratio -
                kJoinCost);
    }
  }
}

}  // namespace

int main(int argc, char** argv) {
  Tail tail;
  for (int i = 1; i < argc; ++i) {
    const auto drive = revisit::client::ReadDriveFile(argv[i], {});
    if (!drive.ok() || drive->truth.empty()) {
      std::cerr << argv[i] << ": "
                << (drive.ok() ? "it has no truth" : drive.status().message())
                << "\n";
      return 1;
    }
    AddChecks(*drive, &tail);
  }
  if (tail.nodes == 0) {
    std::cerr << "usage: shape_tail DRIVE...\n";
    return 64;
  }
  const auto nodes = static_cast<double>(tail.nodes);
  std::cout << absl::StrFormat("%d nodes of other roads; mean ratio %.2f\n",
                               tail.nodes, tail.sum_of_ratios / nodes)
            << "nats  share      share x e^nats\n";
  for (int t = 0; t <= kMostNats; ++t) {
    const double share =
        static_cast<double>(tail.above[static_cast<std::size_t>(t)]) / nodes;
    std::cout << absl::StrFormat("%4d  %.3e  %.2f\n", t, share,
                                 share * std::exp(t));
  }
  return 0;
}
