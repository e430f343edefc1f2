#include "core/search/alignment/differences.h"

#include <algorithm>
#include <array>
#include <cassert>
#include <cstdint>
#include <numeric>

#include "core/drive/confirmed_loop.h"
#include "core/drive/node_noise.h"
#include "core/geometry/state_matrix.h"
#include "core/noise/similarity_model.h"

namespace revisit::core {
namespace {

BlockColumn IndicesFrom(NodeIndex first) {
  BlockColumn indices;
  std::iota(indices.begin(), indices.end(), static_cast<double>(first));
  return indices;
}

// For each of the nodes with these indices whether it lies before the
// reference, as 1 or 0.
using AreBefore = std::array<std::uint8_t, NodeBlock::kSize>;

AreBefore FindBefore(const BlockColumn& indices, NodeIndex reference) {
  const auto first_after = static_cast<double>(reference);
  AreBefore before;
  for (std::size_t i = 0; i < before.size(); ++i) {
    before[i] = indices[i] < first_after ? 1 : 0;
  }
  return before;
}

// On which sides of the reference the nodes of a group lie.
struct SidesOf {
  SidesOf(const AreBefore& before, std::size_t count, std::size_t first) {
    const std::size_t last = std::min(count, first + NodeBlock::kGroupSize);
    std::size_t number = 0;
    for (std::size_t i = first; i < last; ++i) number += before[i];
    has_before = number > 0;
    has_after = number < last - first;
  }
  bool operator==(const SidesOf& other) const {
    return has_before == other.has_before && has_after == other.has_after;
  }

  bool has_before;
  bool has_after;
};

template <int D>
void CopyDifference(const DifferenceBlock& from, std::size_t i,
                    DifferenceBlock* to) {
  for (std::size_t r = 0; r < D; ++r) {
    to->difference[r][i] = from.difference[r][i];
  }
  for (std::size_t entry = 0; entry < D * (D + 1) / 2; ++entry) {
    to->covariance[entry][i] = from.covariance[entry][i];
  }
}

}  // namespace

template <int D>
Differences<D>::Differences(const Query& query, const History& history,
                            const SimilarityModel& model,
                            const std::optional<ConfirmedLoop>& last_confirmed)
    : query_(query),
      history_(history),
      model_(model),
      has_closed_form_(model.correlation.noise().has_closed_form()),
      next_(query.node) {
  if (!has_closed_form_) return;
  kernel_query_ = MakeKernelQuery(query.graph, model_, query.node);
  if (last_confirmed) {
    if (const auto known =
            KnownDrift<D>::Make(query, model_, *last_confirmed)) {
      known_drift_ = known->Terms();
    }
  }
}

template <int D>
Differences<D>::Differences(const Query& query, const History& history,
                            const SimilarityModel& model,
                            const FrameRelation& tie, double fixed_scale)
    : query_(query),
      history_(history),
      model_(model),
      has_closed_form_(true),
      next_(query.node),
      is_tied_(true) {
  MakeTied(FramePair<D>(history.relation.frames(), tie, query.node,
                        model.inflation, fixed_scale));
}

template <int D>
Differences<D>::Differences(const Query& query, const History& history,
                            const SimilarityModel& model,
                            const ShownDrift<D>& shown)
    : query_(query),
      history_(history),
      model_(model),
      has_closed_form_(true),
      next_(query.node),
      is_tied_(true),
      bridge_(shown.Bridge()) {
  MakeTied(
      FramePair<D>(shown.nodes(), shown.tie(), query.node, model.inflation));
  // The reference itself, of which both hold, has nothing of the drift yet.
  ++reference_;
}

template <int D>
void Differences<D>::MakeTied(const FramePair<D>& pair) {
  MakeTied(pair, /*is_before=*/true, &before_);
  MakeTied(pair, /*is_before=*/false, &after_);
  reference_ = pair.reference();
}

template <int D>
void Differences<D>::MakeTied(const FramePair<D>& pair, bool is_before,
                              Tied* tied) const {
  KernelQuery& query = tied->query;
  query.pose = pair.query();
  query.covariance = ToCovariance<D>(pair.own());
  query.state_space = model_.state_space;
  query.opposite = model_.direction == Direction::kOpposite;
  query.position_variance =
      model_.tolerance.position_meters * model_.tolerance.position_meters;
  query.heading_variance =
      model_.tolerance.heading_radians * model_.tolerance.heading_radians;
  TiedTerms& terms = tied->terms;
  terms.node_scale = pair.node_scale(is_before);
  terms.x = pair.place().x;
  terms.y = pair.place().y;
  FillRows<D>(pair.swung(is_before), terms.swung);
}

template <int D>
void Differences<D>::FindTied(const NodeBlock& nodes, const NodeBlock& next,
                              NodeIndex first, const BlockColumn* indices,
                              std::size_t count,
                              DifferenceBlock* differences) const {
  BlockColumn own;
  if (indices == nullptr) own = IndicesFrom(first);
  const BlockColumn& all = indices == nullptr ? own : *indices;
  const AreBefore before = FindBefore(all, reference_);
  // Groups that hold nodes before the reference, others, or both, are found in
  // runs.
  EntryRange run;
  for (; run.first < count; run.first = run.last) {
    const SidesOf sides(before, count, run.first);
    run.last = run.first + NodeBlock::kGroupSize;
    while (run.last < count && SidesOf(before, count, run.last) == sides) {
      run.last += NodeBlock::kGroupSize;
    }
    if (!sides.has_after) {
      FindSide(before_, nodes, next, run, differences);
      continue;
    }
    FindSide(after_, nodes, next, run, differences);
    if (bridge_) {
      TakeKnownDrift(*bridge_, model_.state_space, nodes, all, differences,
                     run);
    }
    if (!sides.has_before) continue;
    DifferenceBlock of_before;
    of_before.count = differences->count;
    FindSide(before_, nodes, next, run, &of_before);
    for (std::size_t i = run.first; i < std::min(run.last, count); ++i) {
      if (before[i] != 0) CopyDifference<D>(of_before, i, differences);
    }
  }
}

template <int D>
void Differences<D>::FindSide(const Tied& tied, const NodeBlock& nodes,
                              const NodeBlock& next, const EntryRange& range,
                              DifferenceBlock* differences) const {
  KernelQuery query = tied.query;
  query.tied = &tied.terms;
  FindDifferences(query, nodes, next, nullptr, differences, range);
}

template <int D>
void Differences<D>::Find(std::size_t k, std::size_t count, std::size_t next,
                          DifferenceBlock* differences) {
  differences->count = count;
  if (is_tied_) {
    const PoseGraph& graph = history_.graph;
    FindTied(graph.block(k), graph.block(next),
             static_cast<NodeIndex>(k * NodeBlock::kSize), nullptr, count,
             differences);
  } else if (!has_closed_form_) {
    FindFiltered(k, count, differences);
  } else {
    alignas(64) BlockShares shares;
    const bool shared =
        history_.relation.FindShares(query_, model_.correlation, k, &shares);
    const PoseGraph& graph = history_.graph;
    FindDifferences(kernel_query_, graph.block(k), graph.block(next),
                    shared ? &shares : nullptr, differences);
    if (known_drift_) {
      TakeKnownDrift(*known_drift_, model_.state_space, graph.block(k),
                     IndicesFrom(static_cast<NodeIndex>(k * NodeBlock::kSize)),
                     differences);
    }
  }
  const auto clear_rest = [count](BlockColumn& column) {
    std::fill(column.begin() + static_cast<int>(count), column.end(), 0.0);
  };
  for (BlockColumn& column : differences->difference) clear_rest(column);
  for (BlockColumn& column : differences->covariance) clear_rest(column);
}

template <int D>
void Differences<D>::FindAmong(const NodeBlock& nodes,
                               const BlockColumn& indices, std::size_t count,
                               DifferenceBlock* differences) {
  differences->count = count;
  assert(model_.correlation.noise().neighbours_err_alike);
  if (is_tied_) {
    FindTied(nodes, nodes, 0, &indices, count, differences);
    return;
  }
  FindDifferences(kernel_query_, nodes, nodes, nullptr, differences);
  if (known_drift_) {
    TakeKnownDrift(*known_drift_, model_.state_space, nodes, indices,
                   differences);
  }
}

template <int D>
void Differences<D>::FindFiltered(std::size_t k, std::size_t count,
                                  DifferenceBlock* differences) {
  const auto first = static_cast<NodeIndex>(k * NodeBlock::kSize);
  const Pose query_pose = query_.graph.pose(query_.node);
  const StateMatrix<D> query_covariance =
      ToMatrix<D>(query_.graph.covariance(query_.node));
  for (std::size_t i = count; i-- > 0;) {
    const NodeIndex j = first + static_cast<NodeIndex>(i);
    CarryBackTo(j);
    const Node node = history_.graph.node(j);
    const StateMatrix<D> covariance = ToleratedCovariance<D>(
        model_, DifferenceCovariance<D>(ToMatrix<D>(node.covariance),
                                        query_covariance, back_.psi()));
    const StateVector<D> difference = ToVector<D>(
        history_.relation.Difference(model_, query_pose, node.pose));
    std::size_t entry = 0;
    for (int r = 0; r < D; ++r) {
      differences->difference[static_cast<std::size_t>(r)][i] = difference(r);
      for (int c = 0; c <= r; ++c) {
        differences->covariance[entry++][i] = covariance(r, c);
      }
    }
  }
}

// One product of transitions runs backward from the query past every node.
template <int D>
void Differences<D>::CarryBackTo(NodeIndex j) {
  for (; next_ > j && !back_.decorrelated(); --next_) {
    back_.GoBack(history_.relation.TransitionTowards(query_, next_));
  }
}

template class Differences<3>;
template class Differences<4>;

}  // namespace revisit::core
