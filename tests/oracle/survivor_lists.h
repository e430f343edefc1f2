// The search of relative.h with paths that keep all their steps as a list. Each
// extension is judged by the dense Gaussian of all mismatches of the path;
// poses beyond loop closures are composed as rigid transforms from the start of
// the list every time. Every end is walked back from by itself and to the last
// step, however little there is to gain.
#ifndef REVISIT_TESTS_ORACLE_SURVIVOR_LISTS_H_
#define REVISIT_TESTS_ORACLE_SURVIVOR_LISTS_H_

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>
#include <limits>
#include <optional>
#include <utility>
#include <vector>

#include "core/drive/confirmed_loop.h"
#include "core/drive/pose_graph.h"
#include "core/geometry/pose.h"
#include "core/noise/similarity_model.h"
#include "core/search/alignment/known_drift.h"
#include "core/search/alignment/relative.h"
#include "tests/oracle/dense_window.h"
#include "tests/oracle/frames.h"
#include "tests/oracle/wide_state.h"

namespace revisit::oracle {

struct PathEntry {
  std::int64_t t = 0;
  core::NodeIndex node = 0;
  // 0 walks back in time, 1 forward.
  int way = 0;
  bool slipped = false;
  // The node that a step over a loop closure leads to, before the step.
  std::optional<core::NodeIndex> over;
};

struct ListedPath {
  std::vector<PathEntry> entries;
  // e_1 .. e_t
  WideVector mismatches;
  // Sums over all of the path.
  Wide squared_innovations = 0.0L;
  Wide log_likelihood_ratio = 0.0L;
};

struct ListedMatch {
  bool possible = false;
  Wide score = 0.0L;
  Wide log_likelihood_ratio = 0.0L;
  Wide squared_innovations = 0.0L;
  Wide squared_end_difference = 0.0L;
  Wide scale = 1.0L;
  // Whether a heading lies half a turn from the query's, as it does at the node
  // that a closure ties to the query itself: rounding decides to which side,
  // and so what is left of it once the path is known.
  bool is_straight_across = false;
  std::vector<PathEntry> entries;
};

class SurvivorLists {
 public:
  SurvivorLists(const core::Query& query, const core::History& history,
                const core::RelativeModel& model)
      : graph_(query.graph),
        model_(model),
        query_(query.node),
        first_(history.first),
        size_(history.end),
        relation_(history.relation),
        d_(model.similarity.state_space == core::StateSpace::kPlanar ? 3 : 4),
        window_(graph_, query_, query.steps,
                WindowModel(graph_, model, query_, d_)),
        frames_(graph_,
                model.similarity.correlation.model ==
                    core::CorrelationModel::kDeadReckoning,
                d_) {
    for (int way = 0; way < 2; ++way) {
      if (!(way == 0 ? model.same_direction : model.opposite_direction)) {
        continue;
      }
      for (core::NodeIndex j = first_; j < size_; ++j) {
        matches_[static_cast<std::size_t>(way)].push_back(
            Match(j, way, WalkBack(j, way, query.steps)));
      }
    }
  }

  // By direction: 0 the same, 1 opposite; each from the first node of the
  // history on. Empty if not sought.
  const std::array<std::vector<ListedMatch>, 2>& matches() const {
    return matches_;
  }

  // Paths that met a likelier one of their end, and those dropped beyond
  // kMostPaths.
  int met() const { return met_; }
  int beyond_most() const { return beyond_most_; }

 private:
  using Rigid = Eigen::Matrix<Wide, 4, 4>;

  static DenseWindowModel WindowModel(const core::PoseGraph& graph,
                                      const core::RelativeModel& model,
                                      core::NodeIndex query, int dimensions) {
    const MotionByLoops motion =
        MeasureByLoops(graph, model.similarity.correlation, query, dimensions);
    return {dimensions,           model.similarity.correlation.model,
            motion.drift,         motion.jitter,
            model.shape,          model.similarity.tolerance,
            model.spacing_meters, model.similarity.inflation};
  }

  // The vehicle's frame in the local frame; turned by pi where it is met the
  // other way.
  Rigid FrameOf(core::NodeIndex i, int way) const {
    const core::Pose& pose = graph_.node(i).pose;
    const Wide heading = pose.heading + (way == 0 ? 0.0L : kWidePi);
    Rigid frame = Rigid::Identity();
    frame.topLeftCorner<2, 2>() = WideTurn(heading, 3).topLeftCorner<2, 2>();
    frame(0, 3) = pose.x;
    frame(1, 3) = pose.y;
    frame(2, 3) = d_ == 4 ? pose.z : 0.0;
    return frame;
  }

  // The newest entry, seen from the first.
  WideVector SeenFromEnd(const std::vector<PathEntry>& entries) const {
    const PathEntry& end = entries.front();
    // The local frame in which the path is now, seen from its end.
    Rigid local = FrameOf(end.node, end.way).inverse();
    for (std::size_t k = 1; k < entries.size(); ++k) {
      if (!entries[k].over) continue;
      // Both ends of the closure are one place.
      const PathEntry& near = entries[k - 1];
      local = (local * FrameOf(near.node, near.way) *
               FrameOf(*entries[k].over, entries[k].way).inverse())
                  .eval();
    }
    const Rigid seen = local * FrameOf(entries.back().node, entries.back().way);
    WideVector state(d_);
    state(0) = seen(0, 3);
    state(1) = seen(1, 3);
    if (d_ == 4) state(2) = seen(2, 3);
    state(d_ - 1) = std::atan2(seen(1, 0), seen(0, 0));
    return state;
  }

  bool Road(core::NodeIndex a, core::NodeIndex b) const {
    return a >= first_ && b >= first_ && a < size_ && b < size_ &&
           graph_.SegmentStart(a) == graph_.SegmentStart(b);
  }

  static core::NodeIndex StrideOf(int way) { return way == 0 ? -1 : 1; }

  // Nothing where there is no road to the node or the innovation is beyond the
  // limit.
  std::optional<ListedPath> Extend(const ListedPath& path,
                                   const PathEntry& entry) const {
    if (!Road(entry.over.value_or(path.entries.back().node), entry.node)) {
      return std::nullopt;
    }
    ListedPath longer = path;
    longer.entries.push_back(entry);
    WideVector e = window_.path(entry.t) - SeenFromEnd(longer.entries);
    // Headings are known but for whole turns: the innovation's are the least.
    e(d_ - 1) = NearestTo(window_.Predict(path.mismatches)(d_ - 1), e(d_ - 1));
    longer.mismatches.resize(path.mismatches.size() + d_);
    longer.mismatches << path.mismatches, e;
    longer.squared_innovations = window_.SquaredInnovations(longer.mismatches);
    if (longer.squared_innovations - path.squared_innovations >
        core::kSquaredInnovationLimit) {
      return std::nullopt;
    }
    longer.log_likelihood_ratio = -0.5L * longer.squared_innovations;
    for (std::size_t k = 1; k < longer.entries.size(); ++k) {
      longer.log_likelihood_ratio += window_.surprise(longer.entries[k].t);
      if (longer.entries[k].slipped) {
        longer.log_likelihood_ratio -= core::kSlipCost;
      }
    }
    return longer;
  }

  // The likeliest of keeping step, staying and skipping a node.
  std::optional<ListedPath> WalkOn(const ListedPath& path) const {
    const PathEntry& from = path.entries.back();
    std::optional<ListedPath> likeliest;
    for (const int nodes : {1, 0, 2}) {
      const std::optional<ListedPath> longer =
          Extend(path, {from.t + 1, from.node + nodes * StrideOf(from.way),
                        from.way, nodes != 1, std::nullopt});
      if (longer && (!likeliest || longer->log_likelihood_ratio >
                                       likeliest->log_likelihood_ratio)) {
        likeliest = longer;
      }
    }
    return likeliest;
  }

  // Over each loop closure at its node.
  std::vector<ListedPath> WalkOver(const ListedPath& path) const {
    const PathEntry& from = path.entries.back();
    std::vector<ListedPath> beyond;
    for (const auto& [a, b] : graph_.LoopEdges()) {
      if (a != from.node && b != from.node) continue;
      const core::NodeIndex far = a == from.node ? b : a;
      if (far < first_ || far >= size_) continue;
      const Wide turn =
          NearestTo(0.0L, static_cast<Wide>(graph_.node(far).pose.heading) -
                              graph_.node(from.node).pose.heading);
      const int way = std::abs(turn) > 0.5L * kWidePi ? 1 - from.way : from.way;
      const std::optional<ListedPath> longer =
          Extend(path, {from.t + 1, far + StrideOf(way), way, false, far});
      if (longer) beyond.push_back(*longer);
    }
    return beyond;
  }

  // The likelier of those at one node that walk the same way, and of all the
  // kMostPaths likeliest.
  std::vector<ListedPath> Merged(std::vector<ListedPath> paths) {
    std::stable_sort(paths.begin(), paths.end(),
                     [](const ListedPath& a, const ListedPath& b) {
                       return a.log_likelihood_ratio > b.log_likelihood_ratio;
                     });
    std::vector<ListedPath> merged;
    for (const ListedPath& path : paths) {
      const PathEntry& at = path.entries.back();
      const bool met = std::any_of(
          merged.begin(), merged.end(), [&at](const ListedPath& likelier) {
            const PathEntry& other = likelier.entries.back();
            return other.node == at.node && other.way == at.way;
          });
      if (met) {
        ++met_;
      } else if (merged.size() == core::kMostPaths) {
        ++beyond_most_;
      } else {
        merged.push_back(path);
      }
    }
    return merged;
  }

  // The path of the greatest log-likelihood ratio.
  ListedPath WalkBack(core::NodeIndex j, int way, std::int64_t steps) {
    ListedPath end;
    end.entries = {{0, j, way, false, std::nullopt}};
    end.mismatches.resize(0);
    ListedPath best = end;
    std::vector<ListedPath> paths = {end};
    for (std::int64_t t = 1; t < steps; ++t) {
      std::vector<ListedPath> longer;
      for (const ListedPath& path : paths) {
        if (const auto on = WalkOn(path)) longer.push_back(*on);
      }
      const std::size_t walked_on = longer.size();
      for (const ListedPath& path : paths) {
        for (const ListedPath& over : WalkOver(path)) longer.push_back(over);
      }
      paths = longer.size() > walked_on ? Merged(longer) : longer;
      for (const ListedPath& path : paths) {
        if (path.log_likelihood_ratio > best.log_likelihood_ratio) best = path;
      }
    }
    return best;
  }

  // Whether errors can have been carried from the one node of a closure over
  // the other to the query, with nothing but noise added.
  bool ForwardFilter(const core::ConfirmedLoop& loop,
                     const WideMatrix& tolerance) const {
    const auto grows = [&](core::NodeIndex a, core::NodeIndex b) {
      const core::Node& earlier = graph_.node(std::min(a, b));
      const core::Node& later = graph_.node(std::max(a, b));
      const WideMatrix f =
          WideLever(static_cast<Wide>(later.pose.x) - earlier.pose.x,
                    static_cast<Wide>(later.pose.y) - earlier.pose.y, d_);
      const WideMatrix added =
          WideCovarianceOf(later.covariance, d_) -
          f * WideCovarianceOf(earlier.covariance, d_) * f.transpose() +
          tolerance;
      return EvaluateWide(added, WideVector::Zero(d_)).has_value();
    };
    return grows(loop.matched, loop.query) &&
           grows(std::max(loop.matched, loop.query), query_);
  }

  // Nothing where the covariances are not those of a forward filter.
  std::optional<WideClosure> ClosureOf(const core::ConfirmedLoop& loop) const {
    const core::Pose& c = graph_.node(loop.query).pose;
    const core::Pose& m = graph_.node(loop.matched).pose;
    if (loop.measured) {
      const WideClosure measured = WideMeasured(*loop.measured, d_);
      if (ForwardFilter(loop, measured.tolerance)) return measured;
    }
    WideClosure closure;
    closure.y = WideStateOf(c, d_) - WideStateOf(m, d_);
    closure.lever = WideMatrix::Identity(d_, d_);
    closure.tolerance =
        WideDiagonal(core::kConfirmedTolerance.position_meters,
                     core::kConfirmedTolerance.heading_radians, d_);
    if (!ForwardFilter(loop, closure.tolerance)) return std::nullopt;
    Wide& turned = closure.y(d_ - 1);
    turned = NearestTo(0.0L, turned);
    if (std::abs(turned) > 0.5L * kWidePi) {
      turned = NearestTo(0.0L, turned + kWidePi);
    }
    return closure;
  }

  // Difference of the query and node j, and its covariance with the tolerance,
  // under one scale, given what a closure tells.
  std::pair<WideVector, WideMatrix> Anchor(
      core::NodeIndex j, int way, double scale,
      const std::optional<core::ConfirmedLoop>& loop) const {
    const core::SimilarityModel& similarity = model_.similarity;
    const Wide deviations = static_cast<Wide>(similarity.inflation) * scale;
    const Wide claimed = deviations * deviations;
    const auto difference = [&](core::NodeIndex a, core::NodeIndex b,
                                bool turned) {
      WideVector d = WideStateOf(graph_.node(a).pose, d_) -
                     WideStateOf(graph_.node(b).pose, d_);
      d(d_ - 1) = NearestTo(0.0L, d(d_ - 1) + (turned ? kWidePi : 0.0L));
      return d;
    };
    const auto cross = [&](core::NodeIndex a, core::NodeIndex b) {
      return WideMatrix(claimed *
                        WideCross(graph_, similarity.correlation, a, b, d_));
    };
    const auto gamma = [&](core::NodeIndex a, core::NodeIndex b) {
      return WideMatrix(claimed *
                        WideGamma(graph_, similarity.correlation, a, b, d_));
    };
    WideVector d = difference(query_, j, way == 1);
    WideMatrix covariance =
        gamma(query_, j) + WideDiagonal(similarity.tolerance.position_meters,
                                        similarity.tolerance.heading_radians,
                                        d_);
    const std::optional<WideClosure> closure =
        loop ? ClosureOf(*loop) : std::nullopt;
    if (closure) {
      const core::NodeIndex c = loop->query;
      const core::NodeIndex m = loop->matched;
      const WideMatrix& lever = closure->lever;
      const WideMatrix back = lever.transpose();
      const WideMatrix x = cross(query_, c) - cross(query_, m) * back -
                           cross(j, c) + cross(j, m) * back;
      const WideMatrix known = cross(c, c) + lever * cross(m, m) * back -
                               cross(c, m) * back - lever * cross(m, c) +
                               closure->tolerance;
      const WideMatrix gain = x * known.inverse();
      WideVector known_d = d - gain * closure->y;
      known_d(d_ - 1) = NearestTo(0.0L, known_d(d_ - 1));
      const WideMatrix known_covariance = covariance - gain * x.transpose();
      if (EvaluateWide(known_covariance, known_d)) {
        return {known_d, known_covariance};
      }
    }
    return {d, covariance};
  }

  // The same as marks have shown the drift.
  std::pair<WideVector, WideMatrix> AnchorShown(
      core::NodeIndex j, int way, double scale,
      const std::vector<core::ConfirmedLoop>& pairs) const {
    const core::SimilarityModel& similarity = model_.similarity;
    const Wide deviations = static_cast<Wide>(similarity.inflation) * scale;
    const WideMatrix confirmed =
        WideDiagonal(core::kConfirmedTolerance.position_meters,
                     core::kConfirmedTolerance.heading_radians, d_);
    std::vector<core::ConfirmedLoop> counting;
    std::copy_if(pairs.begin(), pairs.end(), std::back_inserter(counting),
                 [&](const core::ConfirmedLoop& pair) {
                   return ForwardFilter(pair, confirmed);
                 });
    const std::optional<WideTie> shown =
        frames_.ShownBy(counting, deviations, confirmed);
    if (!shown) return Anchor(j, way, scale, std::nullopt);
    WideVector d = frames_.Difference(*shown, query_, j);
    if (way == 1) d(d_ - 1) = NearestTo(0.0L, d(d_ - 1) + kWidePi);
    WideMatrix covariance =
        frames_.Gamma(*shown, query_, j, deviations) +
        WideDiagonal(similarity.tolerance.position_meters,
                     similarity.tolerance.heading_radians, d_);
    if (j > *shown->other_node) {
      const auto [mean, less] = frames_.HasToo(*shown, j, deviations);
      WideVector known_d = d + mean;
      known_d(d_ - 1) = NearestTo(0.0L, known_d(d_ - 1));
      if (EvaluateWide(covariance - less, known_d)) {
        return {known_d, covariance - less};
      }
    }
    return {d, covariance};
  }

  // The same of a node in another frame; a drift that is shown is known by its
  // closure alone.
  std::pair<WideVector, WideMatrix> AnchorAcross(
      core::NodeIndex j, int way, double scale, Wide fixed_scale,
      const std::optional<core::ConfirmedLoop>& shown) const {
    const core::SimilarityModel& similarity = model_.similarity;
    const Wide deviations = static_cast<Wide>(similarity.inflation) * scale;
    std::optional<WideTie> tie;
    if (relation_.tie().is_tied()) {
      tie = frames_.TieOf(relation_.tie(), deviations, fixed_scale);
    }
    if (shown) {
      const core::FrameState state = relation_.tie().state;
      tie = frames_.KnownBy(
          tie,
          state == core::FrameState::kKnown ||
              state == core::FrameState::kProvisional,
          shown->query, shown->matched, deviations,
          WideDiagonal(core::kConfirmedTolerance.position_meters,
                       core::kConfirmedTolerance.heading_radians, d_));
    }
    WideVector d = frames_.Difference(*tie, query_, j);
    if (way == 1) d(d_ - 1) = NearestTo(0.0L, d(d_ - 1) + kWidePi);
    return {d, frames_.Gamma(*tie, query_, j, deviations) +
                   WideDiagonal(similarity.tolerance.position_meters,
                                similarity.tolerance.heading_radians, d_)};
  }

  // An anchor that a node may have, and its weight.
  struct WeighedAnchor {
    double scale = 1.0;
    Wide log_weight = 0.0L;
    std::optional<core::ConfirmedLoop> loop;
    // The pairs by which marks show the drift; then no closure counts.
    std::vector<core::ConfirmedLoop> pairs = {};
    // In another frame.
    Wide fixed_scale = 1.0L;
    bool is_unknown = false;
  };

  std::pair<WideVector, WideMatrix> AnchorBy(
      core::NodeIndex j, int way, const WeighedAnchor& anchor) const {
    const bool is_shown = !anchor.pairs.empty();
    if (!relation_.is_own()) {
      std::optional<core::ConfirmedLoop> newest;
      if (is_shown) newest = anchor.pairs.back();
      return AnchorAcross(j, way, anchor.scale, anchor.fixed_scale, newest);
    }
    return is_shown ? AnchorShown(j, way, anchor.scale, anchor.pairs)
                    : Anchor(j, way, anchor.scale, anchor.loop);
  }

  // All scales, with each of the drifts that reach into the node's block of 128
  // and with the one as claimed.
  std::vector<WeighedAnchor> AnchorsOf(core::NodeIndex j) const {
    std::vector<WeighedAnchor> anchors;
    std::vector<core::WeighedScale> scales = model_.scales;
    if (scales.empty()) scales.emplace_back();
    for (const core::WeighedScale& scale : scales) {
      Wide left = 1.0L;
      const std::vector<core::WeighedDrift>& drifts =
          relation_.is_own() ? model_.drifts : relation_.drifts();
      for (const core::WeighedDrift& drift : drifts) {
        bool reaches = false;
        for (core::NodeIndex i = j / 128 * 128; i < j / 128 * 128 + 128; ++i) {
          reaches |= drift.reach.first <= i && i < drift.reach.last;
        }
        if (!reaches) continue;
        left -= std::exp(static_cast<Wide>(drift.log_weight));
        anchors.push_back(
            {scale.scale,
             static_cast<Wide>(scale.log_weight) + drift.log_weight,
             std::nullopt, drift.pairs});
      }
      if (relation_.is_own()) {
        anchors.push_back({scale.scale, scale.log_weight + std::log(left),
                           model_.last_confirmed});
        continue;
      }
      for (const core::FrameWay& lies : relation_.ways()) {
        anchors.push_back({scale.scale,
                           scale.log_weight + std::log(left) + lies.log_weight,
                           std::nullopt,
                           {},
                           lies.fixed_scale,
                           lies.is_unknown});
      }
    }
    return anchors;
  }

  // The end's difference once the path is known, under one anchor, which says
  // this of it before.
  std::optional<WideQuadraticForm> Smoothed(const WideVector& d,
                                            const WideMatrix& covariance,
                                            const ListedPath& path) const {
    const std::optional<WideQuadraticForm> claimed =
        EvaluateWide(covariance, d);
    if (!claimed) return std::nullopt;
    const int length = static_cast<int>(path.entries.size()) - 1;
    const WideMatrix to_local = WideTurn(graph_.node(query_).pose.heading, d_);
    const WideMatrix smoothed = covariance - to_local *
                                                 window_.EndCertainty(length) *
                                                 to_local.transpose();
    std::optional<WideQuadraticForm> form;
    // At least a thousandth of the covariance has to be left.
    if (EvaluateWide(smoothed - 1e-3L * covariance, d)) {
      form = EvaluateWide(smoothed,
                          d + to_local * window_.EndMean(path.mismatches));
    }
    return form ? form : claimed;
  }

  ListedMatch Match(core::NodeIndex j, int way, const ListedPath& path) const {
    ListedMatch match;
    // Logarithms, since those of far ends are too small for a number.
    std::vector<Wide> parts;
    Wide greatest = -std::numeric_limits<Wide>::infinity();
    for (const WeighedAnchor& anchor : AnchorsOf(j)) {
      if (anchor.is_unknown) {
        match.possible = true;
        parts.push_back(anchor.log_weight + Anywhere());
        if (parts.back() > greatest) {
          greatest = parts.back();
          match.squared_end_difference = 0.0L;
          match.scale = anchor.scale;
        }
        continue;
      }
      const auto [d, covariance] = AnchorBy(j, way, anchor);
      match.is_straight_across |=
          std::abs(std::abs(d(d_ - 1)) - kWidePi) < 1e-12L;
      const auto form = Smoothed(d, covariance, path);
      if (!form) continue;
      match.possible = true;
      const Wide part =
          anchor.log_weight - 0.5L * (form->squared + form->log_determinant);
      parts.push_back(part);
      if (!(part > greatest)) continue;
      greatest = part;
      match.squared_end_difference = form->squared;
      match.scale = anchor.scale;
    }
    if (!match.possible) return match;
    Wide times_greatest = 0.0L;
    for (const Wide part : parts) times_greatest += std::exp(part - greatest);
    match.log_likelihood_ratio = path.log_likelihood_ratio;
    match.squared_innovations = path.squared_innovations;
    match.score = greatest + std::log(times_greatest) -
                  0.5L * d_ * std::log(2.0L * kWidePi) +
                  window_.weight() * match.log_likelihood_ratio -
                  window_.join_cost() - std::log(NewPlaceDensity());
    match.entries = path.entries;
    return match;
  }

  // Nodes on roads not driven, per square metre (SPATIAL: cubic) and radian.
  Wide NewPlaceDensity() const {
    const Wide roads = 2.0L / model_.road_spacing_meters;
    const Wide density =
        roads / model_.spacing_meters * 2.0L / (2.0L * kWidePi);
    return d_ == 4 ? density / core::kRoadHeightRange : density;
  }

  // One of all nodes of 10 km by 10 km, in the place of a density of the
  // difference.
  Wide Anywhere() const {
    const Wide roads = 2.0L / model_.road_spacing_meters;
    const Wide nodes = 1e8L * roads / model_.spacing_meters * 2.0L;
    return -std::log(nodes) + 0.5L * d_ * std::log(2.0L * kWidePi) +
           std::log(NewPlaceDensity());
  }

  const core::PoseGraph& graph_;
  const core::RelativeModel& model_;
  const core::NodeIndex query_;
  const core::NodeIndex first_;
  const core::NodeIndex size_;
  const core::Relation relation_;
  const int d_;
  const DenseWindow window_;
  const WideFrames frames_;
  std::array<std::vector<ListedMatch>, 2> matches_;
  int met_ = 0;
  int beyond_most_ = 0;
};

}  // namespace revisit::oracle

#endif  // REVISIT_TESTS_ORACLE_SURVIVOR_LISTS_H_
