#include "core/drive/distance_resampler.h"

#include <Eigen/LU>
#include <algorithm>
#include <cassert>
#include <cmath>

#include "core/geometry/heading.h"
#include "core/geometry/state_matrix.h"

namespace revisit::core {
namespace {

Covariance Interpolate(const Covariance& a, const Covariance& b, double f) {
  Covariance between;
  for (std::size_t i = 0; i < between.upper.size(); ++i) {
    between.upper[i] = (1.0 - f) * a.upper[i] + f * b.upper[i];
  }
  return between;
}

Pose Interpolate(const Pose& a, const Pose& b, double f) {
  const Pose step = Difference(b, a);
  return {a.x + f * step.x, a.y + f * step.y, a.z + f * step.z,
          WrapHeading(a.heading + f * step.heading)};
}

// The error transition over the part from `from` to `to` of a step whose error
// transition is `whole`. Errors are interpolated linearly along the step: at f
// the error is ((1-f) I + f whole) e. These matrices are functions of one
// matrix, so they commute.
Eigen::Matrix4d PartialTransition(const Eigen::Matrix4d& whole, double from,
                                  double to) {
  const auto at = [&whole](double f) -> Eigen::Matrix4d {
    return (1.0 - f) * Eigen::Matrix4d::Identity() + f * whole;
  };
  if (from == 0.0) return at(to);
  return at(to) * at(from).inverse();
}

// No path is longer: farther on, the spacing would be lost in rounding.
double LongestPath(double spacing_meters) { return 1e12 * spacing_meters; }

// Nanoseconds that std::llround() can round.
constexpr double kMostStampSpan = 9e18;

}  // namespace

DistanceResampler::DistanceResampler(const ResamplerOptions& options)
    : options_(options) {
  assert(options.spacing_meters > 0.0 && options.max_step_meters > 0.0);
}

std::optional<Jump> DistanceResampler::Add(const PoseSample& sample,
                                           PoseGraph* graph) {
  if (!anchor_) {
    StartSegment(sample, std::nullopt, graph);
    return std::nullopt;
  }
  if (options_.carry_transitions && sample.transition) {
    anchor_to_last_ =
        (ToMatrix<4>(*sample.transition) * anchor_to_last_).eval();
  }
  if (sample.recording_start) {
    // Errors of one recording tell nothing of those of another.
    if (options_.carry_transitions) node_to_anchor_.setZero();
    StartSegment(sample, std::nullopt, graph);
    return std::nullopt;
  }
  const double step =
      Distance(anchor_->pose, sample.pose, options_.state_space);
  if (has_skipped_ || options_.IsJump(step)) {
    const bool is_jump = !has_skipped_;
    node_to_anchor_ = anchor_to_last_ * node_to_anchor_;
    StartSegment(sample, InForce(sample), graph);
    if (!is_jump) return std::nullopt;
    return Jump{sample.sequence, step};
  }
  if (options_.IsStandstill(step)) {
    last_sequence_ = sample.sequence;
    SetLastStamp(sample.stamp_ns);
  } else {
    const std::optional<CarriedCovariance> in_force = InForce(sample);
    // Fraction of this step at which the last node lies.
    double reached = 0.0;
    while (true) {
      // A product and not a running sum, so that rounding errors do not add up.
      const double mark =
          segment_start_meters_ +
          static_cast<double>(segment_nodes_) * options_.spacing_meters;
      // Rounding can put the mark slightly before the anchor.
      const double f = std::max(0.0, (mark - travelled_meters_) / step);
      if (f > 1.0) break;
      if (options_.carry_transitions) {
        node_to_anchor_ =
            PartialTransition(anchor_to_last_, reached, f) * node_to_anchor_;
      }
      AddNode(sample, in_force, f, /*starts_segment=*/false, graph);
      reached = f;
    }
    if (options_.carry_transitions && reached < 1.0) {
      node_to_anchor_ =
          PartialTransition(anchor_to_last_, reached, 1.0) * node_to_anchor_;
    }
    travelled_meters_ += step;
    SetAnchor(sample, in_force);
  }
  return std::nullopt;
}

void DistanceResampler::Skip(std::uint64_t last_sequence, double meters,
                             const std::optional<ErrorTransition>& transition) {
  assert(meters >= 0.0);
  travelled_meters_ = std::max(travelled_meters_,
                               std::min(travelled_meters_ + meters,
                                        LongestPath(options_.spacing_meters)));
  last_sequence_ = last_sequence;
  SetLastStamp(std::nullopt);
  if (!anchor_) return;
  has_skipped_ = true;
  if (options_.carry_transitions && transition) {
    anchor_to_last_ = (ToMatrix<4>(*transition) * anchor_to_last_).eval();
  }
}

void DistanceResampler::Save(ByteWriter* writer) const {
  writer->PutOptional(anchor_);
  writer->PutOptional(carried_ ? std::optional<Carried>(*carried_)
                               : std::nullopt);
  writer->Put(last_sequence_);
  writer->PutOptional(last_stamp_ns());
  writer->Put(travelled_meters_);
  writer->Put(segment_start_meters_);
  writer->Put(segment_nodes_);
  writer->Put(static_cast<std::uint8_t>(has_skipped_ ? 1 : 0));
  for (const Eigen::Matrix4d* matrix : {&node_to_anchor_, &anchor_to_last_}) {
    writer->PutArray(matrix->data(), 16);
  }
}

bool DistanceResampler::Load(const PoseGraph& graph,
                             std::uint64_t last_sequence, ByteReader* reader) {
  std::uint8_t has_skipped = 0;
  std::optional<Carried> carried;
  std::optional<std::int64_t> last_stamp_ns;
  if (!reader->GetOptional(&anchor_) || !reader->GetOptional(&carried) ||
      !reader->Get(&last_sequence_) || !reader->GetOptional(&last_stamp_ns) ||
      !reader->Get(&travelled_meters_) ||
      !reader->Get(&segment_start_meters_) || !reader->Get(&segment_nodes_) ||
      !reader->Get(&has_skipped) || has_skipped > 1) {
    return false;
  }
  SetLastStamp(last_stamp_ns);
  has_skipped_ = has_skipped == 1;
  if (carried) carried_ = std::make_unique<Carried>(*carried);
  for (Eigen::Matrix4d* matrix : {&node_to_anchor_, &anchor_to_last_}) {
    if (!reader->GetArray(matrix->data(), 16) ||
        !AreFinite(matrix->data(), 16)) {
      return false;
    }
  }
  if (!anchor_) {
    return graph.size() == 0 && last_sequence_ == last_sequence &&
           travelled_meters_ >= 0.0 &&
           travelled_meters_ <= LongestPath(options_.spacing_meters);
  }
  if (graph.size() == 0) return false;
  const auto is_sound = [&](const Covariance& covariance) {
    return !FindDefect({last_sequence_, last_stamp_ns, anchor_->pose,
                        covariance, std::nullopt},
                       options_.state_space);
  };
  const double spacing = options_.spacing_meters;
  const Node last = graph.node(graph.size() - 1);
  const double last_mark =
      segment_start_meters_ + static_cast<double>(segment_nodes_ - 1) * spacing;
  // From a place far behind, or so far on that a spacing is lost in rounding,
  // the next step would add nodes without end.
  return last_sequence_ == last_sequence && last.sequence <= last_sequence &&
         is_sound(anchor_->claim) &&
         (!carried_ || (options_.carry_claims && carried_->counts <= 1 &&
                        carried_->has_reset <= 1)) &&
         (in_force() == nullptr || is_sound(in_force()->covariance)) &&
         segment_nodes_ > 0 && segment_nodes_ <= graph.size() &&
         segment_start_meters_ >= 0.0 &&
         std::abs(last_mark - last.travelled_meters) <= 1e-3 * spacing &&
         travelled_meters_ >= last.travelled_meters - spacing &&
         (has_skipped_ ||
          travelled_meters_ <= last.travelled_meters + 2.0 * spacing) &&
         travelled_meters_ <= LongestPath(spacing);
}

std::optional<CarriedCovariance> DistanceResampler::InForce(
    const PoseSample& sample) const {
  if (!options_.carry_claims) return std::nullopt;
  return CarriedClaim(options_.state_space, *anchor_, in_force(),
                      {sample.pose, sample.covariance});
}

void DistanceResampler::SetAnchor(
    const PoseSample& sample,
    const std::optional<CarriedCovariance>& in_force) {
  const ClaimedPose now{sample.pose, sample.covariance};
  if (in_force && !carried_) carried_ = std::make_unique<Carried>();
  if (carried_) {
    carried_->counts = in_force ? 1 : 0;
    carried_->in_force = in_force.value_or(CarriedCovariance());
  }
  if (in_force && IsGivenUp(*anchor_, now)) {
    carried_->has_reset = 1;
    carried_->reset = {sample.sequence, DeviationsOf(anchor_->claim),
                       DeviationsOf(now.claim)};
  }
  anchor_ = now;
  if (options_.carry_transitions) anchor_to_last_.setIdentity();
  last_sequence_ = sample.sequence;
  SetLastStamp(sample.stamp_ns);
}

void DistanceResampler::StartSegment(
    const PoseSample& sample, const std::optional<CarriedCovariance>& in_force,
    PoseGraph* graph) {
  SetAnchor(sample, in_force);
  has_skipped_ = false;
  segment_start_meters_ = travelled_meters_;
  segment_nodes_ = 0;
  AddNode(sample, in_force, 1.0, /*starts_segment=*/true, graph);
}

// Adds the node at fraction f in (0, 1] of the step from the anchor to this
// sample.
void DistanceResampler::AddNode(
    const PoseSample& sample, const std::optional<CarriedCovariance>& in_force,
    double f, bool starts_segment, PoseGraph* graph) {
  const Covariance& covariance =
      in_force ? in_force->covariance : sample.covariance;
  Node node;
  node.travelled_meters =
      segment_start_meters_ +
      static_cast<double>(segment_nodes_) * options_.spacing_meters;
  if (f == 1.0) {
    node.sequence = sample.sequence;
    node.stamp_ns = sample.stamp_ns;
    node.pose = sample.pose;
    node.pose.heading = WrapHeading(sample.pose.heading);
    node.covariance = covariance;
  } else {
    // While the vehicle stood still, only time passed: the step begins where
    // the anchor is, but at the time of the last pose.
    node.sequence = last_sequence_;
    node.fraction = f;
    if (has_last_stamp_ && sample.stamp_ns) {
      const double span = static_cast<double>(*sample.stamp_ns) -
                          static_cast<double>(last_stamp_ns_);
      // Stamps may be centuries apart. A node whose stamp would not fit has
      // none.
      std::int64_t stamp_ns = 0;
      if (std::abs(span) < kMostStampSpan &&
          !__builtin_add_overflow(last_stamp_ns_, std::llround(f * span),
                                  &stamp_ns)) {
        node.stamp_ns = stamp_ns;
      }
    }
    node.pose = Interpolate(anchor_->pose, sample.pose, f);
    const CarriedCovariance* const before = this->in_force();
    node.covariance = Interpolate(
        before == nullptr ? anchor_->claim : before->covariance, covariance, f);
  }
  if (options_.state_space == StateSpace::kPlanar) {
    // z is not part of the state: nothing may depend on what was given for it.
    node.pose.z = 0.0;
    for (int i = 0; i < 4; ++i) node.covariance(2, i) = 0.0;
  }
  std::optional<ErrorTransition> transition;
  if (options_.carry_transitions)
    transition = ToErrorTransition<4>(node_to_anchor_);
  graph->AddNode(node, starts_segment, transition);
  if (options_.carry_transitions) node_to_anchor_.setIdentity();
  ++segment_nodes_;
}

}  // namespace revisit::core
