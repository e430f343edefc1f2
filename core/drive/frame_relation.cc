#include "core/drive/frame_relation.h"

#include <Eigen/Cholesky>
#include <algorithm>
#include <cassert>
#include <cmath>

#include "core/geometry/frame_transform.h"
#include "core/geometry/heading.h"
#include "core/geometry/quadratic_form.h"
#include "core/noise/chi_squared.h"
#include "core/noise/dead_reckoning.h"
#include "core/noise/similarity_model.h"

namespace revisit::core {
namespace {

// A closure whose innovation is improbable to this degree contradicts the
// relation.
constexpr double kAgreement = 0.99;

// Headings that are less sure than this do not say in which direction a place
// was passed, rad.
constexpr double kLeastSureHeading = 0.8;

// A matrix of four coordinates, which is symmetric, as one of D.
template <int D>
StateMatrix<D> Reduced(const StateMatrix<4>& matrix) {
  return ToMatrix<D>(ToCovariance<4>(matrix));
}

// S of a node; its rows and columns of z are 0 for PLANAR.
StateMatrix<4> CovarianceAt(const PoseGraph& graph, NodeIndex i) {
  return ToMatrix<4>(graph.covariance(i));
}

// Q(g, i): how a node errs given the reference, or by itself.
StateMatrix<4> ErrorSince(const PoseGraph& graph,
                          const std::optional<NodeIndex>& reference,
                          NodeIndex i) {
  const StateMatrix<4> own = CovarianceAt(graph, i);
  if (!reference) return own;
  const StateMatrix<4> carried = Swung<4>(
      CovarianceAt(graph, *reference), graph.pose(*reference), graph.pose(i));
  if (i >= *reference) return own - carried;
  return carried - own;
}

double Squared(double scale) { return scale * scale; }

// Swung() and Turned() of a part of an error: most relations lack most parts.
StateMatrix<4> SwungPart(const StateMatrix<4>& part, const Pose& earlier,
                         const Pose& later) {
  return part.isZero(0.0) ? part : Swung<4>(part, earlier, later);
}
StateMatrix<4> TurnedPart(const StateMatrix<4>& part, double angle) {
  return part.isZero(0.0) ? part : Turned<4>(part, angle);
}

// P.
StateMatrix<4> ErrorOf(const FrameRelation& relation, double fixed_scale,
                       double drift_scale) {
  return fixed_scale * relation.fixed + Squared(drift_scale) * relation.drift +
         relation.known_drift;
}

// S of a node, scaled.
template <int D>
StateMatrix<D> Scaled(const FrameNodes& nodes, NodeIndex i,
                      double drift_scale) {
  return Squared(nodes.ScaleOr(drift_scale)) *
         ToMatrix<D>(nodes.graph.covariance(i));
}

}  // namespace

FrameRelation Reversed(const FrameNodes& nodes, const FrameRelation& relation) {
  FrameRelation reversed = relation;
  if (!relation.is_tied()) return reversed;
  reversed.transform = Inverse(relation.transform);
  reversed.asking_node = relation.other_node;
  reversed.other_node = relation.asking_node;
  const Pose at = Compose(relation.transform, relation.place);
  reversed.place =
      relation.asking_node ? nodes.graph.pose(*relation.asking_node) : at;
  for (StateMatrix<4>* part :
       {&reversed.fixed, &reversed.drift, &reversed.known_drift}) {
    *part = TurnedPart(SwungPart(*part, at, reversed.place),
                       -relation.transform.heading);
  }
  return reversed;
}

FrameRelation Compose(const FrameNodes& nodes, const FrameRelation& to_v,
                      const FrameRelation& from_v) {
  FrameRelation composed;
  if (!to_v.is_tied() || !from_v.is_tied()) return composed;
  // A chain is no surer than its least sure part.
  composed.state = std::max(to_v.state, from_v.state);
  const double turn = to_v.transform.heading;
  composed.transform = Compose(to_v.transform, from_v.transform);
  composed.place = from_v.place;
  composed.asking_node = to_v.asking_node;
  composed.other_node = from_v.other_node;
  const Pose at = Compose(composed.transform, composed.place);
  const Pose before = Compose(to_v.transform, to_v.place);
  composed.fixed =
      SwungPart(to_v.fixed, before, at) + TurnedPart(from_v.fixed, turn);
  composed.drift =
      SwungPart(to_v.drift, before, at) + TurnedPart(from_v.drift, turn);
  composed.known_drift = SwungPart(to_v.known_drift, before, at) +
                         TurnedPart(from_v.known_drift, turn);
  if (to_v.other_node && from_v.asking_node) {
    const Pose leaving =
        Compose(to_v.transform, nodes.graph.pose(*from_v.asking_node));
    const StateMatrix<4> added = Swung<4>(
        Turned<4>(ErrorSince(nodes.graph, to_v.other_node, *from_v.asking_node),
                  turn),
        leaving, at);
    if (nodes.known_scale) {
      composed.known_drift += (*nodes.known_scale * *nodes.known_scale) * added;
    } else {
      composed.drift += added;
    }
  }
  return composed;
}

template <int D>
StateMatrix<D> MeasuredFromQuery(const MeasuredLoop& loop,
                                 const Pose& matched_from_query) {
  return Swung<D>(Turned<D>(ToMatrix<D>(loop.measurement.covariance),
                            matched_from_query.heading),
                  loop.query.pose, matched_from_query);
}

double MostOfAgreeing(int degrees_of_freedom) {
  static const double kPlanar = ChiSquaredQuantile(3.0, kAgreement);
  static const double kSpatial = ChiSquaredQuantile(4.0, kAgreement);
  return degrees_of_freedom == 3 ? kPlanar : kSpatial;
}

template <int D>
StateMatrix<D> ErrorOfMatched(const RelatedFrames& frames,
                              const FrameRelation& relation,
                              const ConfirmedLoop& loop, double drift_scale) {
  const FramePair<D> pair(frames, relation, loop.query, drift_scale);
  return Turned<D>(
      pair.Covariance(loop.matched, frames.other.graph.pose(loop.matched),
                      ToMatrix<D>(frames.other.graph.covariance(loop.matched))),
      relation.transform.heading);
}

template <int D>
void Correct(const Pose& matched, const Pose& placed,
             const StateVector<D>& innovation, const StateMatrix<D>& prior,
             const StateMatrix<D>& sum, FrameRelation* relation) {
  const StateMatrix<D> gain =
      Eigen::LDLT<StateMatrix<D>>(sum).solve(prior).transpose();
  const StateVector<D> moved = gain * innovation;
  Pose corrected = placed;
  corrected.x += moved(0);
  corrected.y += moved(1);
  if (D == 4) corrected.z += moved(D - 2);
  corrected.heading = WrapHeading(corrected.heading + moved(D - 1));
  relation->transform = Compose(corrected, Inverse(matched));
  relation->fixed =
      ToMatrix<4>(ToCovariance<D>(Symmetric<D>(prior - gain * prior)));
}

namespace {

// The matched pose in u as the closure has it, and the covariance of that.
template <int D>
struct SeenFromQuery {
  Pose pose;
  StateMatrix<D> covariance = StateMatrix<D>::Zero();
};

template <int D>
SeenFromQuery<D> SeeFromQuery(const RelatedFrames& frames,
                              const FrameRelation& relation,
                              const ConfirmedLoop& loop, double drift_scale) {
  SeenFromQuery<D> seen;
  if (loop.measured) {
    seen.pose = Compose(loop.measured->query.pose,
                        Inverse(loop.measured->measurement.relative));
    seen.covariance = MeasuredFromQuery<D>(*loop.measured, seen.pose);
    return seen;
  }
  seen.pose = frames.asking.graph.pose(loop.query);
  AddTolerance<D>(kConfirmedTolerance, &seen.covariance);
  if (!relation.is_tied()) return seen;
  const double sure = ErrorOf(relation, 1.0, drift_scale)(3, 3);
  const double turn = seen.pose.heading - relation.transform.heading -
                      frames.other.graph.pose(loop.matched).heading;
  if (sure < kLeastSureHeading * kLeastSureHeading &&
      std::abs(WrapHeading(turn)) > 0.5 * kPi) {
    seen.pose.heading = WrapHeading(seen.pose.heading + kPi);
  }
  return seen;
}

Pose MatchedPose(const RelatedFrames& frames, const ConfirmedLoop& loop) {
  return loop.measured ? loop.measured->matched.pose
                       : frames.other.graph.pose(loop.matched);
}

// The relation of the closure alone.
template <int D>
FrameRelation TiedAnew(const RelatedFrames& frames, const ConfirmedLoop& loop,
                       const SeenFromQuery<D>& seen, double drift_scale) {
  FrameRelation tied;
  tied.state = FrameState::kProvisional;
  tied.links = 1;
  tied.transform = Compose(seen.pose, Inverse(MatchedPose(frames, loop)));
  tied.place = frames.other.graph.pose(loop.matched);
  StateMatrix<D> error = seen.covariance;
  if (frames.asking.have_references()) {
    tied.asking_node = loop.query;
    tied.other_node = loop.matched;
  } else {
    error += Scaled<D>(frames.asking, loop.query, drift_scale) +
             Turned<D>(Scaled<D>(frames.other, loop.matched, drift_scale),
                       tied.transform.heading);
  }
  tied.fixed = ToMatrix<4>(ToCovariance<D>(error));
  return tied;
}

template <int D>
FrameRelation TiedIn(const RelatedFrames& frames, const FrameRelation& relation,
                     const ConfirmedLoop& loop, double drift_scale) {
  const SeenFromQuery<D> seen =
      SeeFromQuery<D>(frames, relation, loop, drift_scale);
  if (!relation.is_tied()) return TiedAnew<D>(frames, loop, seen, drift_scale);
  const Pose matched = MatchedPose(frames, loop);
  const Pose placed = Compose(relation.transform, matched);
  const StateVector<D> innovation = ToVector<D>(Difference(seen.pose, placed));
  const StateMatrix<D> gamma =
      ErrorOfMatched<D>(frames, relation, loop, drift_scale);
  const StateMatrix<D> sum = gamma + seen.covariance;
  const auto distance = Evaluate<D>(sum, innovation);
  const bool contradicts =
      !distance || distance->squared_mahalanobis > MostOfAgreeing(D);
  if (contradicts) {
    const bool has_links = relation.state == FrameState::kProvisional ||
                           relation.state == FrameState::kKnown;
    return has_links ? relation : TiedAnew<D>(frames, loop, seen, drift_scale);
  }
  // Where errors are absolute, those of the two poses are noise of the closure;
  // else they are part of what is learned.
  StateMatrix<D> prior = gamma;
  if (!frames.asking.have_references()) {
    const Pose at = Compose(relation.transform, relation.place);
    prior =
        Swung<D>(Reduced<D>(ErrorOf(relation, 1.0, drift_scale)), at, placed);
  }
  FrameRelation tied;
  Correct<D>(matched, placed, innovation, prior, sum, &tied);
  tied.links = relation.links + 1;
  tied.state = tied.links >= kConsistentLinks ? FrameState::kKnown
                                              : FrameState::kProvisional;
  tied.place = frames.other.graph.pose(loop.matched);
  if (frames.asking.have_references()) {
    tied.asking_node = loop.query;
    tied.other_node = loop.matched;
  }
  return tied;
}

}  // namespace

FrameRelation TiedBy(const RelatedFrames& frames, const FrameRelation& relation,
                     const ConfirmedLoop& loop, double drift_scale) {
  return frames.asking.state_space == StateSpace::kPlanar
             ? TiedIn<3>(frames, relation, loop, drift_scale)
             : TiedIn<4>(frames, relation, loop, drift_scale);
}

template <int D>
std::optional<Innovation<D>> InnovationAcross(const RelatedFrames& frames,
                                              const FrameRelation& relation,
                                              const ConfirmedLoop& loop,
                                              double drift_scale) {
  assert(loop.measured != nullptr);
  if (!relation.is_tied()) return std::nullopt;
  const SeenFromQuery<D> seen =
      SeeFromQuery<D>(frames, relation, loop, drift_scale);
  Innovation<D> innovation;
  innovation.difference = ToVector<D>(Difference(
      seen.pose, Compose(relation.transform, MatchedPose(frames, loop))));
  innovation.gamma = ErrorOfMatched<D>(frames, relation, loop, drift_scale);
  return innovation;
}

template <int D>
FramePair<D>::FramePair(const RelatedFrames& frames,
                        const FrameRelation& relation, NodeIndex query,
                        double drift_scale, double fixed_scale)
    : query_(Compose(Inverse(relation.transform),
                     frames.asking.graph.pose(query))),
      node_scale_(Squared(frames.other.ScaleOr(drift_scale))),
      place_(relation.place),
      reference_(relation.other_node.value_or(0)) {
  assert(relation.is_tied());
  const double back = -relation.transform.heading;
  own_ = Squared(frames.asking.ScaleOr(drift_scale)) *
         Turned<D>(Reduced<D>(ErrorSince(frames.asking.graph,
                                         relation.asking_node, query)),
                   back);
  const StateMatrix<D> transform =
      Turned<D>(Reduced<D>(ErrorOf(relation, fixed_scale, drift_scale)), back);
  before_ = after_ = transform;
  if (relation.other_node) {
    const StateMatrix<D> reference =
        Scaled<D>(frames.other, *relation.other_node, drift_scale);
    before_ += reference;
    after_ -= reference;
  }
}

template <int D>
StateMatrix<D> FramePair<D>::Covariance(
    NodeIndex j, const Pose& pose, const StateMatrix<D>& covariance) const {
  const bool is_before = j < reference_;
  return own_ + node_scale(is_before) * covariance +
         Swung<D>(swung(is_before), place_, pose);
}

template class FramePair<3>;
template class FramePair<4>;
template StateMatrix<3> ErrorOfMatched<3>(const RelatedFrames&,
                                          const FrameRelation&,
                                          const ConfirmedLoop&, double);
template StateMatrix<4> ErrorOfMatched<4>(const RelatedFrames&,
                                          const FrameRelation&,
                                          const ConfirmedLoop&, double);
template void Correct<3>(const Pose&, const Pose&, const StateVector<3>&,
                         const StateMatrix<3>&, const StateMatrix<3>&,
                         FrameRelation*);
template void Correct<4>(const Pose&, const Pose&, const StateVector<4>&,
                         const StateMatrix<4>&, const StateMatrix<4>&,
                         FrameRelation*);
template StateMatrix<3> MeasuredFromQuery<3>(const MeasuredLoop&, const Pose&);
template StateMatrix<4> MeasuredFromQuery<4>(const MeasuredLoop&, const Pose&);
template std::optional<Innovation<3>> InnovationAcross<3>(const RelatedFrames&,
                                                          const FrameRelation&,
                                                          const ConfirmedLoop&,
                                                          double);
template std::optional<Innovation<4>> InnovationAcross<4>(const RelatedFrames&,
                                                          const FrameRelation&,
                                                          const ConfirmedLoop&,
                                                          double);

}  // namespace revisit::core
