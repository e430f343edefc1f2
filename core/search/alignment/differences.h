// The differences of the query and the history under any correlation model, as
// their relation has them (relation.h), block by block: what the similarity
// kernel evaluates.
#ifndef REVISIT_CORE_SEARCH_ALIGNMENT_DIFFERENCES_H_
#define REVISIT_CORE_SEARCH_ALIGNMENT_DIFFERENCES_H_

#include <cstddef>
#include <optional>

#include "core/drive/confirmed_loop.h"
#include "core/drive/frame_relation.h"
#include "core/drive/pose_graph.h"
#include "core/geometry/pose.h"
#include "core/noise/filter.h"
#include "core/noise/similarity_model.h"
#include "core/search/alignment/history.h"
#include "core/search/alignment/known_drift.h"
#include "core/search/alignment/log_similarity.h"
#include "core/search/alignment/query.h"
#include "core/search/alignment/shown_drift.h"
#include "core/search/alignment/similarity_kernel.h"

namespace revisit::core {

template <int D>
class Differences {
 public:
  // `last_confirmed`: the loop closure that has shown the drift, or nothing.
  // REQUIRES: all outlive this, and their graphs do not change; last_confirmed
  // where NoiseModel::closures_show_drift only.
  Differences(const Query& query, const History& history,
              const SimilarityModel& model,
              const std::optional<ConfirmedLoop>& last_confirmed);
  // The same as marks have shown the drift.
  Differences(const Query& query, const History& history,
              const SimilarityModel& model, const ShownDrift<D>& shown);
  // The same for another recording whose frame is tied like this, with the
  // variances of its own error times `fixed_scale`.
  Differences(const Query& query, const History& history,
              const SimilarityModel& model, const FrameRelation& tie,
              double fixed_scale);

  // Finds the differences of the first `count` nodes of block k; the other
  // entries are 0. `next` is the block that will be asked for after it,
  // which is fetched on the way. REQUIRES: where the noise model has no closed
  // form, k falls from call to call.
  void Find(std::size_t k, std::size_t count, std::size_t next,
            DifferenceBlock* differences);

  // Finds the differences of nodes from anywhere in the history, the first
  // `count` of a block that they were copied to. REQUIRES:
  // NoiseModel::neighbours_err_alike.
  void FindAmong(const NodeBlock& nodes, const BlockColumn& indices,
                 std::size_t count, DifferenceBlock* differences);

 private:
  // How nodes before the reference of the two frames are compared, and the
  // others.
  struct Tied {
    KernelQuery query;
    TiedTerms terms;
  };

  void MakeTied(const FramePair<D>& pair);
  void MakeTied(const FramePair<D>& pair, bool is_before, Tied* tied) const;
  // Finds the differences of the nodes [first, first + count) of the graph, or
  // of as many with these indices.
  void FindTied(const NodeBlock& nodes, const NodeBlock& next, NodeIndex first,
                const BlockColumn* indices, std::size_t count,
                DifferenceBlock* differences) const;
  void FindSide(const Tied& tied, const NodeBlock& nodes, const NodeBlock& next,
                const EntryRange& range, DifferenceBlock* differences) const;
  void FindFiltered(std::size_t k, std::size_t count,
                    DifferenceBlock* differences);
  void CarryBackTo(NodeIndex j);

  const Query& query_;
  const History& history_;
  const SimilarityModel model_;
  const bool has_closed_form_;
  // Where it has one, in the query's own recording.
  KernelQuery kernel_query_;
  std::optional<KnownDriftTerms> known_drift_;
  // Where it has none: Psi(query, next_).
  BackwardTransition<D> back_;
  NodeIndex next_;
  // In another recording, and where the drift is shown: nodes before the
  // reference, and the others, with what else is known of these.
  bool is_tied_ = false;
  Tied before_;
  Tied after_;
  NodeIndex reference_ = 0;
  std::optional<KnownDriftTerms> bridge_;
};

}  // namespace revisit::core

#endif  // REVISIT_CORE_SEARCH_ALIGNMENT_DIFFERENCES_H_
