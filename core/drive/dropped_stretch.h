// Stretches of a vehicle's poses that were dropped: what is kept of one, so
// that the graph goes on behind it.
#ifndef REVISIT_CORE_DRIVE_DROPPED_STRETCH_H_
#define REVISIT_CORE_DRIVE_DROPPED_STRETCH_H_

#include <cstdint>
#include <optional>
#include <vector>

#include "core/base/byte_stream.h"
#include "core/drive/node_index.h"
#include "core/drive/resampler_options.h"
#include "core/geometry/pose.h"

namespace revisit::core {

class PoseGraph;

struct DroppedStretch {
  std::uint64_t first_sequence = 0;
  std::uint64_t last_sequence = 0;
  // Distance travelled from the pose before the stretch to the pose after it,
  // without jumps; from the first pose of the stretch if none is before it. At
  // least 0.
  double travelled_meters = 0.0;
  // Product of the error transitions of its poses, the latest on the left,
  // where poses bring them.
  std::optional<ErrorTransition> transition;
};

// Makes one stretch of poses and of stretches that follow each other.
class DroppedStretchMaker {
 public:
  // The options by which the graph's nodes are made.
  explicit DroppedStretchMaker(const ResamplerOptions& options)
      : options_(options) {}

  // The pose before the stretch. Call it first, if there is such a pose and
  // what comes next is a pose.
  void Begin(const Pose& before) { anchor_ = before; }
  // REQUIRES: in the order of their sequences, without a gap.
  void Add(const PoseSample& sample);
  void Add(const DroppedStretch& stretch);
  // The pose after the stretch.
  void End(const Pose& after) { StepTo(after); }

  // REQUIRES: something was added.
  DroppedStretch Take() const;

 private:
  void StepTo(const Pose& pose);
  void Extend(std::uint64_t first_sequence, std::uint64_t last_sequence,
              const std::optional<ErrorTransition>& transition);

  ResamplerOptions options_;
  // The last pose that counted; none before the first, and where the way to the
  // next pose is counted already.
  std::optional<Pose> anchor_;
  DroppedStretch stretch_;
  // From the first pose over all that were added.
  ErrorTransition transition_;
};

// The stretches that a graph lacks, in their order.
class DroppedStretches {
 public:
  struct Gap {
    std::uint64_t first_sequence = 0;
    std::uint64_t last_sequence = 0;
    // The first node after it, once there is one.
    NodeIndex node = 0;
    // Distance travelled in this gap and in all before it.
    double meters_so_far = 0.0;
  };

  // In order; no two are next to each other.
  const std::vector<Gap>& gaps() const { return gaps_; }

  // REQUIRES: behind all others.
  void Add(const DroppedStretch& stretch, NodeIndex next_node);

  // O(log gaps).
  bool Contains(std::uint64_t sequence) const {
    return KeptFrom(sequence) != sequence;
  }
  // The first sequence at or after this one that was not dropped.
  std::uint64_t KeptFrom(std::uint64_t sequence) const;
  // How many poses were dropped.
  std::uint64_t count() const { return count_; }
  // Distance travelled in the gaps before the node.
  double MetersBefore(NodeIndex node) const;

  std::size_t bytes() const { return gaps_.capacity() * sizeof(Gap); }

  void Save(ByteWriter* writer) const;
  // Becomes what was saved; false, and unspecified, unless a graph of so many
  // nodes and with this last sequence can have had it.
  bool Load(NodeIndex nodes, std::uint64_t last_sequence, ByteReader* reader);

 private:
  std::vector<Gap> gaps_;
  std::uint64_t count_ = 0;
};

// The last node at or before a pose; none for a pose that was dropped, since a
// node before the gap lies elsewhere, and none before the first node. REQUIRES:
// the stretches are those that the graph lacks.
std::optional<NodeIndex> NodeOf(const PoseGraph& graph,
                                const DroppedStretches& dropped,
                                std::uint64_t sequence);

}  // namespace revisit::core

#endif  // REVISIT_CORE_DRIVE_DROPPED_STRETCH_H_
