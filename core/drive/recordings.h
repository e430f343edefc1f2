// The recordings of a drive: ranges of its nodes, each in a frame of its own.
//
// Thread-compatible: const calls may run at the same time.
#ifndef REVISIT_CORE_DRIVE_RECORDINGS_H_
#define REVISIT_CORE_DRIVE_RECORDINGS_H_

#include <cstddef>
#include <cstdint>
#include <memory>
#include <vector>

#include "core/base/byte_stream.h"
#include "core/drive/node_index.h"
#include "core/drive/node_range.h"
#include "core/geometry/pose.h"
#include "core/geometry/recording_start.h"

namespace revisit::core {

struct Recording {
  // Its first pose, and the node there.
  std::uint64_t first_sequence = 1;
  NodeIndex first_node = 0;
  // The start that its first pose brought; null for the first recording of a
  // drive that was not told of any.
  std::shared_ptr<const RecordingStart> start;
  // The last pose of the recording before it, which lies behind that one's last
  // node; not used for the first recording.
  Pose end_before;
};

class Recordings {
 public:
  // At least 1, also of a drive without poses.
  std::size_t size() const { return begun_.empty() ? 1 : begun_.size(); }
  // REQUIRES: k < size().
  const Recording& operator[](std::size_t k) const {
    return begun_.empty() ? kOnly : begun_[k];
  }

  // The recording that holds a node, or a pose. O(log size).
  std::size_t Of(NodeIndex node) const;
  std::size_t OfSequence(std::uint64_t sequence) const;
  // The nodes of a recording in a graph of so many.
  NodeRange NodesOf(std::size_t k, NodeIndex graph_size) const;

  // Begins a recording with the pose of this sequence, whose node is the next
  // one of a graph of `graph_size` nodes. REQUIRES: sequences grow; start is
  // not null; size() < kMostRecordings.
  void Begin(std::uint64_t sequence, NodeIndex graph_size,
             std::shared_ptr<const RecordingStart> start,
             const Pose& end_before);

  std::size_t bytes() const;

  // Nothing is written where there is one recording that nobody told of.
  void Save(ByteWriter* writer) const;
  // Becomes what was saved. False, and unspecified, unless a graph of so many
  // nodes and with this last sequence can have had it.
  bool Load(StateSpace space, NodeIndex nodes, std::uint64_t last_sequence,
            ByteReader* reader);

 private:
  static const Recording kOnly;

  // Empty where there is one recording that nobody told of.
  std::vector<Recording> begun_;
};

}  // namespace revisit::core

#endif  // REVISIT_CORE_DRIVE_RECORDINGS_H_
