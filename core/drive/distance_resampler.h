// Turns a stream of poses of any rate into nodes spaced evenly by travelled
// distance.
//
// Node m of a segment lies where the path of the stream has length m * spacing,
// measured along straight lines between poses. Between two poses the mean is
// interpolated linearly, heading along the shorter arc, the covariance linearly
// (a convex combination of positive definite matrices is one too), and the
// stamp linearly.
//
// Standing still adds no distance: a pose that is closer to the last counted
// pose than `standstill_fraction` of the spacing is not counted itself, so the
// jitter of a parked estimator does not add up. A step longer than
// `max_step_meters` is a jump: it is reported, adds no distance, and starts a
// new segment at the pose after it. So does a pose that begins a recording,
// which is no jump: what lies between is no step in either frame.
#ifndef REVISIT_CORE_DRIVE_DISTANCE_RESAMPLER_H_
#define REVISIT_CORE_DRIVE_DISTANCE_RESAMPLER_H_

#include <Eigen/Core>
#include <cstdint>
#include <memory>
#include <optional>

#include "core/base/byte_stream.h"
#include "core/drive/carried_claim.h"
#include "core/drive/findings.h"
#include "core/drive/pose_graph.h"
#include "core/drive/resampler_options.h"
#include "core/geometry/pose.h"

namespace revisit::core {

class DistanceResampler {
 public:
  // REQUIRES: positive spacing and maximal step.
  explicit DistanceResampler(const ResamplerOptions& options);

  // Adds to the graph the nodes that the step to this sample reaches. Returns
  // the jump, if the step is one.
  // REQUIRES: the sample has no defect and the sequence number that follows the
  // last sample's.
  std::optional<Jump> Add(const PoseSample& sample, PoseGraph* graph);

  // Goes on behind poses that are not there: the next sample starts a segment,
  // so much farther along the path, and that is no jump. `transition`: the
  // error transition from the last sample over the poses that are missing; with
  // carry_transitions only, and without effect before the first sample.
  // REQUIRES: meters >= 0; the sequence of the last pose that is missing.
  void Skip(std::uint64_t last_sequence, double meters,
            const std::optional<ErrorTransition>& transition);

  // The last counted pose; nothing before the first.
  std::optional<Pose> last_pose() const {
    return anchor_ ? std::optional<Pose>(anchor_->pose) : std::nullopt;
  }
  // The last claims that were given up (carried_claim.h); null if none were.
  const ClaimsReset* last_reset() const {
    return carried_ && carried_->has_reset != 0 ? &carried_->reset : nullptr;
  }
  // Path length up to the last counted pose, without jumps.
  double travelled_meters() const { return travelled_meters_; }

  void Save(ByteWriter* writer) const;
  // Goes on where another was when it was saved. False, and unspecified, unless
  // that can have made this graph up to `last_sequence`.
  bool Load(const PoseGraph& graph, std::uint64_t last_sequence,
            ByteReader* reader);

 private:
  // The covariance in force at the anchor, if its claim does not count, and the
  // last claims that were given up, if any were.
  struct Carried {
    CarriedCovariance in_force;
    std::uint64_t counts = 0;
    std::uint64_t has_reset = 0;
    ClaimsReset reset;
  };

  // The covariance in force at a sample that follows the anchor in its
  // recording; nothing where that is its claim.
  std::optional<CarriedCovariance> InForce(const PoseSample& sample) const;
  // Null where that is its claim.
  const CarriedCovariance* in_force() const {
    return carried_ && carried_->counts != 0 ? &carried_->in_force : nullptr;
  }
  std::optional<std::int64_t> last_stamp_ns() const {
    return has_last_stamp_ ? std::optional<std::int64_t>(last_stamp_ns_)
                           : std::nullopt;
  }
  void SetLastStamp(const std::optional<std::int64_t>& stamp_ns) {
    has_last_stamp_ = stamp_ns.has_value();
    last_stamp_ns_ = stamp_ns.value_or(0);
  }
  void SetAnchor(const PoseSample& sample,
                 const std::optional<CarriedCovariance>& in_force);
  void StartSegment(const PoseSample& sample,
                    const std::optional<CarriedCovariance>& in_force,
                    PoseGraph* graph);
  void AddNode(const PoseSample& sample,
               const std::optional<CarriedCovariance>& in_force,
               double fraction, bool starts_segment, PoseGraph* graph);

  ResamplerOptions options_;
  // The last counted pose.
  std::optional<ClaimedPose> anchor_;
  // Null where all claims of the vehicle have counted, as for most.
  std::unique_ptr<Carried> carried_;
  // The last pose, counted or not.
  std::uint64_t last_sequence_ = 0;
  std::int64_t last_stamp_ns_ = 0;
  double travelled_meters_ = 0.0;
  double segment_start_meters_ = 0.0;
  // Vehicles are many, so flags stand beside each other.
  bool has_last_stamp_ = false;
  // Whether poses are missing since the last one.
  bool has_skipped_ = false;
  std::int64_t segment_nodes_ = 0;
  // Error transitions from the last node to the anchor and from the anchor to
  // the last pose. Used only with carry_transitions.
  Eigen::Matrix4d node_to_anchor_ = Eigen::Matrix4d::Identity();
  Eigen::Matrix4d anchor_to_last_ = Eigen::Matrix4d::Identity();
};

}  // namespace revisit::core

#endif  // REVISIT_CORE_DRIVE_DISTANCE_RESAMPLER_H_
