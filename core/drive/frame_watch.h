// Watches for poses that go on in another frame, as where an odometry began
// anew and its recording was sent behind another one's.
//
// Searches take the poses of a drive to be in one frame, and errors to be
// carried on along it. So what belies that can be seen where claims are to grow
// (ClaimedGrowth::kGrows), between two poses that follow each other:
//
//   fall     The claims shrink: the later variance of the position is less than
//            1/kFall of the earlier one, as it is and carried on by dead
//            reckoning, and so is that of the heading; or the heading's has
//            stayed, as a compass lets it, and the vehicle leaps. Errors that
//            are carried on allow neither.
//   return   The vehicle leaps to where the first node is, or to the origin,
//            heading as there, and the claims grow over the leap as over any
//            way of this length: nobody has said that the start is uncertain.
//
// A leap is at least kLeapMeters long, and kUsualSteps times as long as the
// step before it. Nothing is judged over poses that were dropped, nor where a
// recording begins: there the caller has told of the frame. The first node is
// that of the recording.
//
// Claims that fall where the pose goes on as before are carried on before there
// are nodes (carried_claim.h), and are not seen here.
//
// The watch compares nodes: the last one before a step between two poses, and
// the first one behind it. So what is seen is a function of the graph alone,
// and nothing of it has to be stored. O(1) per node.
//
// Thread-compatible.
#ifndef REVISIT_CORE_DRIVE_FRAME_WATCH_H_
#define REVISIT_CORE_DRIVE_FRAME_WATCH_H_

#include <array>
#include <cstddef>
#include <cstdint>
#include <memory>

#include "core/drive/dropped_stretch.h"
#include "core/drive/findings.h"
#include "core/drive/pose_graph.h"
#include "core/drive/recordings.h"

namespace revisit::core {

class FrameWatch {
 public:
  static constexpr double kFall = 4.0;
  static constexpr double kLeapMeters = 20.0;
  static constexpr double kUsualSteps = 4.0;
  // How near a return leads to the first node or to the origin, beside the
  // spacing of the nodes.
  static constexpr double kReturnMeters = 1.0;
  static constexpr double kReturnRadians = 0.2;
  // Claims that grow by so many times what is usual say that more is uncertain
  // than the way.
  static constexpr double kUsualGrowth = 1.25;

  // Looks at the nodes by which the graph has grown. REQUIRES: the same four
  // at each call.
  void Extend(const PoseGraph& graph, const DroppedStretches& dropped,
              const Recordings& recordings, double node_spacing_meters);

  // The last frame that has begun; null if none has.
  const NewFrame* last() const { return last_.get(); }

 private:
  // `first`: the first node of the recording.
  void Look(const PoseGraph& graph, NodeIndex index, NodeIndex first,
            bool is_behind_gap, double return_meters);
  // The last node of a stretch between two poses: 0 is that of the last
  // stretch, 1 that of the one before. REQUIRES: k < ends_count_.
  NodeIndex End(std::size_t k) const { return ends_[ends_count_ - 1 - k]; }
  void AddEnd(NodeIndex index, std::uint64_t sequence);

  // Every vehicle in memory has a watch, so it holds no nodes but their
  // indices, and room for a frame only where one has begun.
  NodeIndex next_ = 0;
  // The last nodes between the same two poses each, of one segment, in order.
  std::array<NodeIndex, 3> ends_;
  // The sequence of End(0).
  std::uint64_t end_sequence_ = 0;
  std::uint32_t ends_count_ = 0;
  // Stretches that were dropped before the next node.
  std::uint32_t gaps_ = 0;
  std::unique_ptr<const NewFrame> last_;
};

}  // namespace revisit::core

#endif  // REVISIT_CORE_DRIVE_FRAME_WATCH_H_
