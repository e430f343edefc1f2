#include "core/drive/frame_watch.h"

#include <algorithm>
#include <cmath>
#include <memory>
#include <optional>

#include "core/geometry/gap.h"
#include "core/geometry/heading.h"

namespace revisit::core {
namespace {

// The variance of the position after a way, by dead reckoning without noise.
double CarriedVariance(const Node& from, const Pose& to) {
  const Covariance& s = from.covariance;
  const double x = to.x - from.pose.x;
  const double y = to.y - from.pose.y;
  return PositionVariance(s) + 2.0 * (x * s(1, 3) - y * s(0, 3)) +
         (x * x + y * y) * s(3, 3);
}

double MetersBetween(const Pose& a, const Pose& b) {
  return std::hypot(b.x - a.x, b.y - a.y);
}

std::optional<std::int64_t> NanosecondsBetween(const Node& from,
                                               const Node& to) {
  std::int64_t apart = 0;
  if (!from.stamp_ns || !to.stamp_ns ||
      __builtin_sub_overflow(*to.stamp_ns, *from.stamp_ns, &apart)) {
    return std::nullopt;
  }
  return apart;
}

// Whether `after`, whose claims have fallen, lies on the very step over which
// they fall: there, they are those of the earlier pose by what is left of the
// step.
bool IsOnFallingStep(const Node& before, const Node& after) {
  return after.fraction > 0.0 &&
         PositionVariance(after.covariance) >=
             (1.0 - after.fraction) * PositionVariance(before.covariance);
}

// Whether the claims grow over a leap as over the whole way before it.
bool GrowsAsUsual(const Node& first, const Node& before, const Node& after) {
  const double travelled = before.travelled_meters - first.travelled_meters;
  if (travelled <= 0.0) return true;
  const double ways = FrameWatch::kUsualGrowth *
                      MetersBetween(before.pose, after.pose) / travelled;
  const auto heading = [](const Node& from, const Node& to) {
    return to.covariance(3, 3) - from.covariance(3, 3);
  };
  const auto position = [](const Node& from, const Node& to) {
    return PositionVariance(to.covariance) - CarriedVariance(from, to.pose);
  };
  // Nodes between two poses of one covariance have it but for rounding.
  constexpr double kRounding = 1e-9;
  return heading(before, after) <=
             ways * std::max(0.0, heading(first, before)) +
                 kRounding * after.covariance(3, 3) &&
         position(before, after) <=
             ways * std::max(0.0, position(first, before)) +
                 kRounding * PositionVariance(after.covariance);
}

bool HasReturned(const Pose& first, const Pose& pose, double return_meters) {
  const auto is_at = [&](const Pose& place) {
    return MetersBetween(place, pose) <= return_meters &&
           std::abs(WrapHeading(pose.heading - place.heading)) <=
               FrameWatch::kReturnRadians;
  };
  return is_at(first) || is_at(Pose());
}

// From one stretch between two poses to another one.
struct Way {
  // The first node of the drive.
  Node first;
  Node before;
  // The last node of the step between the two; none for a jump.
  std::optional<Node> middle;
  Node after;
  // The step before.
  double usual_meters = 0.0;
};

// Whether Judge() can find a frame at all: most ways are neither leaps nor have
// claims that fall, and for these little is read of the graph.
bool MayBegin(const PoseGraph& graph, NodeIndex before, NodeIndex after) {
  const Pose from = graph.pose(before);
  const Pose to = graph.pose(after);
  return !Gap(to.x - from.x, to.y - from.y).IsBelow(FrameWatch::kLeapMeters) ||
         FrameWatch::kFall * PositionVariance(graph.covariance(after)) <
             PositionVariance(graph.covariance(before));
}

// The frame that begins with the way; nothing if none does.
std::optional<NewFrame> Judge(const Way& way, double return_meters) {
  constexpr double kFall = FrameWatch::kFall;
  const auto& [first, before, middle, after, usual_meters] = way;
  const double meters = MetersBetween(before.pose, after.pose);
  const bool is_leap = meters >= FrameWatch::kLeapMeters &&
                       meters >= FrameWatch::kUsualSteps * usual_meters;
  const double was = PositionVariance(before.covariance);
  const double is = PositionVariance(after.covariance);
  const double heading_was = before.covariance(3, 3);
  const double heading_is = after.covariance(3, 3);
  const bool has_fallen = kFall * is < was &&
                          kFall * is < CarriedVariance(before, after.pose) &&
                          (kFall * heading_is < heading_was ||
                           (is_leap && heading_is <= heading_was));
  const bool has_returned =
      is_leap && HasReturned(first.pose, after.pose, return_meters) &&
      GrowsAsUsual(first, before, after);
  if (!has_fallen && !has_returned) return std::nullopt;
  NewFrame frame;
  if (!middle) {
    frame.sequence = after.sequence;
  } else {
    const bool is_on_step = has_fallen && IsOnFallingStep(*middle, after);
    frame.sequence = (is_on_step ? after.sequence : middle->sequence) + 1;
  }
  frame.meters = meters;
  frame.before = DeviationsOf(before.covariance);
  frame.after = DeviationsOf(after.covariance);
  frame.claims_fall = has_fallen;
  frame.nanoseconds = NanosecondsBetween(before, after);
  return frame;
}

}  // namespace

void FrameWatch::Extend(const PoseGraph& graph, const DroppedStretches& dropped,
                        const Recordings& recordings,
                        double node_spacing_meters) {
  const double return_meters = node_spacing_meters + kReturnMeters;
  for (; next_ < graph.size(); ++next_) {
    const std::vector<DroppedStretches::Gap>& gaps = dropped.gaps();
    bool is_behind_gap = false;
    for (; gaps_ < gaps.size() && gaps[gaps_].node <= next_; ++gaps_) {
      is_behind_gap = true;
    }
    const NodeIndex first = recordings[recordings.Of(next_)].first_node;
    Look(graph, next_, first, is_behind_gap || next_ == first, return_meters);
  }
}

void FrameWatch::Look(const PoseGraph& graph, NodeIndex index, NodeIndex first,
                      bool is_behind_gap, double return_meters) {
  if (is_behind_gap) ends_count_ = 0;
  const std::uint64_t sequence = graph.node(index).sequence;
  const bool is_behind_jump =
      graph.SegmentStart(index) == index && ends_count_ > 0;
  const bool is_behind_step =
      !is_behind_jump && ends_count_ > 1 && sequence != end_sequence_;
  // If the step itself has nodes, End(0) is the last one on it.
  const std::size_t before = is_behind_jump ? 0 : 1;
  if ((is_behind_jump || is_behind_step) &&
      MayBegin(graph, End(before), index)) {
    Way way;
    way.first = graph.node(first);
    way.before = graph.node(End(before));
    if (is_behind_step) way.middle = graph.node(End(0));
    way.after = graph.node(index);
    if (before + 1 < ends_count_) {
      way.usual_meters =
          MetersBetween(graph.pose(End(before + 1)), way.before.pose);
    }
    if (const std::optional<NewFrame> frame = Judge(way, return_meters)) {
      last_ = std::make_unique<const NewFrame>(*frame);
      // Nodes behind a new frame are compared with none before it.
      ends_count_ = 0;
    }
  }
  if (is_behind_jump) ends_count_ = 0;
  AddEnd(index, sequence);
}

void FrameWatch::AddEnd(NodeIndex index, std::uint64_t sequence) {
  if (ends_count_ > 0 && sequence == end_sequence_) {
    ends_[ends_count_ - 1] = index;
    return;
  }
  if (ends_count_ == ends_.size()) {
    std::move(ends_.begin() + 1, ends_.end(), ends_.begin());
    --ends_count_;
  }
  ends_[ends_count_++] = index;
  end_sequence_ = sequence;
}

}  // namespace revisit::core
