#include "core/drive/motion_history.h"

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

// Merges two sorted ranges into the place of `next`. Turns come in no order, so
// that a branch would be guessed wrong half of the time: there is none.
void Merge(const double* a, const double* a_end, const double* b,
           const double* b_end, double* next) {
  while (a != a_end && b != b_end) {
    const bool takes_b = *b < *a;
    *next++ = takes_b ? *b : *a;
    b += takes_b ? 1 : 0;
    a += takes_b ? 0 : 1;
  }
  std::copy(b, b_end, std::copy(a, a_end, next));
}

}  // namespace

MotionHistory::MotionHistory(StateSpace space, const Correlation& correlation,
                             NodeIndex stretch_nodes)
    : correlation_(correlation), turn_bins_(stretch_nodes) {
  assert(stretch_nodes >= 1);
  if (space == StateSpace::kSpatial) sums_.emplace<BlockSums<4>>();
}

void MotionHistory::Extend(const PoseGraph& graph) {
  assert(!is_closed_);
  turn_bins_.Extend(graph);
  heading_bins_.Extend(graph);
  NodeIndex begin = runs_.empty() ? 0 : runs_.back().end;
  for (; begin + kBlockNodes <= graph.size(); begin += kBlockNodes) {
    const NodeIndex end = begin + kBlockNodes;
    std::visit(
        [&](auto& sums) { AddBlock(graph, correlation_, begin, end, &sums); },
        sums_);

    runs_.push_back(Measure(graph, begin, end));
    while (runs_.size() >= 2 &&
           Length(runs_.size() - 2) == Length(runs_.size() - 1)) {
      MergeLastTwo();
    }
  }
}

MotionHistory::Run MotionHistory::Measure(const PoseGraph& graph,
                                          NodeIndex begin,
                                          NodeIndex end) const {
  Run run{end, {}};
  run.turns.reserve(static_cast<std::size_t>(end - begin));
  VisitStretches(graph, stretch_nodes(), begin, end,
                 [&](double turn) { run.turns.push_back(turn); });
  std::sort(run.turns.begin(), run.turns.end());
  run.turns.shrink_to_fit();
  return run;
}

void MotionHistory::Close(const PoseGraph& graph) {
  Extend(graph);
  is_closed_ = true;
  const NodeIndex begin = runs_.empty() ? 0 : runs_.back().end;
  if (begin == graph.size()) return;
  std::visit(
      [&](auto& sums) {
        AddBlock(graph, correlation_, begin, graph.size(), &sums);
      },
      sums_);
  runs_.push_back(Measure(graph, begin, graph.size()));
}

void MotionHistory::AppendTurns(std::vector<double>* turns) const {
  for (const Run& run : runs_) {
    turns->insert(turns->end(), run.turns.begin(), run.turns.end());
  }
}

void MotionHistory::MergeLastTwo() {
  Run& earlier = runs_[runs_.size() - 2];
  const Run& later = runs_.back();
  std::vector<double> merged(earlier.turns.size() + later.turns.size());
  Merge(earlier.turns.data(), earlier.turns.data() + earlier.turns.size(),
        later.turns.data(), later.turns.data() + later.turns.size(),
        merged.data());
  earlier = {later.end, std::move(merged)};
  runs_.pop_back();
}

template <int D>
MotionSums<D> MotionHistory::Sums(const PoseGraph& graph,
                                  NodeIndex last) const {
  assert(last < graph.size());
  const BlockSums<D>& kept = std::get<BlockSums<D>>(sums_);
  if (is_closed_ && last + 1 == graph.size()) return kept.back();
  const auto blocks = std::min<NodeIndex>((last + 1) / kBlockNodes,
                                          static_cast<NodeIndex>(kept.size()));
  MotionSums<D> sums;
  if (blocks > 0) sums = kept[static_cast<std::size_t>(blocks - 1)];
  AddMotion<D>(graph, correlation_, blocks * kBlockNodes, last + 1, &sums);
  return sums;
}

void MotionHistory::Count(const PoseGraph& graph, NodeIndex last,
                          StretchCounter* counter, std::int64_t times) const {
  assert(last < graph.size());
  const auto add = [&](NodeIndex first, NodeIndex end, std::int64_t sign) {
    VisitStretches(graph, stretch_nodes(), first, end,
                   [&](double turn) { counter->Add(turn, sign * times); });
  };
  const NodeIndex end = last + 1;
  NodeIndex begin = 0;
  for (const Run& run : runs_) {
    if (begin >= end) break;
    if (run.end - end < end - begin) {
      counter->AddSorted(run.turns, times);
      // Takes those beyond the last node back out, if any.
      add(end, run.end, -1);
    } else {
      add(begin, end, 1);
    }
    begin = run.end;
  }
  add(begin, end, 1);
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

void MotionHistory::SaveBlocks(const PoseGraph& graph, std::size_t first,
                               std::size_t end, ByteWriter* writer) const {
  const std::size_t begin_node = first * static_cast<std::size_t>(kBlockNodes);
  const std::size_t end_node = end * static_cast<std::size_t>(kBlockNodes);
  std::visit(
      [&](const auto& sums) {
        for (std::size_t k = first; k < end; ++k) {
          writer->Put(sums[k].steps);
          writer->PutArray(sums[k].sum.data(),
                           static_cast<std::size_t>(sums[k].sum.size()));
        }
      },
      sums_);
  turn_bins_.SaveNodes(begin_node, end_node, writer);
  // Runs of this length may have been merged into longer ones.
  std::vector<double> turns;
  turns.reserve(end_node - begin_node);
  VisitStretches(graph, stretch_nodes(), static_cast<NodeIndex>(begin_node),
                 static_cast<NodeIndex>(end_node),
                 [&](double turn) { turns.push_back(turn); });
  std::sort(turns.begin(), turns.end());
  writer->PutCounted(turns.data(), turns.size());
}

bool MotionHistory::LoadBlocks(std::size_t count, ByteReader* reader) {
  const bool has_sums = std::visit(
      [&](auto& sums) {
        for (std::size_t k = 0; k < count; ++k) {
          auto& sum = sums.emplace_back();
          if (!reader->Get(&sum.steps) ||
              !reader->GetArray(sum.sum.data(),
                                static_cast<std::size_t>(sum.sum.size())) ||
              !AreFinite(sum.sum.data(),
                         static_cast<std::size_t>(sum.sum.size()))) {
            return false;
          }
        }
        return true;
      },
      sums_);
  const std::size_t nodes = count * static_cast<std::size_t>(kBlockNodes);
  Run run;
  if (!has_sums || !turn_bins_.LoadNodes(nodes, reader) ||
      !reader->GetCounted(nodes, &run.turns) ||
      !AreFinite(run.turns.data(), run.turns.size()) ||
      !std::is_sorted(run.turns.begin(), run.turns.end())) {
    return false;
  }
  run.end = turn_bins_.size();
  runs_.push_back(std::move(run));
  return true;
}

// Merging one run after the other would allocate, and touch, memory of its own
// for each: here two buffers serve for all lengths.
void MotionHistory::EndLoading() {
  std::vector<Run> merged;
  for (std::size_t first = 0; first < runs_.size();) {
    std::size_t count = 1;
    while (2 * count <= runs_.size() - first) count *= 2;
    // Where run i of this length begins.
    std::vector<std::size_t> begins = {0};
    for (std::size_t i = first; i < first + count; ++i) {
      begins.push_back(begins.back() + runs_[i].turns.size());
    }
    std::vector<double> turns;
    turns.reserve(begins.back());
    for (std::size_t i = first; i < first + count; ++i) {
      turns.insert(turns.end(), runs_[i].turns.begin(), runs_[i].turns.end());
      // Frees it.
      runs_[i].turns = std::vector<double>();
    }
    std::vector<double> other(count > 1 ? turns.size() : 0);
    for (std::size_t runs = count; runs > 1; runs /= 2) {
      for (std::size_t i = 0; i < runs; i += 2) {
        const double* const from = turns.data();
        Merge(from + begins[i], from + begins[i + 1], from + begins[i + 1],
              from + begins[i + 2], other.data() + begins[i]);
        begins[i / 2] = begins[i];
      }
      begins[runs / 2] = begins[runs];
      turns.swap(other);
    }
    merged.push_back({runs_[first + count - 1].end, std::move(turns)});
    first += count;
  }
  runs_ = std::move(merged);
}

template MotionSums<3> MotionHistory::Sums<3>(const PoseGraph&,
                                              NodeIndex) const;
template MotionSums<4> MotionHistory::Sums<4>(const PoseGraph&,
                                              NodeIndex) const;

}  // namespace revisit::core
