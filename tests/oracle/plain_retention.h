// DroppableSearch as its header says it, over all pairs of nodes: O(n^2).
#ifndef REVISIT_TESTS_ORACLE_PLAIN_RETENTION_H_
#define REVISIT_TESTS_ORACLE_PLAIN_RETENTION_H_

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <map>
#include <optional>
#include <set>
#include <tuple>
#include <utility>
#include <vector>

#include "core/drive/node_noise.h"
#include "core/drive/node_range.h"
#include "core/drive/pose_graph.h"
#include "core/drive/retention.h"
#include "core/geometry/heading.h"

namespace revisit::core {

class PlainRetention {
 public:
  PlainRetention(const PoseGraph& graph, const RetentionOptions& options,
                 const RetentionNeeds& needs,
                 std::optional<std::int64_t> latest_ns = std::nullopt)
      : graph_(graph), options_(options), needs_(needs), latest_(latest_ns) {
    FindVotes();
    FindAge();
  }

  std::vector<NodeRange> Droppable() const {
    const std::set<NodeIndex> covered = Covered();
    std::set<NodeIndex> unwanted;
    for (NodeIndex i = 0; i < graph_.size(); ++i) {
      if (MustStay(i)) continue;
      if (IsTooOld(i) || (covered.count(i) > 0 && !LeadsToWanted(i, covered))) {
        unwanted.insert(i);
      }
    }
    std::vector<NodeRange> ranges;
    for (const NodeIndex i : unwanted) {
      if (ranges.empty() || ranges.back().last != i) ranges.push_back({i, i});
      ranges.back().last = i + 1;
    }
    const auto is_short = [&](const NodeRange& range) {
      for (NodeIndex i = range.first; i < range.last; ++i) {
        if (IsTooOld(i)) return false;
      }
      return range.last - range.first < needs_.least_nodes;
    };
    ranges.erase(std::remove_if(ranges.begin(), ranges.end(), is_short),
                 ranges.end());
    return ranges;
  }

 private:
  bool IsTooOld(NodeIndex i) const {
    const auto stamp = graph_.node(i).stamp_ns;
    return oldest_ && i < old_begin_ && stamp && *stamp < *oldest_;
  }

  // As stamps.h says it, for stamps that are less than centuries apart.
  void FindAge() {
    if (!options_.max_age_ns) return;
    const auto last = Agreed(graph_.size());
    const auto lasted = Agreed(graph_.size() - needs_.newest_nodes);
    if (!last || !lasted) return;
    const bool leapt = *last - *lasted > *options_.max_age_ns / 10;
    oldest_ = (leapt ? *lasted : *last) - *options_.max_age_ns;
    const auto is_young = [this](std::int64_t vote) {
      return vote >= *oldest_;
    };
    for (old_begin_ = 0; old_begin_ < graph_.size(); ++old_begin_) {
      const auto votes = LastVotes(old_begin_ + 1);
      if (std::count_if(votes.begin(), votes.end(), is_young) >=
          needs_.agreeing_nodes) {
        break;
      }
    }
  }

  std::optional<std::int64_t> Agreed(NodeIndex count) const {
    std::vector<std::int64_t> votes = LastVotes(count);
    if (votes.size() < MostVotes()) return std::nullopt;
    std::sort(votes.begin(), votes.end());
    return votes[MostVotes() / 2];
  }

  void FindVotes() {
    for (NodeIndex i = 0; i < graph_.size(); ++i) {
      const Node node = graph_.node(i);
      const bool is_first =
          i == 0 || graph_.node(i - 1).sequence != node.sequence;
      const bool may_be = !latest_ || node.stamp_ns <= latest_;
      if (node.stamp_ns && is_first && may_be) votes_[i] = *node.stamp_ns;
    }
  }

  // Among the first nodes.
  std::vector<std::int64_t> LastVotes(NodeIndex count) const {
    std::vector<std::int64_t> last;
    for (auto it = votes_.lower_bound(count);
         it != votes_.begin() && last.size() < MostVotes();) {
      last.push_back((--it)->second);
    }
    return last;
  }

  std::size_t MostVotes() const {
    return static_cast<std::size_t>(2 * needs_.agreeing_nodes - 1);
  }

  bool MustStay(NodeIndex i) const {
    if (i >= graph_.size() - needs_.newest_nodes) return true;
    for (const NodeIndex start : needs_.recording_starts) {
      if (i == start - 1 || i == start) return true;
    }
    return std::any_of(
        needs_.loop_ends.begin(), needs_.loop_ends.end(), [&](NodeIndex end) {
          return graph_.SegmentStart(i) == graph_.SegmentStart(end) &&
                 end - i <= needs_.aligned_nodes &&
                 static_cast<double>(i - end) <
                     kPassRadiusMeters / needs_.spacing_meters + 1.0;
        });
  }

  int Quality(NodeIndex i) const {
    const Covariance s = graph_.covariance(i);
    const double z = needs_.state_space == StateSpace::kPlanar ? 0.0 : s(2, 2);
    return std::ilogb(std::sqrt(s(0, 0) + s(1, 1) + z));
  }

  std::set<NodeIndex> Covered() const {
    std::set<NodeIndex> covered;
    if (options_.max_passes == 0) return covered;
    std::vector<std::pair<int, NodeIndex>> ranked;
    for (NodeIndex i = 0; i < graph_.size(); ++i) {
      if (MustStay(i) || !IsTooOld(i)) ranked.emplace_back(Quality(i), -i);
    }
    std::sort(ranked.begin(), ranked.end());
    std::set<NodeIndex> kept;
    std::map<std::tuple<std::int64_t, double, double>, int> in_cell;
    for (const auto& entry : ranked) {
      const NodeIndex i = -entry.second;
      if (!MustStay(i) && Passes(i, kept) >= options_.max_passes) {
        covered.insert(i);
        continue;
      }
      const Pose pose = graph_.pose(i);
      int& held = in_cell[{RecordingOf(i), std::floor(pose.x / Reach()),
                           std::floor(pose.y / Reach())}];
      if (i % Stride() == 0 && !IsFarOff(i) &&
          held < 16 * options_.max_passes) {
        ++held;
        kept.insert(i);
      }
    }
    return covered;
  }

  // Sure of no place under a model in which no error goes away.
  bool IsFarOff(NodeIndex i) const {
    const auto model = needs_.correlation.model;
    const Covariance s = graph_.covariance(i);
    const double z = needs_.state_space == StateSpace::kPlanar ? 0.0 : s(2, 2);
    return (model == CorrelationModel::kIndependent ||
            model == CorrelationModel::kFilter) &&
           s(0, 0) + s(1, 1) + z > Reach() * Reach();
  }

  std::int64_t RecordingOf(NodeIndex i) const {
    return std::count_if(needs_.recording_starts.begin(),
                         needs_.recording_starts.end(),
                         [i](NodeIndex start) { return start <= i; });
  }

  int Passes(NodeIndex i, const std::set<NodeIndex>& kept) const {
    const double separation = std::max(needs_.separation_meters, 4.0 * Reach());
    int passes = 0;
    double last = -1e300;
    for (const NodeIndex j : kept) {
      const double at = graph_.node(j).travelled_meters;
      if (RecordingOf(j) != RecordingOf(i)) continue;
      if (at - last < separation || graph_.MetersApart(i, j) < separation ||
          !AreOnePlace(i, j)) {
        continue;
      }
      last = at;
      ++passes;
    }
    return passes;
  }

  bool AreOnePlace(NodeIndex i, NodeIndex j) const {
    const Pose a = graph_.pose(i);
    const Pose b = graph_.pose(j);
    const bool planar = needs_.state_space == StateSpace::kPlanar;
    const double d = std::hypot(a.x - b.x, a.y - b.y, planar ? 0.0 : a.z - b.z);
    if (d > Reach()) return false;
    Eigen::Vector4d g = Gamma(i, j);
    if (needs_.correlation.model == CorrelationModel::kFilter ||
        g.minCoeff() < 0.0) {
      const Covariance s = graph_.covariance(i);
      const Covariance t = graph_.covariance(j);
      for (int k = 0; k < 4; ++k) g(k) = 2.0 * (s(k, k) + t(k, k));
      if (planar) g(2) = 0.0;
    }
    const double spread = g(0) + g(1) + g(2);
    const double turn = WrapHeading(a.heading - b.heading);
    const double half =
        0.5 * static_cast<double>(Stride()) * needs_.spacing_meters;
    const double reach = std::pow(kPassRadiusMeters, 2) + half * half;
    return d * d + spread <= reach &&
           d * d <= 4.0 * std::pow(needs_.tolerance_meters, 2) + half * half +
                        spread &&
           turn * turn + g(3) <= kPi * kPi / 16.0;
  }

  // Variances of x, y, z (0 in the plane) and heading.
  Eigen::Vector4d Gamma(NodeIndex i, NodeIndex j) const {
    if (needs_.correlation.model == CorrelationModel::kFilter) {
      return Eigen::Vector4d::Zero();
    }
    if (needs_.state_space == StateSpace::kSpatial) {
      return DifferenceCovariance<4>(graph_, needs_.correlation, i, j)
          .diagonal();
    }
    const Eigen::Vector3d g =
        DifferenceCovariance<3>(graph_, needs_.correlation, i, j).diagonal();
    return {g(0), g(1), 0.0, g(2)};
  }

  bool LeadsToWanted(NodeIndex i, const std::set<NodeIndex>& covered) const {
    for (NodeIndex k = i; k < i + needs_.aligned_nodes && k < graph_.size();
         ++k) {
      if (graph_.SegmentStart(k) != graph_.SegmentStart(i)) return false;
      if (!MustStay(k) && !IsTooOld(k) && covered.count(k) == 0) return true;
    }
    return false;
  }

  NodeIndex Stride() const {
    return std::max<NodeIndex>(
        1, static_cast<NodeIndex>(2.0 / needs_.spacing_meters));
  }
  double Reach() const {
    return std::hypot(kPassRadiusMeters, 0.5 * static_cast<double>(Stride()) *
                                             needs_.spacing_meters);
  }

  const PoseGraph& graph_;
  const RetentionOptions& options_;
  const RetentionNeeds& needs_;
  const std::optional<std::int64_t> latest_;
  std::map<NodeIndex, std::int64_t> votes_;
  std::optional<std::int64_t> oldest_;
  NodeIndex old_begin_ = 0;
};

}  // namespace revisit::core

#endif  // REVISIT_TESTS_ORACLE_PLAIN_RETENTION_H_
