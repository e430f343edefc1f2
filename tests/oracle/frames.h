// Poses of two recordings, of one drive or of two, compared in long double by
// the definitions at the top of core/drive/frame_relation.h, in the axes of the
// asking frame: every lever arm is one from place to place there, and errors
// since a reference are those of a chain that begins at it.
#ifndef REVISIT_TESTS_ORACLE_FRAMES_H_
#define REVISIT_TESTS_ORACLE_FRAMES_H_

#include <cmath>
#include <limits>
#include <optional>
#include <utility>
#include <vector>

#include "core/drive/confirmed_loop.h"
#include "core/drive/frame_relation.h"
#include "core/drive/pose_graph.h"
#include "core/noise/chi_squared.h"
#include "tests/oracle/wide_state.h"

namespace revisit::oracle {

// A pose in long double: x, y, z, heading.
struct WidePose {
  Wide x = 0.0L;
  Wide y = 0.0L;
  Wide z = 0.0L;
  Wide heading = 0.0L;
};

inline WidePose WidePoseOf(const core::Pose& pose) {
  return {pose.x, pose.y, pose.z, pose.heading};
}

// The pose that lies at `inner` in a frame that lies at `frame`.
inline WidePose Placed(const WidePose& frame, const WidePose& inner) {
  const Wide c = std::cos(frame.heading);
  const Wide s = std::sin(frame.heading);
  return {frame.x + c * inner.x - s * inner.y,
          frame.y + s * inner.x + c * inner.y, frame.z + inner.z,
          frame.heading + inner.heading};
}

// The frame in which what is at `inner` in it lies at `outer`.
inline WidePose FrameWith(const WidePose& outer, const WidePose& inner) {
  WidePose frame;
  frame.heading = outer.heading - inner.heading;
  const Wide c = std::cos(frame.heading);
  const Wide s = std::sin(frame.heading);
  frame.x = outer.x - (c * inner.x - s * inner.y);
  frame.y = outer.y - (s * inner.x + c * inner.y);
  frame.z = outer.z - inner.z;
  return frame;
}

inline WideVector StateOf(const WidePose& pose, int d) {
  WideVector state(d);
  state(0) = pose.x;
  state(1) = pose.y;
  if (d == 4) state(2) = pose.z;
  state(d - 1) = pose.heading;
  return state;
}

// How another frame lies: its pose, and the covariance of that at the place, in
// the axes of the asking frame.
struct WideTie {
  WidePose frame;
  // In the other frame.
  WidePose place;
  WideMatrix covariance;
  std::optional<core::NodeIndex> asking_node;
  std::optional<core::NodeIndex> other_node;
};

class WideFrames {
 public:
  // Both frames are of one drive.
  WideFrames(const core::PoseGraph& graph, bool have_references, int d)
      : WideFrames(graph, graph, std::nullopt, have_references, d) {}
  // They are of two, of which the other one has a known scale.
  WideFrames(const core::PoseGraph& asking, const core::PoseGraph& other,
             std::optional<Wide> other_scale, bool have_references, int d)
      : asking_(asking),
        other_(other),
        other_scale_(other_scale),
        have_references_(have_references),
        d_(d) {}

  WideTie TieOf(const core::FrameRelation& relation, Wide drift_scale,
                Wide fixed_scale) const {
    WideTie tie;
    tie.frame = WidePoseOf(relation.transform);
    tie.place = WidePoseOf(relation.place);
    tie.covariance = WideMatrix(d_, d_);
    for (int r = 0; r < d_; ++r) {
      for (int c = 0; c < d_; ++c) {
        const int row = Coordinate(r, d_);
        const int column = Coordinate(c, d_);
        tie.covariance(r, c) =
            fixed_scale * relation.fixed(row, column) +
            drift_scale * drift_scale * relation.drift(row, column);
      }
    }
    tie.asking_node = relation.asking_node;
    tie.other_node = relation.other_node;
    return tie;
  }

  // x_q - T x_j.
  WideVector Difference(const WideTie& tie, core::NodeIndex q,
                        core::NodeIndex j) const {
    WideVector d = StateOf(PoseAt(asking_, q), d_) -
                   StateOf(Placed(tie.frame, PoseAt(other_, j)), d_);
    d(d_ - 1) = NearestTo(0.0L, d(d_ - 1));
    return d;
  }

  // Gamma.
  WideMatrix Gamma(const WideTie& tie, core::NodeIndex q, core::NodeIndex j,
                   Wide drift_scale) const {
    const WidePose at = Placed(tie.frame, PoseAt(other_, j));
    const WidePose known = Placed(tie.frame, tie.place);
    const WideMatrix lever = WideLever(at.x - known.x, at.y - known.y, d_);
    const WideMatrix turn = WideTurn(tie.frame.heading, d_);
    const Wide other_scale = other_scale_.value_or(drift_scale);
    return lever * tie.covariance * lever.transpose() +
           drift_scale * drift_scale * ErrorSince(asking_, tie.asking_node, q) +
           other_scale * other_scale * turn *
               ErrorSince(other_, tie.other_node, j) * turn.transpose();
  }

  // The tie once it is known that nodes c and m, in either direction, are at
  // one place, by so much; the closure alone where there was none, or, unless
  // closures have tied it, where the two contradict each other. Products of
  // Gaussian densities, by their information.
  WideTie KnownBy(const std::optional<WideTie>& tie, bool by_closures,
                  core::NodeIndex c, core::NodeIndex m, Wide drift_scale,
                  const WideMatrix& tolerance) const {
    WidePose seen = PoseAt(asking_, c);
    WideTie alone;
    alone.place = PoseAt(other_, m);
    if (have_references_) {
      alone.asking_node = c;
      alone.other_node = m;
    }
    const auto own = [&](const WidePose& frame) {
      const WideMatrix turn = WideTurn(frame.heading, d_);
      const Wide other_scale = other_scale_.value_or(drift_scale);
      return WideMatrix(
          drift_scale * drift_scale * ErrorSince(asking_, std::nullopt, c) +
          other_scale * other_scale * turn *
              ErrorSince(other_, std::nullopt, m) * turn.transpose());
    };
    if (!tie) {
      alone.frame = FrameWith(seen, PoseAt(other_, m));
      alone.covariance = tolerance;
      if (!have_references_) alone.covariance += own(alone.frame);
      return alone;
    }
    const WidePose placed = Placed(tie->frame, PoseAt(other_, m));
    const Wide sure = tie->covariance(d_ - 1, d_ - 1);
    const Wide turned = NearestTo(0.0L, seen.heading - placed.heading);
    if (sure < 0.64L && std::abs(turned) > 0.5L * kWidePi) {
      seen.heading += kWidePi;
    }
    WideVector y = StateOf(seen, d_) - StateOf(placed, d_);
    y(d_ - 1) = NearestTo(0.0L, y(d_ - 1));
    WideMatrix prior = Gamma(*tie, c, m, drift_scale);
    WideMatrix noise = tolerance;
    if (!have_references_) {
      noise += own(tie->frame);
      const WidePose known = Placed(tie->frame, tie->place);
      const WideMatrix lever =
          WideLever(placed.x - known.x, placed.y - known.y, d_);
      prior = lever * tie->covariance * lever.transpose();
    }
    const auto form = EvaluateWide(prior + noise, y);
    if (!form || form->squared > core::ChiSquaredQuantile(d_, 0.99)) {
      if (by_closures) return *tie;
      alone.frame = FrameWith(seen, PoseAt(other_, m));
      alone.covariance = tolerance;
      if (!have_references_) alone.covariance += own(alone.frame);
      return alone;
    }
    Correct(placed, y, prior, noise, &alone);
    return alone;
  }

  // The drift that pairs of nodes of one drive show, one after the other; each
  // pair says that the two are at one place, by so much. Nothing without pairs.
  std::optional<WideTie> ShownBy(const std::vector<core::ConfirmedLoop>& pairs,
                                 Wide drift_scale,
                                 const WideMatrix& tolerance) const {
    std::optional<WideTie> shown;
    for (const core::ConfirmedLoop& pair : pairs) {
      WideTie tie;
      tie.place = PoseAt(asking_, pair.matched);
      tie.asking_node = pair.query;
      tie.other_node = pair.matched;
      WidePose seen = PoseAt(asking_, pair.query);
      const Wide turned = NearestTo(0.0L, seen.heading - tie.place.heading);
      if (std::abs(turned) > 0.5L * kWidePi) seen.heading += kWidePi;
      const auto update = [&](const WidePose& placed, const WideMatrix& prior,
                              Wide most) {
        WideVector y = StateOf(seen, d_) - StateOf(placed, d_);
        y(d_ - 1) = NearestTo(0.0L, y(d_ - 1));
        const auto form = EvaluateWide(prior + tolerance, y);
        if (!form || form->squared > most) return false;
        Correct(placed, y, prior, tolerance, &tie);
        return true;
      };
      if (shown && update(Placed(shown->frame, tie.place),
                          Gamma(*shown, pair.query, pair.matched, drift_scale),
                          core::ChiSquaredQuantile(d_, 0.99))) {
        shown = tie;
      } else if (update(tie.place,
                        drift_scale * drift_scale *
                            ErrorSince(asking_, pair.query, pair.matched),
                        std::numeric_limits<Wide>::infinity())) {
        shown = tie;
      }
    }
    return shown;
  }

  // Node j, which does not lie before the place, has a part of the drift shown,
  // in the axes of the asking frame: the mean, and by how much it leaves the
  // covariance less.
  std::pair<WideVector, WideMatrix> HasToo(const WideTie& shown,
                                           core::NodeIndex j,
                                           Wide drift_scale) const {
    const core::NodeIndex c = *shown.asking_node;
    const core::NodeIndex m = *shown.other_node;
    const WidePose at_j = PoseAt(asking_, j);
    const WidePose at_c = PoseAt(asking_, c);
    const WideMatrix turn = WideTurn(shown.frame.heading, d_);
    const Wide claimed = drift_scale * drift_scale;
    // Cov(u_j, u_c), whichever is later.
    const WideMatrix mixed =
        j <= c
            ? WideMatrix(
                  claimed * ErrorSince(asking_, m, j) *
                  WideLever(at_c.x - at_j.x, at_c.y - at_j.y, d_).transpose())
            : WideMatrix(claimed *
                         WideLever(at_j.x - at_c.x, at_j.y - at_c.y, d_) *
                         ErrorSince(asking_, m, c));
    const WidePose at_m = PoseAt(asking_, m);
    const WideMatrix lever = WideLever(at_c.x - at_m.x, at_c.y - at_m.y, d_);
    const WideMatrix known =
        claimed * ErrorSince(asking_, m, c) +
        lever * turn.transpose() * shown.covariance * turn * lever.transpose();
    const WidePose origin;
    const WidePose true_c = Placed(FrameWith(origin, shown.frame), at_c);
    WideVector y = StateOf(at_c, d_) - StateOf(true_c, d_);
    y(d_ - 1) = NearestTo(0.0L, y(d_ - 1));
    const WideMatrix gain = mixed * known.inverse();
    return {turn * gain * y,
            turn * gain * mixed.transpose() * turn.transpose()};
  }

 private:
  // Lets the tie place what was placed there between that and where it is seen,
  // which differs by this, as the covariances of the two say.
  void Correct(const WidePose& placed, const WideVector& difference,
               const WideMatrix& prior, const WideMatrix& noise,
               WideTie* tie) const {
    const WideMatrix both = (prior.inverse() + noise.inverse()).inverse();
    const WideVector moved = both * noise.inverse() * difference;
    WidePose corrected = placed;
    corrected.x += moved(0);
    corrected.y += moved(1);
    if (d_ == 4) corrected.z += moved(2);
    corrected.heading += moved(d_ - 1);
    tie->frame = FrameWith(corrected, tie->place);
    tie->covariance = both;
  }

  WidePose PoseAt(const core::PoseGraph& graph, core::NodeIndex i) const {
    WidePose pose = WidePoseOf(graph.node(i).pose);
    if (d_ == 3) pose.z = 0.0L;
    return pose;
  }

  WideMatrix CovarianceAt(const core::PoseGraph& graph,
                          core::NodeIndex i) const {
    return WideCovarianceOf(graph.node(i).covariance, d_);
  }

  // The covariance of node i's error, given that there is none at the
  // reference; all of it where there is none.
  WideMatrix ErrorSince(const core::PoseGraph& graph,
                        const std::optional<core::NodeIndex>& reference,
                        core::NodeIndex i) const {
    if (!reference) return CovarianceAt(graph, i);
    const core::NodeIndex earlier = std::min(*reference, i);
    const core::NodeIndex later = std::max(*reference, i);
    const WidePose from = PoseAt(graph, earlier);
    const WidePose to = PoseAt(graph, later);
    // e_later = Psi e_earlier + what is added.
    const WideMatrix psi = WideLever(to.x - from.x, to.y - from.y, d_);
    const WideMatrix added =
        CovarianceAt(graph, later) -
        psi * CovarianceAt(graph, earlier) * psi.transpose();
    if (i == later) return added;
    const WideMatrix back = psi.inverse();
    return back * added * back.transpose();
  }

  const core::PoseGraph& asking_;
  const core::PoseGraph& other_;
  const std::optional<Wide> other_scale_;
  const bool have_references_;
  const int d_;
};

}  // namespace revisit::oracle

#endif  // REVISIT_TESTS_ORACLE_FRAMES_H_
