// Where the frame of one recording lies in that of another, with its error.
//
// Let u be the asking frame and v the other one, T the pose of v in u. With x
// the estimates, e their errors and m a node of v, the error of T is known at
// the place T x_m: a shift and a turn of the covariance P, in the axes of u.
// Farther away, the turn swings: at T x_j the covariance is L P L^T, with L the
// identity but for the column of heading, which is J (T x_j - T x_m) in x and
// y, J the turn by a right angle.
//
// Errors of T and of the poses must not count twice. Under dead reckoning P
// holds between two reference nodes, c of u and m of v, and poses err by what
// drift has added since these:
//
//   Q(g, i) = + (S_i - Psi S_g Psi^T)   i after g
//             - (S_i - Psi S_g Psi^T)   i before g,   Psi = Psi(i, g),
//
// where Psi is a lever arm too (dead_reckoning.h). Other models have no
// references: Q(i) = S_i. Errors of two frames are independent but for T, so
// the difference of node q of u and node j of v has the covariance
//
//   Gamma_qj = L_j P L_j^T + Q_u(c, q) + R Q_v(m, j) R^T,
//
// R the turn of T: to first order exact where the two are at one place. In the
// axes of v, with the inverse turn left out of the names, it is of the closed
// form
//
//   C + s S_j + L_j M L_j^T,
//
// where C is the part of the query, s = 1 and M = P - S_m for j after m, and
// s = -1 and M = P + S_m before it; without references, s = 1 and M = P. Along
// the line from j to the query, L_j acts as L at the query's own place does:
// regions of possible ends depend on the node by S_j alone.
//
// The frames may lie in two drives, whose claims have scales of their own: with
// f_u and f_v, variances are those of Q_u times f_u^2 and of Q_v and S_v times
// f_v^2. That of the asking drive is what a search supposes; that of any other
// drive is what it has shown itself. P has neither.
#ifndef REVISIT_CORE_DRIVE_FRAME_RELATION_H_
#define REVISIT_CORE_DRIVE_FRAME_RELATION_H_

#include <optional>

#include "core/drive/confirmed_loop.h"
#include "core/drive/frame_state.h"
#include "core/drive/node_index.h"
#include "core/drive/pose_graph.h"
#include "core/geometry/pose.h"
#include "core/geometry/state_matrix.h"
#include "core/noise/comparison.h"
#include "core/noise/noise_model.h"

namespace revisit::core {

struct FrameRelation {
  FrameState state = FrameState::kNone;
  // T.
  Pose transform;
  // P is `fixed` plus what poses of frames between the two have added: `drift`
  // scales with the errors of the asking drive's poses, as S does, and
  // `known_drift` is that of other drives, at their own scales. Rows and
  // columns of z are 0 for PLANAR.
  StateMatrix<4> fixed = StateMatrix<4>::Zero();
  StateMatrix<4> drift = StateMatrix<4>::Zero();
  StateMatrix<4> known_drift = StateMatrix<4>::Zero();
  // Where P holds, in v's frame: the pose of m, where there is one.
  Pose place;
  // c and m; nothing where errors are absolute.
  std::optional<NodeIndex> asking_node;
  std::optional<NodeIndex> other_node;
  // How many confirmed loops in a row tie the two frames directly.
  int links = 0;

  bool is_tied() const { return state != FrameState::kNone; }
};

// The frames of a drive: what relations are made from.
struct FrameNodes {
  const PoseGraph& graph;
  StateSpace state_space = StateSpace::kPlanar;
  Correlation correlation;
  // The scale of standard deviations that the drive has shown; nothing for the
  // one that asks.
  std::optional<double> known_scale = std::nullopt;

  // Whether poses err by what was added since a reference.
  bool have_references() const {
    return correlation.noise().form == DifferenceForm::kGrown;
  }
  double ScaleOr(double supposed) const {
    return known_scale.value_or(supposed);
  }
};

// The frames of the two drives that a relation is of, which may be one. Both
// have one state space and one noise model.
struct RelatedFrames {
  // NOLINTNEXTLINE(google-explicit-constructor): one drive is such a pair.
  RelatedFrames(const FrameNodes& both) : asking(both), other(both) {}
  RelatedFrames(const FrameNodes& of_asking, const FrameNodes& of_other)
      : asking(of_asking), other(of_other) {}

  bool are_of_one_drive() const { return &asking.graph == &other.graph; }

  FrameNodes asking;
  FrameNodes other;
};

// The relation as v sees it: the frame u in v. `nodes`: those of u.
FrameRelation Reversed(const FrameNodes& nodes, const FrameRelation& relation);

// The relation of u to w, from those of u to v and of v to w. `nodes`: those of
// v.
FrameRelation Compose(const FrameNodes& nodes, const FrameRelation& to_v,
                      const FrameRelation& from_v);

// The relation after a loop closure between a node of u and a node of v, in
// this order: Kalman's update of T x_m, and references at the loop's own nodes.
// Where the two are not tied yet, the closure alone is the relation. A closure
// that contradicts the relation (its innovation is beyond what one in a hundred
// true ones has) replaces one that no closure has tied, and changes nothing
// else. `drift_scale` multiplies standard deviations of drift, as everywhere
// below, where the drive has no known scale.
FrameRelation TiedBy(const RelatedFrames& frames, const FrameRelation& relation,
                     const ConfirmedLoop& loop, double drift_scale);

// The greatest squared Mahalanobis distance of an innovation that does not
// contradict a relation.
double MostOfAgreeing(int degrees_of_freedom);

// Gamma of T x_m as c sees it, in the axes of u, with T's own error and what
// the two poses have added to it. REQUIRES: the relation is tied.
template <int D>
StateMatrix<D> ErrorOfMatched(const RelatedFrames& frames,
                              const FrameRelation& relation,
                              const ConfirmedLoop& loop, double drift_scale);

// Kalman's update of T x_m: lets the relation place the pose `matched` where
// the innovation moves it from `placed`, whose error has the covariance
// `prior`; `sum` is that of the innovation.
template <int D>
void Correct(const Pose& matched, const Pose& placed,
             const StateVector<D>& innovation, const StateMatrix<D>& prior,
             const StateMatrix<D>& sum, FrameRelation* relation);

// The innovation of a measured closure of the two frames and its covariance
// without that of the measurement, in the axes of u; nothing where the frames
// are not tied.
template <int D>
std::optional<Innovation<D>> InnovationAcross(const RelatedFrames& frames,
                                              const FrameRelation& relation,
                                              const ConfirmedLoop& loop,
                                              double drift_scale);

// The covariance of a measurement of the pose of m, made from c: in the axes of
// u, at the matched pose.
template <int D>
StateMatrix<D> MeasuredFromQuery(const MeasuredLoop& loop,
                                 const Pose& matched_from_query);

// Gamma of one node of the asking frame and all nodes of the other one, in the
// other one's axes. Scaled: drift_scale multiplies standard deviations of
// poses and of what drift has added, not of T.
template <int D>
class FramePair {
 public:
  // `fixed_scale` multiplies the variances of T's own error. REQUIRES: the
  // relation is tied.
  FramePair(const RelatedFrames& frames, const FrameRelation& relation,
            NodeIndex query, double drift_scale, double fixed_scale = 1.0);

  // The query's pose in the other frame.
  const Pose& query() const { return query_; }
  // C, s for nodes after and before the reference, and M for the same.
  const StateMatrix<D>& own() const { return own_; }
  double node_scale(bool is_before) const {
    return is_before ? -node_scale_ : node_scale_;
  }
  const StateMatrix<D>& swung(bool is_before) const {
    return is_before ? before_ : after_;
  }
  // Where L is the identity.
  const Pose& place() const { return place_; }
  // Nodes before this one are before the reference; 0 where there is none.
  NodeIndex reference() const { return reference_; }

  // Gamma, of a node with this pose and covariance.
  StateMatrix<D> Covariance(NodeIndex j, const Pose& pose,
                            const StateMatrix<D>& covariance) const;

 private:
  Pose query_;
  StateMatrix<D> own_;
  double node_scale_;
  StateMatrix<D> before_;
  StateMatrix<D> after_;
  Pose place_;
  NodeIndex reference_ = 0;
};

}  // namespace revisit::core

#endif  // REVISIT_CORE_DRIVE_FRAME_RELATION_H_
