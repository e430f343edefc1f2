#include "core/drive/stamps.h"

#include <algorithm>
#include <cassert>
#include <limits>

#include "core/drive/pose_graph.h"

namespace revisit::core {
namespace {

// A leap is longer than the greatest age divided by this. Shorter ones may
// count at once: they drop nothing that is younger than nine tenths of it.
constexpr std::int64_t kAgeByLeap = 10;

// Whether `later` is later than `earlier` by more than this.
bool IsLaterBy(std::int64_t later, std::int64_t earlier, std::int64_t by) {
  std::int64_t apart = 0;
  if (__builtin_sub_overflow(later, earlier, &apart)) return later > earlier;
  return apart > by;
}

std::optional<std::int64_t> VoteOf(const PoseGraph& graph, NodeIndex i,
                                   const AgeRules& rules) {
  const Node node = graph.node(i);
  if (!node.stamp_ns || (rules.latest_ns && *node.stamp_ns > *rules.latest_ns))
    return std::nullopt;
  if (i > 0 && graph.node(i - 1).sequence == node.sequence) return std::nullopt;
  return node.stamp_ns;
}

std::size_t MostVotes(const AgeRules& rules) {
  return static_cast<std::size_t>(2 * rules.agreeing_nodes - 1);
}

}  // namespace

std::optional<std::int64_t> AgreedStamp(const PoseGraph& graph, NodeIndex count,
                                        const AgeRules& rules) {
  assert(rules.agreeing_nodes > 0 && 0 <= count && count <= graph.size());
  const std::size_t most = MostVotes(rules);
  std::vector<std::int64_t> votes;
  votes.reserve(most);
  for (NodeIndex i = count; i > 0 && votes.size() < most; --i) {
    if (const auto vote = VoteOf(graph, i - 1, rules)) votes.push_back(*vote);
  }
  if (votes.size() < most) return std::nullopt;
  const auto middle = votes.begin() + (rules.agreeing_nodes - 1);
  std::nth_element(votes.begin(), middle, votes.end());
  return *middle;
}

std::optional<std::int64_t> OldestStamp(const PoseGraph& graph,
                                        const AgeRules& rules) {
  const NodeIndex before =
      std::max<NodeIndex>(0, graph.size() - rules.newest_nodes);
  const auto lasted = AgreedStamp(graph, before, rules);
  if (!lasted) return std::nullopt;
  const auto last = AgreedStamp(graph, graph.size(), rules);
  if (!last) return std::nullopt;
  const bool leapt = IsLaterBy(*last, *lasted, rules.max_age_ns / kAgeByLeap);
  std::int64_t oldest = 0;
  if (__builtin_sub_overflow(leapt ? *lasted : *last, rules.max_age_ns,
                             &oldest)) {
    return std::nullopt;
  }
  return oldest;
}

OldNodes::OldNodes(const PoseGraph& graph, const AgeRules& rules)
    : graph_(graph),
      rules_(rules),
      oldest_ns_(OldestStamp(graph, rules)),
      young_(MostVotes(rules), false),
      in_old_begin_(oldest_ns_.has_value()) {}

bool OldNodes::IsTooOld(NodeIndex i) {
  if (!in_old_begin_) return false;
  if (const auto vote = VoteOf(graph_, i, rules_)) {
    const std::size_t at = votes_++ % young_.size();
    const bool is_young = *vote >= *oldest_ns_;
    young_count_ += (is_young ? 1 : 0) - (young_[at] ? 1 : 0);
    young_[at] = is_young;
    in_old_begin_ = young_count_ < rules_.agreeing_nodes;
    if (!in_old_begin_) return false;
  }
  const std::optional<std::int64_t> stamp = graph_.node(i).stamp_ns;
  return stamp && *stamp < *oldest_ns_;
}

LeapWatch::LeapWatch(std::optional<std::int64_t> max_age_ns,
                     NodeIndex newest_nodes)
    : max_age_ns_(max_age_ns), newest_nodes_(newest_nodes) {}

void LeapWatch::Extend(const PoseGraph& graph,
                       const DroppedStretches& dropped) {
  if (!max_age_ns_) return;
  const NodeIndex reach = newest_nodes_ + kReach;
  // Leaps before these are not told, and these need not be compared with more.
  next_ = std::max(next_, graph.size() - newest_nodes_ - reach);
  for (; next_ < graph.size(); ++next_) {
    const std::vector<DroppedStretches::Gap>& gaps = dropped.gaps();
    for (; gaps_ < gaps.size() && gaps[gaps_].node <= next_; ++gaps_) {
      last_.reset();
    }
    const Node node = graph.node(next_);
    if (node.sequence != sequence_) {
      before_ = last_;
      sequence_ = node.sequence;
    }
    if (!node.stamp_ns) continue;
    last_ = Stamp{next_, *node.stamp_ns};
    if (!before_ || next_ - before_->node > reach ||
        !IsLaterBy(*node.stamp_ns, before_->ns, *max_age_ns_)) {
      continue;
    }
    StampLeap leap;
    leap.sequence = node.sequence + (node.fraction > 0.0 ? 1 : 0);
    if (__builtin_sub_overflow(*node.stamp_ns, before_->ns,
                               &leap.nanoseconds)) {
      leap.nanoseconds = std::numeric_limits<std::int64_t>::max();
    }
    leap_ = std::make_unique<const Leap>(Leap{next_, leap});
  }
}

std::optional<StampLeap> LeapWatch::leap() const {
  return leap_ && leap_->node >= next_ - newest_nodes_
             ? std::optional<StampLeap>(leap_->leap)
             : std::nullopt;
}

}  // namespace revisit::core
