// The worth of a look at a candidate: by how much the positions of a whole
// drive would become surer if its two nodes were confirmed to be one place.
//
// The value of a candidate is its probability times this reduction: of the
// looks that one can afford, those come first that are expected to take the
// most variance away. An order by probability alone asks again and again for
// what the last closure has shown already.
//
// Under dead reckoning, with z = e_q - e_m the difference of the errors of the
// query q and the matched node m, that a closure shows up to the tolerance R_z,
// the errors of node i lose
//
//   g_i = tr_xy[ X_i (Gamma_qm + R_z)^-1 X_i^T ],   X_i = S_iq - S_im,
//
// the update of a Kalman filter: tr_xy is the trace over x and y, S_ij the
// cross-covariance of two nodes and Gamma_qm the covariance of z, all given
// what the nearest confirmed closures have shown (known_drift.h).
#ifndef REVISIT_CORE_SEARCH_CANDIDATES_VALUE_H_
#define REVISIT_CORE_SEARCH_CANDIDATES_VALUE_H_

#include <memory>
#include <optional>
#include <vector>

#include "core/drive/node_index.h"

namespace revisit::core {

struct ConfirmedLoop;
class Drive;

// The reductions of pairs of one drive's nodes. What pairs have in common is
// read at the first one and kept, so whoever asks about several keeps this.
// Thread-compatible.
class VarianceReductions {
 public:
  // The drive must outlive this, and stay as it is.
  explicit VarianceReductions(const Drive& drive);
  ~VarianceReductions();

  VarianceReductions(const VarianceReductions&) = delete;
  VarianceReductions& operator=(const VarianceReductions&) = delete;

  // The mean of g_i over the drive's nodes, m^2, at least 0: over some 256 of
  // them, evenly taken. Nodes of other recordings lose nothing by it, and
  // count.
  //
  // R_z is kConfirmedTolerance. Covariances are those claimed, scaled by the
  // drive's mean inflation (Drive::SimilarityOf() of its own options). Of the
  // confirmed closures within the recording, two count: the last whose later
  // node is at or before the query, and the first whose later node is behind
  // it. Where others have removed more of the variance, the reduction is
  // overstated.
  //
  // Returns 0 where closures show no drift (NoiseModel::closures_show_drift),
  // where the two nodes are of different recordings, and where the covariances
  // are not those of dead reckoning, or ill-conditioned, so that the formula
  // does not hold. O(256), and O(confirmed closures) where the query is another
  // one than before: some us, and tens of us beside a few thousand closures.
  // REQUIRES: both nodes are in the graph.
  double Of(NodeIndex query, NodeIndex matched);

  // For the implementation alone.
  struct MeanNodes;

 private:
  const Drive& drive_;
  // Null until it is needed.
  std::unique_ptr<MeanNodes> mean_nodes_;
  // The closures that count for this query.
  std::optional<NodeIndex> nearest_to_;
  std::vector<const ConfirmedLoop*> nearest_;
};

}  // namespace revisit::core

#endif  // REVISIT_CORE_SEARCH_CANDIDATES_VALUE_H_
