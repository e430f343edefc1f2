#include "core/drive/frame_watch.h"

#include <algorithm>
#include <cmath>
#include <limits>

#include "core/geometry/heading.h"

namespace revisit::core {
namespace {

double PositionVariance(const Covariance& s) { return s(0, 0) + s(1, 1); }

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

NewFrame::Claims ClaimsOf(const Node& node) {
  return {std::sqrt(0.5 * PositionVariance(node.covariance)),
          std::sqrt(node.covariance(3, 3))};
}

}  // namespace

void FrameWatch::Extend(const PoseGraph& graph,
                        const DroppedStretches& dropped) {
  for (; next_ < graph.size(); ++next_) {
    const std::vector<DroppedStretches::Gap>& gaps = dropped.gaps();
    bool is_behind_gap = false;
    for (; gaps_ < gaps.size() && gaps[gaps_].node <= next_; ++gaps_) {
      is_behind_gap = true;
    }
    const Node node = graph.node(next_);
    if (next_ == 0) first_ = node;
    Look(node, graph.SegmentStart(next_) == next_, is_behind_gap);
  }
}

void FrameWatch::Look(const Node& node, bool starts_segment,
                      bool is_behind_gap) {
  if (is_behind_gap) ends_count_ = 0;
  const std::uint64_t before = last_ ? last_->sequence : 0;
  if (starts_segment && ends_count_ > 0) {
    const double usual =
        ends_count_ > 1 ? MetersBetween(End(1).pose, End(0).pose) : 0.0;
    Judge(End(0), nullptr, node, usual);
    ends_count_ = 0;
  } else if (ends_count_ > 1 && node.sequence != End(0).sequence) {
    const double usual =
        ends_count_ > 2 ? MetersBetween(End(2).pose, End(1).pose) : 0.0;
    Judge(End(1), &End(0), node, usual);
  }
  // What lies behind a new frame is compared with nothing before it.
  if (last_ && last_->sequence != before) ends_count_ = 0;
  AddEnd(node);
}

void FrameWatch::Judge(const Node& before, const Node* middle,
                       const Node& after, double usual_meters) {
  const double meters = MetersBetween(before.pose, after.pose);
  const bool is_leap =
      meters >= kLeapMeters && meters >= kUsualSteps * usual_meters;
  const double was = PositionVariance(before.covariance);
  const double is = PositionVariance(after.covariance);
  const double heading_was = before.covariance(3, 3);
  const double heading_is = after.covariance(3, 3);
  const bool has_fallen = kFall * is < was &&
                          kFall * is < CarriedVariance(before, after.pose) &&
                          (kFall * heading_is < heading_was ||
                           (is_leap && heading_is <= heading_was));
  const bool has_returned =
      is_leap && HasReturned(after.pose) && GrowsAsUsual(before, after);
  if (!has_fallen && !has_returned) return;
  NewFrame frame;
  if (middle == nullptr) {
    frame.sequence = after.sequence;
  } else {
    const bool is_on_step = has_fallen && IsOnFallingStep(*middle, after);
    frame.sequence = (is_on_step ? after.sequence : middle->sequence) + 1;
  }
  frame.meters = meters;
  frame.before = ClaimsOf(before);
  frame.after = ClaimsOf(after);
  frame.claims_fall = has_fallen;
  frame.nanoseconds = NanosecondsBetween(before, after);
  last_ = frame;
}

bool FrameWatch::HasReturned(const Pose& pose) const {
  const auto is_at = [&](const Pose& place) {
    return MetersBetween(place, pose) <= return_meters_ &&
           std::abs(WrapHeading(pose.heading - place.heading)) <=
               kReturnRadians;
  };
  return is_at(first_.pose) || is_at(Pose());
}

bool FrameWatch::GrowsAsUsual(const Node& before, const Node& after) const {
  const double travelled = before.travelled_meters - first_.travelled_meters;
  if (travelled <= 0.0) return true;
  const double ways =
      kUsualGrowth * MetersBetween(before.pose, after.pose) / travelled;
  const auto heading = [](const Node& from, const Node& to) {
    return to.covariance(3, 3) - from.covariance(3, 3);
  };
  const auto position = [](const Node& from, const Node& to) {
    return PositionVariance(to.covariance) - CarriedVariance(from, to.pose);
  };
  // Nodes between two poses of one covariance have it but for rounding.
  constexpr double kRounding = 1e-9;
  return heading(before, after) <=
             ways * std::max(0.0, heading(first_, before)) +
                 kRounding * after.covariance(3, 3) &&
         position(before, after) <=
             ways * std::max(0.0, position(first_, before)) +
                 kRounding * PositionVariance(after.covariance);
}

void FrameWatch::AddEnd(const Node& node) {
  if (ends_count_ > 0 && ends_[ends_count_ - 1].sequence == node.sequence) {
    ends_[ends_count_ - 1] = node;
    return;
  }
  if (ends_count_ == ends_.size()) {
    std::move(ends_.begin() + 1, ends_.end(), ends_.begin());
    --ends_count_;
  }
  ends_[ends_count_++] = node;
}

}  // namespace revisit::core
