#include "core/search/alignment/path_walk.h"

#include <algorithm>
#include <array>
#include <cmath>

#include "core/drive/confirmed_loop.h"
#include "core/geometry/heading.h"
#include "core/geometry/pose.h"
#include "core/geometry/state_matrix.h"

namespace revisit::core {
namespace {

// Ends that are walked back from at once: what they hold should fit the nearest
// cache.
constexpr std::size_t kTogether = 64;

// Paths are asked about after 2, 4, 8 ... steps, as long as one of so many is
// of no use, once so many were asked about.
constexpr std::int64_t kFirstAsked = 2;
constexpr std::int64_t kAskedPerUseless = 8;
constexpr std::int64_t kAskedAtLeast = 128;

constexpr StateSpace SpaceOf(int dimensions) {
  return dimensions == 3 ? StateSpace::kPlanar : StateSpace::kSpatial;
}

std::size_t Position(NodeIndex i) { return static_cast<std::size_t>(i); }

// Where history is walked to: -1 walks back in time, as the recent path is
// walked.
constexpr NodeIndex Stride(Direction direction) {
  return direction == Direction::kSame ? -1 : 1;
}

constexpr Direction Turned(Direction direction) {
  return direction == Direction::kSame ? Direction::kOpposite
                                       : Direction::kSame;
}

// The way on the far side of a loop closure: the headings of its two nodes show
// whether the passes are in opposite directions.
Direction DirectionBeyond(const PoseGraph& graph, NodeIndex near, NodeIndex far,
                          Direction direction) {
  return DirectionOf(graph, {near, far}) == Direction::kOpposite
             ? Turned(direction)
             : direction;
}

}  // namespace

// Member functions that walkers call at every step are inline, as if they were
// defined in the class: searches are some 5 % slower without.

template <int D>
PathWalk<D>::PathWalk(const History& history, const RecentPath<D>& recent,
                      const PathAxes<D>& axes, Direction direction,
                      bool over_loops, PoseTable* table, WalkedEnds* walked)
    : graph_(history.graph),
      recent_(recent),
      first_(history.first),
      end_(history.end),
      direction_(direction),
      table_(*table),
      has_loops_(over_loops && graph_.has_loop_edges()),
      walked_(has_loops_ ? nullptr : walked) {
  best_.change.certainty = axes.certainties();
  best_.change.cosine = std::cos(axes.heading());
  best_.change.sine = std::sin(axes.heading());
  best_.change.least_left = kLeastUncertaintyLeft;
}

template <int D>
const BestPaths& PathWalk<D>::Walk(const std::vector<WalkStart>& starts,
                                   const IsUseless& is_useless) {
  Reset();
  for (const WalkStart& start : starts) {
    best_.change.left_out.reset(start.slot / NodeBlock::kGroupSize);
  }
  if (walked_ == nullptr || tracing_) {
    WalkFrom(starts, is_useless);
  } else {
    const std::vector<WalkStart>& unknown = TakeWalked(starts);
    WalkFrom(unknown, is_useless);
    KeepWalked(unknown);
  }
  return best_;
}

template <int D>
void PathWalk<D>::WalkFrom(const std::vector<WalkStart>& starts,
                           const IsUseless& is_useless) {
  // No step leads further than over one node.
  const NodeIndex reach = 2 * recent_.size();
  for (const WalkStart& start : starts) {
    if (direction_ == Direction::kSame) {
      table_.Need(start.end - reach, start.end);
    } else {
      table_.Need(start.end, start.end + reach);
    }
  }
  for (std::size_t begin = 0; begin < starts.size(); begin += kTogether) {
    const std::size_t count = std::min(kTogether, starts.size() - begin);
    walkers_.Begin(count);
    for (std::size_t i = 0; i < count; ++i) Seed(i, starts[begin + i]);
    WalkAll(is_useless);
  }
}

// Takes the best paths of the ends that are known, and returns the others.
template <int D>
const std::vector<WalkStart>& PathWalk<D>::TakeWalked(
    const std::vector<WalkStart>& starts) {
  unknown_.clear();
  for (const WalkStart& start : starts) {
    const WalkedEnds::Path* const path = walked_->Find(start.end);
    if (path == nullptr) {
      unknown_.push_back(start);
      continue;
    }
    best_.log_likelihood_ratios[start.slot] = path->log_likelihood_ratio;
    best_.squared_innovations[start.slot] = path->squared_innovations;
    best_.change.row[start.slot] = path->steps;
    for (std::size_t r = 0; r < D; ++r) {
      best_.change.shift[r][start.slot] = path->shift[r];
    }
  }
  return unknown_;
}

template <int D>
void PathWalk<D>::KeepWalked(const std::vector<WalkStart>& starts) {
  for (const WalkStart& start : starts) {
    if (cut_short_[start.slot]) continue;
    WalkedEnds::Path path;
    path.log_likelihood_ratio = best_.log_likelihood_ratios[start.slot];
    path.squared_innovations = best_.squared_innovations[start.slot];
    path.steps = best_.change.row[start.slot];
    for (std::size_t r = 0; r < D; ++r) {
      path.shift[r] = best_.change.shift[r][start.slot];
    }
    walked_->Keep(start.end, path);
  }
}

template <int D>
std::vector<PathStep> PathWalk<D>::Trace(NodeIndex end) {
  tracing_ = true;
  trail_ = {{{0, end, direction_}, -1}};
  best_trail_ = 0;
  Walk({{end, kImpossible, 0}}, nullptr);
  tracing_ = false;
  std::vector<PathStep> path;
  for (std::int64_t i = best_trail_; i >= 0; i = trail_[Position(i)].before) {
    path.push_back(trail_[Position(i)].step);
  }
  std::reverse(path.begin(), path.end());
  return path;
}

template <int D>
void PathWalk<D>::Reset() {
  best_.log_likelihood_ratios.fill(0.0);
  best_.squared_innovations.fill(0.0);
  best_.change.row.fill(0);
  for (auto& column : best_.change.shift) column.fill(0.0);
  best_.change.left_out.set();
  cut_short_.reset();
}

// Puts walker i, which is as Begin() left it, at its end.
template <int D>
inline void PathWalk<D>::Seed(std::size_t i, const WalkStart& start) {
  const NodeIndex j = start.end;
  const Pose pose = graph_.pose(j);
  const double sign = direction_ == Direction::kSame ? 1.0 : -1.0;
  walkers_.at(Walkers::kX, i) = pose.x;
  walkers_.at(Walkers::kY, i) = pose.y;
  walkers_.at(Walkers::kZ, i) = pose.z;
  walkers_.at(Walkers::kHeading, i) = pose.heading;
  walkers_.at(Walkers::kCosine, i) = sign * std::cos(pose.heading);
  walkers_.at(Walkers::kSine, i) = sign * std::sin(pose.heading);
  walkers_.at(Walkers::kNeeded, i) = start.needed;
  walkers_.at(Walkers::kNode, i) = j;
  walkers_.at(Walkers::kStride, i) = Stride(direction_);
  walkers_.at(Walkers::kLast, i) = LastOf(j, direction_);
  walkers_.at(Walkers::kEnd, i) = static_cast<std::int64_t>(start.slot);
}

template <int D>
void PathWalk<D>::WalkAll(const IsUseless& is_useless) {
  std::vector<char> done;
  std::int64_t asked_next = kFirstAsked;
  for (std::int64_t t = 1; t < recent_.size() && walkers_.size() > 0; ++t) {
    if (t > asked_next) {
      GiveUp(asked_next, is_useless);
      asked_next *= 2;
    }
    // Beyond loop closures first, while the others are where they were.
    const std::size_t before = walkers_.size();
    if (has_loops_) WalkOverLoops(t, before);
    const std::size_t after = walkers_.size();
    WalkOn(SpaceOf(D), recent_.step(t), table_.poses(), before, &walkers_,
           &unsettled_);
    if (unsettled_.empty() && after == before && !tracing_) continue;
    done.assign(after, 0);
    CountPaths();
    for (const Unsettled& unsettled : unsettled_) {
      const std::size_t i = unsettled.walker;
      const bool is_only = IsOnlyPath(i);
      if (unsettled.hopeless && MayImprove(t, i)) CutShort(i);
      done[i] = unsettled.hopeless ? is_only : !Slip(t, unsettled, is_only);
    }
    if (after > before) Merge(before, &done);
    if (tracing_) Record(t);
    const auto end_if_done = [&](std::size_t i) {
      if (!done[i]) return;
      Credit(i);
      walkers_.Remove(i);
    };
    if (after == before) {
      // Nothing else has ended, and these are in the order of the walkers.
      for (std::size_t k = unsettled_.size(); k-- > 0;) {
        end_if_done(unsettled_[k].walker);
      }
    } else {
      for (std::size_t i = after; i-- > 0;) end_if_done(i);
    }
  }
  for (std::size_t i = 0; i < walkers_.size(); ++i) Credit(i);
}

// Where an end has several paths, one that is of no further use by itself still
// ends those that meet it and are less likely.
template <int D>
void PathWalk<D>::CountPaths() {
  if (!has_loops_ || unsettled_.empty()) return;
  paths_of_.fill(0);
  for (std::size_t i = 0; i < walkers_.size(); ++i) {
    ++paths_of_[Position(walkers_.at(Walkers::kEnd, i))];
  }
}

template <int D>
inline bool PathWalk<D>::IsOnlyPath(std::size_t i) const {
  return !has_loops_ || paths_of_[Position(walkers_.at(Walkers::kEnd, i))] == 1;
}

// Ends the paths that are of no use after step t. Where paths cross loop
// closures, an end has several, and none is given up: without it, another would
// count for the end.
template <int D>
void PathWalk<D>::GiveUp(std::int64_t t, const IsUseless& is_useless) {
  if (!is_useless || has_loops_ ||
      (asked_ >= kAskedAtLeast && given_up_ * kAskedPerUseless < asked_)) {
    return;
  }
  PathSoFar<D> path;
  path.steps = t;
  for (std::size_t i = walkers_.size(); i-- > 0;) {
    path.slot = Position(walkers_.at(Walkers::kEnd, i));
    path.most_ratio = walkers_.at(Walkers::kRatio, i) + recent_.step(t).to_come;
    path.best_ratio = walkers_.at(Walkers::kBestRatio, i);
    for (int r = 0; r < D; ++r) {
      const auto row = static_cast<std::size_t>(r);
      path.shift(r) = walkers_.at(Walkers::kAtEnd + row, i);
      path.best_shift(r) = walkers_.at(Walkers::kBestAtEnd + row, i);
    }
    ++asked_;
    if (!is_useless(path)) continue;
    ++given_up_;
    CutShort(i);
    Credit(i);
    walkers_.Remove(i);
  }
}

// Adds, for each of the first `walkers` that is at a loop closure, a walker
// that goes on beyond it.
template <int D>
void PathWalk<D>::WalkOverLoops(std::int64_t t, std::size_t walkers) {
  for (std::size_t i = 0; i < walkers; ++i) {
    const NodeIndex near = walkers_.at(Walkers::kNode, i);
    for (const NodeIndex far : graph_.LoopNeighbours(near)) {
      if (far >= first_ && far < end_) WalkOver(t, i, far);
    }
  }
}

template <int D>
void PathWalk<D>::WalkOver(std::int64_t t, std::size_t i, NodeIndex far) {
  const NodeIndex near = walkers_.at(Walkers::kNode, i);
  const Direction direction =
      DirectionBeyond(graph_, near, far, DirectionAt(i));
  const NodeIndex last = LastOf(far, direction);
  if (far == last) return;
  table_.Need(far - 2 * recent_.size(), far + 2 * recent_.size());
  // The far node is where this one is, and is seen as this one is.
  const StateVector<D> seen = SeenBy(i, table_.poses() + 4 * Position(near));
  const Pose pose = graph_.pose(far);
  const double turned = direction == Direction::kSame ? 0.0 : kPi;
  const double heading = pose.heading + turned - seen(D - 1);
  const double cosine = std::cos(heading);
  const double sine = std::sin(heading);
  const std::size_t on = walkers_.Add();
  walkers_.Copy(i, on);
  walkers_.at(Walkers::kX, on) = pose.x - (cosine * seen(0) - sine * seen(1));
  walkers_.at(Walkers::kY, on) = pose.y - (sine * seen(0) + cosine * seen(1));
  if constexpr (D == 4) walkers_.at(Walkers::kZ, on) = pose.z - seen(2);
  walkers_.at(Walkers::kHeading, on) = heading - turned;
  walkers_.at(Walkers::kCosine, on) = cosine;
  walkers_.at(Walkers::kSine, on) = sine;
  walkers_.at(Walkers::kStride, on) = Stride(direction);
  walkers_.at(Walkers::kLast, on) = last;
  const NodeIndex beyond = far + Stride(direction);
  Drift drift = DriftOf(on);
  const Evidence evidence = recent_.filter().Advance(
      t, SeenBy(on, table_.poses() + 4 * Position(beyond)), &drift);
  if (!(evidence.squared_innovation <= kSquaredInnovationLimit)) {
    walkers_.Remove(on);
    return;
  }
  Take(t, on, beyond, drift, evidence.log_likelihood_ratio,
       evidence.squared_innovation);
}

// Where keeping step may not be best, takes the likeliest of keeping step,
// staying and skipping a node; only keeping step where that is all the same for
// an end's only path. Returns false if none is possible.
template <int D>
inline bool PathWalk<D>::Slip(std::int64_t t, const Unsettled& unsettled,
                              bool is_only) {
  const std::size_t i = unsettled.walker;
  const WalkStep& step = recent_.step(t);
  // The log-likelihood ratio without any innovation from here on.
  const double most = walkers_.at(Walkers::kRatio, i) + step.surprise +
                      step.to_come - kSlipCost;
  const bool may_improve = most > walkers_.at(Walkers::kBestRatio, i);
  const bool is_needed = most + 0.25 * walkers_.at(Walkers::kSquared, i) >=
                         walkers_.at(Walkers::kNeeded, i);
  const bool slips = !is_only || (may_improve && is_needed);
  if (may_improve && !is_needed) CutShort(i);
  double gained = kImpossible;
  NodeIndex nodes = 0;
  const auto consider = [&](double squared, double cost, NodeIndex on) {
    // Written so that NaN fails too.
    if (!(squared <= kSquaredInnovationLimit)) return;
    if (!(step.surprise - 0.5 * squared - cost > gained)) return;
    gained = step.surprise - 0.5 * squared - cost;
    nodes = on;
  };
  consider(unsettled.squared_innovation, 0.0, 1);
  if (slips) {
    const NodeIndex node = walkers_.at(Walkers::kNode, i);
    const NodeIndex stride = walkers_.at(Walkers::kStride, i);
    const NodeIndex last = walkers_.at(Walkers::kLast, i);
    consider(SquaredInnovation(step, i, node), kSlipCost, 0);
    if (node != last && node + stride != last) {
      consider(SquaredInnovation(step, i, node + 2 * stride), kSlipCost, 2);
    }
  }
  if (gained == kImpossible) return false;
  const NodeIndex to =
      walkers_.at(Walkers::kNode, i) + nodes * walkers_.at(Walkers::kStride, i);
  Drift drift = DriftOf(i);
  const Evidence evidence = recent_.filter().Advance(
      t, SeenBy(i, table_.poses() + 4 * Position(to)), &drift);
  Take(t, i, to, drift, gained, evidence.squared_innovation);
  return true;
}

// Takes a walker one step on to a node.
template <int D>
inline void PathWalk<D>::Take(std::int64_t t, std::size_t i, NodeIndex to,
                              const Drift& drift, double gained,
                              double squared_innovation) {
  walkers_.at(Walkers::kNode, i) = to;
  const double ratio = walkers_.at(Walkers::kRatio, i) += gained;
  const double squares = walkers_.at(Walkers::kSquared, i) +=
      squared_innovation;
  for (int r = 0; r < D; ++r) {
    const auto row = static_cast<std::size_t>(r);
    walkers_.at(Walkers::kNow + row, i) = drift.now(r);
    walkers_.at(Walkers::kAtEnd + row, i) = drift.at_end(r);
  }
  if (!(ratio > walkers_.at(Walkers::kBestRatio, i))) return;
  walkers_.at(Walkers::kBestRatio, i) = ratio;
  walkers_.at(Walkers::kBestSquared, i) = squares;
  walkers_.at(Walkers::kBestSteps, i) = static_cast<double>(t);
  for (int r = 0; r < D; ++r) {
    walkers_.at(Walkers::kBestAtEnd + static_cast<std::size_t>(r), i) =
        drift.at_end(r);
  }
}

// For each end that walkers [first, size) reached a loop closure from: ends its
// paths that meet a likelier one, then all but the best kMostPaths.
template <int D>
void PathWalk<D>::Merge(std::size_t first, std::vector<char>* done) const {
  std::vector<std::int64_t> ends;
  for (std::size_t i = first; i < walkers_.size(); ++i) {
    ends.push_back(walkers_.at(Walkers::kEnd, i));
  }
  std::sort(ends.begin(), ends.end());
  ends.erase(std::unique(ends.begin(), ends.end()), ends.end());
  for (const std::int64_t end : ends) MergePathsOf(end, done);
}

template <int D>
void PathWalk<D>::MergePathsOf(std::int64_t end,
                               std::vector<char>* done) const {
  std::vector<std::size_t> paths;
  for (std::size_t i = 0; i < walkers_.size(); ++i) {
    if (walkers_.at(Walkers::kEnd, i) == end && !(*done)[i]) {
      paths.push_back(i);
    }
  }
  std::stable_sort(paths.begin(), paths.end(),
                   [this](std::size_t a, std::size_t b) {
                     return walkers_.at(Walkers::kRatio, a) >
                            walkers_.at(Walkers::kRatio, b);
                   });
  const auto meet = [&](std::size_t a, std::size_t b) {
    return walkers_.at(Walkers::kNode, a) == walkers_.at(Walkers::kNode, b) &&
           walkers_.at(Walkers::kStride, a) == walkers_.at(Walkers::kStride, b);
  };
  std::size_t kept = 0;
  for (std::size_t k = 0; k < paths.size(); ++k) {
    const std::size_t i = paths[k];
    const bool met =
        std::any_of(paths.begin(), paths.begin() + static_cast<int>(k),
                    [&](std::size_t likelier) {
                      return !(*done)[likelier] && meet(likelier, i);
                    });
    if (met || kept == kMostPaths) {
      (*done)[i] = 1;
    } else {
      ++kept;
    }
  }
}

// Takes the best of a path for its end's, if it is better than what the end's
// other paths have had.
template <int D>
inline void PathWalk<D>::Credit(std::size_t i) {
  const std::size_t end = Position(walkers_.at(Walkers::kEnd, i));
  const double ratio = walkers_.at(Walkers::kBestRatio, i);
  if (!(ratio > best_.log_likelihood_ratios[end])) return;
  best_.log_likelihood_ratios[end] = ratio;
  best_.squared_innovations[end] = walkers_.at(Walkers::kBestSquared, i);
  best_.change.row[end] =
      static_cast<std::int64_t>(walkers_.at(Walkers::kBestSteps, i));
  for (std::size_t r = 0; r < D; ++r) {
    best_.change.shift[r][end] = walkers_.at(Walkers::kBestAtEnd + r, i);
  }
  best_trail_ = walkers_.at(Walkers::kBestTrail, i);
}

template <int D>
void PathWalk<D>::Record(std::int64_t t) {
  for (std::size_t i = 0; i < walkers_.size(); ++i) {
    std::int64_t& trail = walkers_.at(Walkers::kTrail, i);
    trail_.push_back(
        {{t, walkers_.at(Walkers::kNode, i), DirectionAt(i)}, trail});
    trail = static_cast<std::int64_t>(trail_.size()) - 1;
    if (walkers_.at(Walkers::kBestSteps, i) == static_cast<double>(t)) {
      walkers_.at(Walkers::kBestTrail, i) = trail;
    }
  }
}

// The last node to be reached from i, walked this way.
template <int D>
inline NodeIndex PathWalk<D>::LastOf(NodeIndex i, Direction direction) const {
  return direction == Direction::kSame
             ? graph_.SegmentStart(i)
             : std::min(graph_.SegmentEnd(i), end_) - 1;
}

template <int D>
inline auto PathWalk<D>::DriftOf(std::size_t i) const -> Drift {
  Drift drift;
  for (int r = 0; r < D; ++r) {
    const auto row = static_cast<std::size_t>(r);
    drift.now(r) = walkers_.at(Walkers::kNow + row, i);
    drift.at_end(r) = walkers_.at(Walkers::kAtEnd + row, i);
  }
  return drift;
}

// A pose (x, y, z, heading) as walker i sees it from its end.
template <int D>
inline StateVector<D> PathWalk<D>::SeenBy(std::size_t i,
                                          const double* pose) const {
  const double x = pose[0] - walkers_.at(Walkers::kX, i);
  const double y = pose[1] - walkers_.at(Walkers::kY, i);
  const double cosine = walkers_.at(Walkers::kCosine, i);
  const double sine = walkers_.at(Walkers::kSine, i);
  const double forward = cosine * x + sine * y;
  const double left = cosine * y - sine * x;
  const double heading = pose[3] - walkers_.at(Walkers::kHeading, i);
  if constexpr (D == 3) {
    return {forward, left, heading};
  } else {
    return {forward, left, pose[2] - walkers_.at(Walkers::kZ, i), heading};
  }
}

// nu^T S^-1 nu of walker i, were it at this node next.
template <int D>
inline double PathWalk<D>::SquaredInnovation(const WalkStep& step,
                                             std::size_t i,
                                             NodeIndex node) const {
  const double* const pose = table_.poses() + 4 * Position(node);
  const double turn = walkers_.at(Walkers::kNow + D - 1, i);
  // Kept apart from the position: side by side in memory, the two would be
  // loaded as one vector before the stores to them are done.
  double heading =
      step.path[D - 1] - (pose[3] - walkers_.at(Walkers::kHeading, i)) - turn;
  // Off by a turn or two at most.
  while (heading > kPi) heading -= 2.0 * kPi;
  while (heading < -kPi) heading += 2.0 * kPi;
  // The last of the squares that are added up; headings of other roads differ
  // so much that it is often more than enough.
  const double of_heading = step.whitening[D - 1][D - 1] * heading;
  if (of_heading * of_heading > kSquaredInnovationLimit) {
    return of_heading * of_heading;
  }
  const StateVector<D> seen = SeenBy(i, pose);
  const double carried[2] = {-step.step_y * turn, step.step_x * turn};
  double position[D - 1];
  for (std::size_t r = 0; r < D - 1; ++r) {
    position[r] = step.path[r] - seen(static_cast<int>(r)) -
                  walkers_.at(Walkers::kNow + r, i);
    if (r < 2) position[r] -= carried[r];
  }
  double squared = 0.0;
  for (int r = 0; r < D; ++r) {
    double whitened = 0.0;
    for (int c = r; c < D - 1; ++c) {
      whitened += step.whitening[r][c] * position[c];
    }
    whitened += step.whitening[r][D - 1] * heading;
    squared += whitened * whitened;
  }
  return squared;
}

template class PathWalk<3>;
template class PathWalk<4>;

}  // namespace revisit::core
