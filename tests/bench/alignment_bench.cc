// Similarity and alignment of the core, on one thread.
#include <benchmark/benchmark.h>

#include <cmath>
#include <optional>
#include <string>
#include <utility>
#include <vector>

#include "core/drive/block_bounds.h"
#include "core/drive/drive.h"
#include "core/drive/motion_history.h"
#include "core/drive/pose_graph.h"
#include "core/geometry/pose.h"
#include "core/noise/similarity_model.h"
#include "core/search/alignment/log_similarity.h"
#include "core/search/alignment/relative.h"
#include "core/search/alignment/viterbi.h"
#include "core/search/belief/mark.h"
#include "core/search/candidates/gate.h"
#include "core/search/search.h"
#include "core/settings.h"
#include "tests/bench/eigen_alignment.h"
#include "tests/bench/group_bench.h"
#include "tests/bench/machine_limits.h"
#include "tests/bench/roads.h"

namespace revisit::bench {
namespace {

using core::NodeIndex;
using core::PoseGraph;
using core::SimilarityModel;
using core::StateSpace;

// Checks of a stream.
constexpr NodeIndex kStreamedNodes = 200;
constexpr NodeIndex kStreamedChecks = 20;

SimilarityModel ModelOf(StateSpace space) {
  SimilarityModel model;
  model.state_space = space;
  return model;
}

// The last node against the n before it.
void LogSimilarity(benchmark::State& state, StateSpace space) {
  const NodeIndex n = state.range(0);
  const PoseGraph& graph = Roads(n + kSteps);
  const SimilarityModel model = ModelOf(space);
  std::vector<double> column;
  for (auto _ : state) {
    core::LogSimilarityColumn(graph, model, graph.size() - 1, n, &column);
    benchmark::DoNotOptimize(column.data());
    benchmark::ClobberMemory();
  }
  state.SetItemsProcessed(state.iterations() * n);
}

// The same by the path that serves single pairs.
void LogSimilarityScalar(benchmark::State& state, StateSpace space) {
  const NodeIndex n = state.range(0);
  const PoseGraph& graph = Roads(n + kSteps);
  const SimilarityModel model = ModelOf(space);
  std::vector<double> column(static_cast<std::size_t>(n));
  for (auto _ : state) {
    for (NodeIndex i = 0; i < n; ++i) {
      column[static_cast<std::size_t>(i)] =
          core::LogSimilarity(graph, model, graph.size() - 1, i);
    }
    benchmark::DoNotOptimize(column.data());
    benchmark::ClobberMemory();
  }
  state.SetItemsProcessed(state.iterations() * n);
}

template <int Size, int D>
void LogSimilarityEigen(benchmark::State& state) {
  const NodeIndex n = state.range(0);
  const std::vector<EigenNode<Size>> nodes =
      EigenNodes<Size, D>(Roads(n + kSteps));
  const core::PlaceTolerance tolerance;
  std::vector<double> column(static_cast<std::size_t>(n));
  for (auto _ : state) {
    for (std::size_t i = 0; i < column.size(); ++i) {
      column[i] = EigenLogSimilarity(nodes.back(), nodes[i], tolerance);
    }
    benchmark::DoNotOptimize(column.data());
    benchmark::ClobberMemory();
  }
  state.SetItemsProcessed(state.iterations() * n);
}

// n nodes of history.
void AlignComposite(benchmark::State& state) {
  const NodeIndex n = state.range(0);
  const PoseGraph& graph = Roads(n + kSteps);
  const SimilarityModel model = ModelOf(StateSpace::kPlanar);
  for (auto _ : state) {
    benchmark::DoNotOptimize(
        core::Align(graph, model, graph.size() - 1, kSteps, n, nullptr));
  }
  state.SetItemsProcessed(state.iterations() * n * kSteps);
}

// Whose errors are searched: those that the drive has gathered, those left once
// its last loop closure is known, or those of satellite fixes.
enum class Errors { kReckoned, kReckonedAndConfirmed, kFixes };

// The state that the drive keeps beside a graph, and its queries.
class Relative {
 public:
  Relative(const PoseGraph& graph, NodeIndex n, Errors errors)
      : graph_(graph),
        n_(n),
        history_(StateSpace::kPlanar, CorrelationOf(errors),
                 core::StretchNodes(core::ShapeModel(), kSpacing, kSteps)),
        bounds_(StateSpace::kPlanar) {
    model_.similarity = ModelOf(StateSpace::kPlanar);
    model_.similarity.correlation = CorrelationOf(errors);
    model_.spacing_meters = kSpacing;
    if (errors == Errors::kReckonedAndConfirmed) {
      model_.last_confirmed = {n - 1, n / 2};
    }
    history_.Extend(graph);
    bounds_.Extend(graph);
  }

  void LeaveOut() {
    model_.least_log_share = std::log(1e-6 / static_cast<double>(n_));
  }

  std::optional<core::RelativeAlignment> Align() const {
    return core::AlignRelative(
        {graph_, graph_.size() - 1, kSteps, &history_},
        {graph_, n_, {}, &history_.heading_bins(), &bounds_, {}}, model_,
        nullptr);
  }

  // Share of the history that passes the gate at the end pose.
  double GateShare() const {
    const core::Gate gate(StateSpace::kPlanar, 0.95);
    NodeIndex passed = 0;
    core::VisitBlockSimilarities(
        graph_, model_.similarity, graph_.size() - 1, n_,
        [&](NodeIndex first, const core::BlockSimilarity& part) {
          for (std::size_t k = 0; k < core::NodeBlock::kSize; ++k) {
            passed += first + static_cast<NodeIndex>(k) < n_ &&
                      part.log_similarity[k] != core::kImpossible &&
                      part.squared_mahalanobis[k] <= gate.threshold();
          }
        });
    return static_cast<double>(passed) / static_cast<double>(n_);
  }

 private:
  static core::CorrelationModel CorrelationOf(Errors errors) {
    return errors == Errors::kFixes ? core::CorrelationModel::kIndependent
                                    : core::CorrelationModel::kDeadReckoning;
  }

  const PoseGraph& graph_;
  const NodeIndex n_;
  core::MotionHistory history_;
  core::BlockBounds bounds_;
  core::RelativeModel model_;
};

const PoseGraph& GraphOf(NodeIndex n, Errors errors) {
  return errors == Errors::kFixes ? FixedRoads(n + kSteps) : Roads(n + kSteps);
}

void AlignRelative(benchmark::State& state, Errors errors, bool leave_out) {
  const NodeIndex n = state.range(0);
  Relative relative(GraphOf(n, errors), n, errors);
  if (leave_out) relative.LeaveOut();
  NodeIndex considered = 0;
  for (auto _ : state) {
    const auto alignment = relative.Align();
    considered = alignment->considered();
    benchmark::DoNotOptimize(alignment);
  }
  state.SetItemsProcessed(state.iterations() * n * kSteps);
  state.counters["considered"] =
      static_cast<double>(considered) / static_cast<double>(n);
  state.counters["in_gate"] = relative.GateShare();
}

// A vehicle with n nodes of history that drives on: each time one node and a
// check.
void AlignStreaming(benchmark::State& state) {
  const NodeIndex n = state.range(0);
  const PoseGraph& roads = SmoothRoads(n + kSteps + kStreamedNodes);
  const auto pose_of = [&roads](NodeIndex i) {
    const core::Node node = roads.node(i);
    core::PoseSample sample;
    sample.sequence = node.sequence;
    sample.pose = node.pose;
    sample.covariance = node.covariance;
    return sample;
  };
  core::DriveSettings settings;
  settings.search.correlation_model = core::CorrelationModel::kIndependent;
  core::Drive drive(settings);
  NodeIndex next = 0;
  for (; next < n + kSteps; ++next) drive.Append({pose_of(next)}, next + 1);
  for (auto _ : state) {
    drive.Append({pose_of(next)}, next + 1);
    ++next;
    benchmark::DoNotOptimize(
        core::Search(&drive).AtEnd(settings.search, nullptr));
  }
  state.counters["nodes"] = static_cast<double>(drive.graph().size());
  state.SetItemsProcessed(state.iterations() * n * kSteps);
}

// The same by dead reckoning, whose drift fills the town, with a belief and a
// check every 50 m, at each of which a mark lies: of the last recording, where
// the drive is several. The first search, which knows no marks, does not count.
void AlignStreamingReckoned(benchmark::State& state, NodeIndex recordings) {
  constexpr NodeIndex kNodesOfCheck = 25;
  const NodeIndex n = state.range(0);
  const std::vector<core::PoseSample> poses =
      RecordRoads(n + (kStreamedChecks + 1) * kNodesOfCheck, recordings);
  const core::DriveSettings settings;
  core::Drive drive(settings);
  core::Search search(&drive);
  auto next = poses.begin();
  const auto drive_on = [&](NodeIndex count) {
    const std::vector<core::PoseSample> samples(next, next + count);
    next += count;
    return drive.Append(samples, samples.back().sequence).checks_due;
  };
  drive_on(n);
  benchmark::DoNotOptimize(search.AtEnd(settings.search, nullptr));
  for (auto _ : state) {
    for (const NodeIndex query : drive_on(kNodesOfCheck)) {
      benchmark::DoNotOptimize(search.At(query, settings.search, nullptr));
    }
  }
}

// Which search after a load.
enum class After { kWithoutMarks, kWithMarks, kAnother };

// A search at the end, of a drive by dead reckoning: the first one after a load
// without marks, or with those that were stored, which it takes; or another.
void SearchAfterLoad(benchmark::State& state, After after) {
  const core::DriveSettings settings;
  core::Drive drive(settings);
  drive.Append(RecordRoads(state.range(0), 1), 1);
  core::Search before(&drive);
  benchmark::DoNotOptimize(before.AtEnd(settings.search, nullptr));
  const std::string marks = before.SaveMarks();
  for (auto _ : state) {
    core::Search first(&drive);
    if (after == After::kWithMarks && !first.LoadMarks(marks)) {
      state.SkipWithError("marks are refused");
      break;
    }
    benchmark::DoNotOptimize((after == After::kAnother ? before : first)
                                 .AtEnd(settings.search, nullptr));
  }
  state.counters["bytes"] = static_cast<double>(marks.size());
}

void AlignLiteral(benchmark::State& state) {
  const NodeIndex n = state.range(0);
  const std::vector<EigenNode<3>> nodes = EigenNodes<3, 3>(Roads(n + kSteps));
  for (auto _ : state) {
    benchmark::DoNotOptimize(
        LiteralAlgorithm1(nodes, n + kSteps - 1, kSteps, {}));
  }
  state.SetItemsProcessed(state.iterations() * n * kSteps);
}

void LimitMultiplyAndAdd(benchmark::State& state) {
  double sink = 0.0;
  std::size_t operations = 0;
  for (auto _ : state) {
    operations += MultiplyAndAdd(100000, &sink);
    benchmark::DoNotOptimize(sink);
  }
  state.SetItemsProcessed(static_cast<std::int64_t>(operations));
}

void LimitDivide(benchmark::State& state) {
  double sink = 0.0;
  std::size_t divisions = 0;
  for (auto _ : state) {
    divisions += Divide(100000, &sink);
    benchmark::DoNotOptimize(sink);
  }
  state.SetItemsProcessed(static_cast<std::int64_t>(divisions));
}

void LimitReadNodes(benchmark::State& state) {
  const NodeIndex n = state.range(0);
  const PoseGraph& graph = Roads(n + kSteps);
  for (auto _ : state) {
    benchmark::DoNotOptimize(ReadNodes(graph, static_cast<std::size_t>(n)));
  }
  state.SetItemsProcessed(state.iterations() * n);
}

template <typename Function, typename... Arguments>
void Register(const std::string& name, std::int64_t most, Function function,
              Arguments... arguments) {
  auto* const registered = benchmark::RegisterBenchmark(
      ("BM_" + name).c_str(),
      [function, arguments...](benchmark::State& state) {
        function(state, arguments...);
      });
  for (std::int64_t n = 1000; n <= most; n *= 10) registered->Arg(n);
}

void RegisterAll() {
  constexpr std::int64_t kMost = 100000;
  Register("LogSimilarity", kMost, LogSimilarity, StateSpace::kPlanar);
  Register("LogSimilarityScalar", kMost, LogSimilarityScalar,
           StateSpace::kPlanar);
  Register("LogSimilarityEigen", kMost, LogSimilarityEigen<3, 3>);
  Register("LogSimilarityEigenDynamic", kMost,
           LogSimilarityEigen<Eigen::Dynamic, 3>);
  Register("LogSimilaritySpatial", kMost, LogSimilarity, StateSpace::kSpatial);
  Register("LogSimilaritySpatialEigen", kMost, LogSimilarityEigen<4, 4>);
  Register("LogSimilaritySpatialEigenDynamic", kMost,
           LogSimilarityEigen<Eigen::Dynamic, 4>);
  Register("Align/dense/composite", kMost, AlignComposite);
  constexpr std::int64_t kMillion = 1000000;
  for (const auto& [name, errors] :
       {std::pair("reckoned", Errors::kReckoned),
        std::pair("confirmed", Errors::kReckonedAndConfirmed),
        std::pair("fixes", Errors::kFixes)}) {
    Register("Align/dense/" + std::string(name), kMillion, AlignRelative,
             errors, false);
    Register("Align/pruned/" + std::string(name), kMillion, AlignRelative,
             errors, true);
  }
  for (NodeIndex n = 1000; n <= kMillion; n *= 10) {
    benchmark::RegisterBenchmark("BM_Align/streaming/fixes", AlignStreaming)
        ->Arg(n)
        ->Iterations(kStreamedNodes);
    benchmark::RegisterBenchmark("BM_Align/streaming/believed",
                                 AlignStreamingReckoned, 1)
        ->Arg(n)
        ->Iterations(kStreamedChecks);
  }
  for (const NodeIndex recordings : {1, 2, 8}) {
    benchmark::RegisterBenchmark(
        ("BM_Align/streaming/recordings:" + std::to_string(recordings)).c_str(),
        AlignStreamingReckoned, recordings)
        ->Arg(10'000)
        ->Iterations(kStreamedChecks);
  }
  for (const auto& [name, after] :
       {std::pair("without_marks", After::kWithoutMarks),
        std::pair("with_marks", After::kWithMarks),
        std::pair("another", After::kAnother)}) {
    // The last two are 28 and 200 km.
    for (const NodeIndex n : {1000, 14'000, 100'000}) {
      benchmark::RegisterBenchmark(
          (std::string("BM_Search/after_load/") + name).c_str(),
          SearchAfterLoad, after)
          ->Arg(n);
    }
  }
  RegisterGroupSearches();
  Register("AlignLiteral", kMost, AlignLiteral);
  Register("Limit/ReadNodes", kMost, LimitReadNodes);
  benchmark::RegisterBenchmark("BM_Limit/MultiplyAndAdd", LimitMultiplyAndAdd);
  benchmark::RegisterBenchmark("BM_Limit/Divide", LimitDivide);
  benchmark::AddCustomContext("vectors", VectorTarget());
  benchmark::AddCustomContext("kernel_operations",
                              std::to_string(kPlanarOperations));
  benchmark::AddCustomContext("kernel_divisions",
                              std::to_string(kPlanarDivisions));
}

}  // namespace
}  // namespace revisit::bench

int main(int argc, char** argv) {
  benchmark::Initialize(&argc, argv);
  if (benchmark::ReportUnrecognizedArguments(argc, argv)) return 64;
  revisit::bench::RegisterAll();
  benchmark::RunSpecifiedBenchmarks();
  benchmark::Shutdown();
  return 0;
}
