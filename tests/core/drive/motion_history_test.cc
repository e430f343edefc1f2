#include "core/drive/motion_history.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <optional>
#include <vector>

#include "core/drive/pose_graph.h"
#include "core/geometry/heading.h"
#include "tests/core/graphs.h"
#include "tests/oracle/motion_at_once.h"
#include "tests/random.h"

namespace revisit::core {
namespace {

std::vector<double> SharesBy(const MotionHistory& history,
                             const PoseGraph& graph, NodeIndex last,
                             const std::vector<double>& turns,
                             double tolerance_radians) {
  StretchCounter counter(turns, tolerance_radians);
  history.Count(graph, last, &counter);
  return counter.Shares();
}

constexpr CorrelationModel kModels[] = {
    CorrelationModel::kDeadReckoning, CorrelationModel::kIndependent,
    CorrelationModel::kFilter, CorrelationModel::kCorrelatedFixes};

// Adds the nodes of `full` that `graph` does not have yet, up to `size`.
void GrowTo(NodeIndex size, const PoseGraph& full, PoseGraph* graph) {
  for (NodeIndex i = graph->size(); i < size; ++i) {
    graph->AddNode(full.node(i), full.SegmentStart(i) == i, full.transition(i));
  }
}

template <int D>
void ExpectAsMeasured(const PoseGraph& graph, CorrelationModel model,
                      const MotionHistory& history, NodeIndex last) {
  const MotionStatistics<D> kept =
      MeanMotion<D>(history.correlation(), history.Sums<D>(graph, last));
  const MotionStatistics<D> slow = oracle::MeasureMotion<D>(graph, model, last);
  EXPECT_EQ(kept.steps, slow.steps);
  EXPECT_EQ(kept.drift, slow.drift);
  EXPECT_EQ(kept.jitter, slow.jitter);
}

void ExpectAsMeasured(const PoseGraph& graph, StateSpace space,
                      CorrelationModel model, const MotionHistory& history,
                      NodeIndex last) {
  if (space == StateSpace::kPlanar) {
    ExpectAsMeasured<3>(graph, model, history, last);
  } else {
    ExpectAsMeasured<4>(graph, model, history, last);
  }
}

void ExpectAsCounted(std::mt19937_64& random, const PoseGraph& graph,
                     const MotionHistory& history, NodeIndex last) {
  // Some turns more than once, and some bounds at turns that occur.
  const bool even = UniformInt(random, 0, 1) == 0;
  const double tolerance =
      even ? UniformInt(random, 0, 4) / 8.0 : Uniform(random, 0.0, 1.5);
  std::vector<double> turns;
  const int count = UniformInt(random, 0, 30);
  for (int k = 0; k < count; ++k) {
    turns.push_back(even ? UniformInt(random, -25, 25) / 8.0
                         : Uniform(random, -kPi, kPi));
  }
  EXPECT_EQ(SharesBy(history, graph, last, turns, tolerance),
            oracle::ShareOfStretches(graph, last, history.stretch_nodes(),
                                     turns, tolerance));
}

// Headings at multiples of an eighth, so that differences are exact.
PoseGraph EvenHeadings(std::mt19937_64& random, NodeIndex size,
                       double new_segment_probability) {
  PoseGraph graph;
  for (NodeIndex i = 0; i < size; ++i) {
    Node node;
    node.pose.heading = UniformInt(random, -25, 25) / 8.0;
    graph.AddNode(node,
                  i == 0 || Uniform(random, 0.0, 1.0) < new_segment_probability,
                  std::nullopt);
  }
  return graph;
}

NodeIndex RandomNode(std::mt19937_64& random, const PoseGraph& graph) {
  return UniformInt(random, 0, static_cast<int>(graph.size()) - 1);
}

TEST(MotionHistoryTest, MeasuresToTheBitWhatAWalkOverAllNodesMeasures) {
  std::mt19937_64 random = SeededRandom();
  for (int trial = 0; trial < 300; ++trial) {
    const CorrelationModel model = kModels[trial % 4];
    const StateSpace space =
        trial % 2 == 0 ? StateSpace::kPlanar : StateSpace::kSpatial;
    const PoseGraph full =
        RandomGraph(random, UniformInt(random, 1, 1200),
                    UniformInt(random, 0, 2) * 0.02, 0, true);
    PoseGraph graph;
    MotionHistory history(space, model, UniformInt(random, 1, 40));
    while (graph.size() < full.size()) {
      GrowTo(std::min(full.size(), graph.size() + UniformInt(random, 1, 700)),
             full, &graph);
      // Sometimes the history is behind the graph.
      if (UniformInt(random, 0, 2) > 0) history.Extend(graph);
      ExpectAsMeasured(graph, space, model, history, graph.size() - 1);
      ExpectAsMeasured(graph, space, model, history, RandomNode(random, graph));
    }
    history.Close(graph);
    ExpectAsMeasured(graph, space, model, history, graph.size() - 1);
    ExpectAsMeasured(graph, space, model, history, RandomNode(random, graph));
  }
}

TEST(MotionHistoryTest, CountsTheStretchesThatAWalkOverAllNodesCounts) {
  std::mt19937_64 random = SeededRandom();
  for (int trial = 0; trial < 400; ++trial) {
    const NodeIndex size = UniformInt(random, 1, 1200);
    const double jumps = UniformInt(random, 0, 2) * 0.02;
    const PoseGraph full = trial % 2 == 0
                               ? EvenHeadings(random, size, jumps)
                               : RandomGraph(random, size, jumps, 0, true);
    PoseGraph graph;
    MotionHistory history(StateSpace::kPlanar, CorrelationModel::kDeadReckoning,
                          UniformInt(random, 1, trial % 5 == 0 ? 300 : 40));
    while (graph.size() < size) {
      GrowTo(std::min(size, graph.size() + UniformInt(random, 1, 700)), full,
             &graph);
      if (UniformInt(random, 0, 2) > 0) history.Extend(graph);
      ExpectAsCounted(random, graph, history, graph.size() - 1);
      for (int k = 0; k < 3; ++k) {
        ExpectAsCounted(random, graph, history, RandomNode(random, graph));
      }
    }
    history.Close(graph);
    ExpectAsCounted(random, graph, history, graph.size() - 1);
    ExpectAsCounted(random, graph, history, RandomNode(random, graph));
  }
}

TEST(MotionHistoryTest, ExtendedNodeByNodeItAnswersAtEveryNode) {
  std::mt19937_64 random = SeededRandom();
  for (const StateSpace space : {StateSpace::kPlanar, StateSpace::kSpatial}) {
    const PoseGraph full = RandomGraph(random, 700, 0.01, 0, true);
    PoseGraph graph;
    std::vector<MotionHistory> histories;
    for (CorrelationModel model : kModels) {
      histories.emplace_back(space, model, 12);
    }
    for (NodeIndex i = 0; i < full.size(); ++i) {
      GrowTo(i + 1, full, &graph);
      // Loop closures do not matter.
      if (i % 50 == 49) graph.AddLoopEdge(i, i / 2);
      for (std::size_t m = 0; m < histories.size(); ++m) {
        histories[m].Extend(graph);
        ExpectAsMeasured(graph, space, kModels[m], histories[m], i);
      }
      ExpectAsCounted(random, graph, histories[0], i);
    }
    // The same for every node before, once the history is complete.
    for (NodeIndex i = 0; i < full.size(); ++i) {
      ExpectAsMeasured(graph, space, kModels[2], histories[2], i);
      ExpectAsCounted(random, graph, histories[2], i);
    }
  }
}

TEST(MotionHistoryTest, ExtendedInOneLumpItIsAsLargeAsNodeByNode) {
  std::mt19937_64 random = SeededRandom();
  const PoseGraph full = RandomGraph(random, 3000, 0.01, 0, true);
  PoseGraph graph;
  MotionHistory by_node(StateSpace::kPlanar, CorrelationModel::kFilter, 12);
  for (NodeIndex i = 0; i < full.size(); ++i) {
    GrowTo(i + 1, full, &graph);
    by_node.Extend(graph);
  }
  MotionHistory at_once(StateSpace::kPlanar, CorrelationModel::kFilter, 12);
  at_once.Extend(graph);
  EXPECT_EQ(at_once.bytes(), by_node.bytes());
  const std::size_t before = at_once.bytes();
  at_once.Extend(graph);
  EXPECT_EQ(at_once.bytes(), before);
}

TEST(MotionHistoryTest, TakesAtMostTwelveBytesANode) {
  std::mt19937_64 random = SeededRandom();
  PoseGraph graph;
  Node node;
  MotionHistory planar(StateSpace::kPlanar, CorrelationModel::kDeadReckoning,
                       25);
  MotionHistory spatial(StateSpace::kSpatial, CorrelationModel::kDeadReckoning,
                        25);
  EXPECT_EQ(spatial.bytes(), 0u);
  for (NodeIndex i = 1; i <= 40000; ++i) {
    node.pose.heading = Uniform(random, -kPi, kPi);
    graph.AddNode(node, i == 1, std::nullopt);
    planar.Extend(graph);
    spatial.Extend(graph);
    // A kilobyte is for the list of runs.
    if (i % 997 == 0) {
      EXPECT_LE(planar.bytes(), 11.1 * static_cast<double>(i) + 1024.0) << i;
      EXPECT_LE(spatial.bytes(), 11.7 * static_cast<double>(i) + 1024.0) << i;
    }
  }
}

TEST(MotionHistoryTest, OfASingleNodeThereIsNothingToTell) {
  PoseGraph graph;
  graph.AddNode(Node{}, true, std::nullopt);
  MotionHistory history(StateSpace::kPlanar, CorrelationModel::kDeadReckoning,
                        1);
  history.Extend(graph);
  EXPECT_EQ(history.Sums<3>(graph, 0).steps, 0);
  EXPECT_EQ(SharesBy(history, graph, 0, {0.0}, 0.1), std::vector<double>{1.0});
  EXPECT_EQ(SharesBy(history, graph, 0, {}, 0.1), std::vector<double>{});
}

}  // namespace
}  // namespace revisit::core
