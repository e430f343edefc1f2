#include "core/graph/motion_history.h"

#include <algorithm>
#include <cassert>
#include <cstdint>
#include <utility>

namespace revisit::core {
namespace {

template <int D>
void AddBlock(const PoseGraph& graph, const Correlation& correlation,
              NodeIndex begin, NodeIndex end,
              std::vector<MotionSums<D>>* sums) {
  MotionSums<D> sum;
  if (!sums->empty()) sum = sums->back();
  AddMotion<D>(graph, correlation, begin, end, &sum);
  // Doubling would leave too much memory unused.
  if (sums->size() == sums->capacity()) {
    sums->reserve(sums->size() + sums->size() / 8 + 1);
  }
  sums->push_back(sum);
}

}  // namespace

MotionHistory::MotionHistory(StateSpace space, const Correlation& correlation,
                             NodeIndex stretch_nodes)
    : correlation_(correlation), turn_bins_(stretch_nodes) {
  assert(stretch_nodes >= 1);
  if (space == StateSpace::kSpatial) sums_.emplace<Sums<4>>();
}

void MotionHistory::Extend(const PoseGraph& graph) {
  turn_bins_.Extend(graph);
  heading_bins_.Extend(graph);
  NodeIndex begin = runs_.empty() ? 0 : runs_.back().end;
  for (; begin + kBlockNodes <= graph.size(); begin += kBlockNodes) {
    const NodeIndex end = begin + kBlockNodes;
    std::visit(
        [&](auto& sums) { AddBlock(graph, correlation_, begin, end, &sums); },
        sums_);

    Run run{end, {}};
    run.turns.reserve(static_cast<std::size_t>(kBlockNodes));
    VisitStretches(graph, stretch_nodes(), begin, end,
                   [&](double turn) { run.turns.push_back(turn); });
    std::sort(run.turns.begin(), run.turns.end());
    run.turns.shrink_to_fit();
    runs_.push_back(std::move(run));
    while (runs_.size() >= 2 &&
           Length(runs_.size() - 2) == Length(runs_.size() - 1)) {
      MergeLastTwo();
    }
  }
}

void MotionHistory::MergeLastTwo() {
  Run& earlier = runs_[runs_.size() - 2];
  const Run& later = runs_.back();
  std::vector<double> merged(earlier.turns.size() + later.turns.size());
  std::merge(earlier.turns.begin(), earlier.turns.end(), later.turns.begin(),
             later.turns.end(), merged.begin());
  earlier = {later.end, std::move(merged)};
  runs_.pop_back();
}

template <int D>
MotionStatistics<D> MotionHistory::Measure(const PoseGraph& graph,
                                           NodeIndex last) const {
  assert(last < graph.size());
  const Sums<D>& kept = std::get<Sums<D>>(sums_);
  const auto blocks = std::min<NodeIndex>((last + 1) / kBlockNodes,
                                          static_cast<NodeIndex>(kept.size()));
  MotionSums<D> sums;
  if (blocks > 0) sums = kept[static_cast<std::size_t>(blocks - 1)];
  AddMotion<D>(graph, correlation_, blocks * kBlockNodes, last + 1, &sums);
  return MeanMotion<D>(correlation_, sums);
}

std::vector<double> MotionHistory::Shares(const PoseGraph& graph,
                                          NodeIndex last,
                                          const std::vector<double>& turns,
                                          double tolerance_radians) const {
  assert(last < graph.size());
  StretchCounter counter(turns, tolerance_radians);
  const auto add = [&](NodeIndex first, NodeIndex end, std::int64_t times) {
    VisitStretches(graph, stretch_nodes(), first, end,
                   [&](double turn) { counter.Add(turn, times); });
  };
  const NodeIndex end = last + 1;
  NodeIndex begin = 0;
  for (const Run& run : runs_) {
    if (begin >= end) break;
    if (run.end - end < end - begin) {
      counter.AddSorted(run.turns);
      // Takes those beyond the last node back out, if any.
      add(end, run.end, -1);
    } else {
      add(begin, end, 1);
    }
    begin = run.end;
  }
  add(begin, end, 1);
  return counter.Shares();
}

std::size_t MotionHistory::bytes() const {
  std::size_t bytes = runs_.capacity() * sizeof(Run) + turn_bins_.bytes() +
                      heading_bins_.bytes();
  for (const Run& run : runs_) bytes += run.turns.capacity() * sizeof(double);
  std::visit(
      [&bytes](const auto& sums) {
        bytes += sums.capacity() * sizeof(sums.front());
      },
      sums_);
  return bytes;
}

template MotionStatistics<3> MotionHistory::Measure<3>(const PoseGraph&,
                                                       NodeIndex) const;
template MotionStatistics<4> MotionHistory::Measure<4>(const PoseGraph&,
                                                       NodeIndex) const;

}  // namespace revisit::core
