// A confirmed loop closure, and what a verifier measured between its poses.
//
// The measurement u says where the true query pose q lies in the levelled axes
// of the true matched pose m, up to an error n of covariance M:
//
//   q = m + R(h_m) (u - n),    R(a) the turn about z by a, heading added.
//
// With estimates that have the errors e, the innovation
// y = q^ - (m^ + R(h^_m) u) is, to first order,
//
//   y = e_q - L e_m - R n,
//
// where L is the identity but for the column of heading: the error of the
// matched pose's heading swings the query pose about it, with the lever arm
// J R u, J the turn by a right angle. L e_m is the error of dead reckoning from
// m by a step R u without noise. So the pose m^ + R u with the covariance
// L S_mm L^T takes the place of the matched pose wherever errors are those of
// dead reckoning; lever arms add up, which makes its cross-covariances right
// too.
#ifndef REVISIT_CORE_DRIVE_CONFIRMED_LOOP_H_
#define REVISIT_CORE_DRIVE_CONFIRMED_LOOP_H_

#include <cstdint>
#include <memory>

#include "core/drive/measured_loop.h"
#include "core/drive/pose_graph.h"
#include "core/geometry/pose.h"
#include "core/geometry/state_matrix.h"
#include "core/noise/comparison.h"
#include "core/noise/noise_model.h"

namespace revisit::core {

// R_c where nothing was measured: a verifier confirms that two poses are at one
// place, which is some 10 m wide (two standard deviations), but not how they
// lie to each other.
inline constexpr PlaceTolerance kConfirmedTolerance{5.0, 0.15};

struct ConfirmedLoop {
  // The last nodes at or before the two poses.
  NodeIndex query = 0;
  NodeIndex matched = 0;
  // Null where nothing was measured.
  std::shared_ptr<const MeasuredLoop> measured = nullptr;
};

// A confirmed loop with the two poses of which it was told.
struct ConfirmedPair {
  std::uint64_t query_sequence = 0;
  std::uint64_t matched_sequence = 0;
  ConfirmedLoop loop;
};

// The direction in which a loop was closed, judged by the headings.
Direction DirectionOf(const PoseGraph& graph, const ConfirmedLoop& loop);

// m^ + R u, with L S_mm L^T.
template <int D>
PoseEstimate CarriedToQuery(const MeasuredLoop& loop);

// R M R^T: the measurement's covariance in the axes of the local frame.
template <int D>
StateMatrix<D> MeasurementCovariance(const MeasuredLoop& loop);

// y, and its claimed covariance without that of the measurement: Gamma, with
// the lever arm.
template <int D>
struct Innovation {
  StateVector<D> difference;
  StateMatrix<D> gamma;
};

// Covariances are those of the poses; where Gamma has no closed form, whose
// transitions lead from node to node, those of the nodes. O(1), there O(nodes
// between the two). REQUIRES: the loop was measured; the matched node is not
// after the query's.
template <int D>
Innovation<D> InnovationOf(const PoseGraph& graph,
                           const Correlation& correlation,
                           const ConfirmedLoop& loop);

}  // namespace revisit::core

#endif  // REVISIT_CORE_DRIVE_CONFIRMED_LOOP_H_
