// Drives of several vehicles whose frames lie in one world, and what is known
// of how: views of the drives, where each was placed, and links between them.
//
// Made once for all searches until a view, a datum or a link is another: it
// takes most of the time that relations of frames take.
//
// Thread-compatible: const calls may run at the same time.
#ifndef REVISIT_CORE_DRIVE_JOINED_DRIVES_H_
#define REVISIT_CORE_DRIVE_JOINED_DRIVES_H_

#include <cstddef>
#include <memory>
#include <optional>
#include <vector>

#include "core/drive/block_growth.h"
#include "core/drive/confirmed_loop.h"
#include "core/drive/drive_view.h"
#include "core/drive/frame_relation.h"
#include "core/drive/frame_relations.h"
#include "core/drive/motion_pool.h"
#include "core/drive/node_index.h"
#include "core/drive/node_range.h"
#include "core/drive/recordings.h"
#include "core/geometry/recording_start.h"

namespace revisit::core {

// Drives whose motion is pooled.
inline constexpr std::size_t kDrivesOfPool = 128;

struct JoinedDrive {
  // Never null.
  std::shared_ptr<const DriveView> view;
  // Where its first recording was placed, whatever that one's own start says;
  // or null.
  std::shared_ptr<const RecordingStart> datum = nullptr;
};

// A confirmed link: `loop` with its query in one drive and its matched node in
// another one, by their indexes among the joined drives.
struct FrameLink {
  std::size_t query_drive = 0;
  std::size_t matched_drive = 0;
  ConfirmedLoop loop;
};

// The frames of joined drives as one of them, or another drive, sees them.
struct SeenFrames {
  FrameRelations relations;
  // The frame of the asking drive's first recording; those of its others
  // follow.
  std::size_t own = 0;
};

class JoinedDrives {
 public:
  // Links come in the order in which they were confirmed. Those with a node
  // that a view does not have yet tie nothing, nor do those of two drives of
  // other state spaces or noise models. `rejected` have the nodes of two drives
  // that are not one place: these tie nothing. `before`: what was joined before
  // this takes its place, or null; it saves time. REQUIRES: each link is of two
  // drives.
  JoinedDrives(std::vector<JoinedDrive> drives, std::vector<FrameLink> links,
               std::vector<FrameLink> rejected = {},
               const JoinedDrives* before = nullptr);

  std::size_t size() const { return drives_.size(); }
  const DriveView& view(std::size_t drive) const {
    return *drives_[drive].view;
  }

  // The motion of drives [first, last) as one, last - first being at most
  // kDrivesOfPool and `first` a multiple of it; null where one of these is
  // another than it was before, since it will soon be another again, or where
  // their stretches differ.
  const MotionPool* PoolFrom(std::size_t first) const {
    return pools_[first / kDrivesOfPool].get();
  }

  // Where the errors of a recording grow from its first node, to which datums
  // and starts tie it; null where errors do not count from a node.
  const Growth* GrowthFromFirst(std::size_t drive,
                                std::size_t recording) const {
    const auto& growth = growth_[drive];
    return growth == nullptr ? nullptr : &(*growth)[recording];
  }

  // The frames as they are seen from the asking drive at a node: with its own
  // recordings up to the query, and its loops, which are given, and links whose
  // own nodes lie at or before the query; its view does not count. `asking` is
  // its index; nothing where it is none of these. The graph of `nodes`, and
  // this, must outlive the answer. O(frames + links), and O(frames + edges) for
  // each frame to which the asking drive has links.
  SeenFrames SeenFrom(const FrameNodes& nodes, const Recordings& recordings,
                      NodeIndex query, const std::vector<ConfirmedLoop>& loops,
                      std::optional<std::size_t> asking) const;

  // The nodes of another drive that a search of the asking one at a node does
  // not seek: those near a place that was rejected near the query, by the rule
  // of Drive::NotSought(). Graph and recordings are those of the asking drive;
  // its view does not count.
  std::vector<NodeRange> NotSought(std::size_t drive, std::size_t asking,
                                   const PoseGraph& graph,
                                   const Recordings& recordings,
                                   NodeIndex query,
                                   double separation_meters) const;

  // By drive and recording: where its frame lies in that of the asking drive's
  // last recording, by all that is joined. Empty for drives without nodes, or
  // with another state space or noise model; all are, where the asking one has
  // no nodes. As SeenFrom(), and O(frames + edges) more.
  std::vector<std::vector<FrameRelation>> SeenFromLast(
      std::size_t asking) const;

  // The frame of the first recording of a drive, among those that a drive with
  // this state space and noise model sees; those of its others follow. Nothing
  // for a drive with another one, or without nodes.
  std::optional<std::size_t> FrameOf(std::size_t drive,
                                     const FrameNodes& seen_from) const;

 private:
  // Drives of one state space and noise model.
  struct Kind {
    StateSpace state_space;
    CorrelationModel model;
    FrameRelations relations;
  };

  // The frame in which a node of a drive lies, as FrameOf(). Nothing for a node
  // that the view does not have.
  std::optional<std::size_t> FrameAt(std::size_t drive, NodeIndex node,
                                     const FrameNodes& seen_from) const;
  const Kind* FindKind(const FrameNodes& nodes) const;
  // The frames that a drive with these nodes sees, without those of the view of
  // the asking one.
  FrameRelations FramesWithout(std::optional<std::size_t> asking,
                               const FrameNodes& nodes) const;
  Kind& KindOf(const FrameNodes& nodes);

  void PoolMotion(const JoinedDrives* before);
  void FindGrowth(const JoinedDrives* before);

  std::vector<JoinedDrive> drives_;
  std::vector<FrameLink> links_;
  std::vector<FrameLink> rejected_;
  std::vector<Kind> kinds_;
  // By drive; nothing for those without nodes.
  std::vector<std::optional<std::size_t>> frames_;
  std::vector<std::shared_ptr<const MotionPool>> pools_;
  // By drive, and by its recordings; null where errors do not count from a
  // node.
  std::vector<std::shared_ptr<const std::vector<Growth>>> growth_;
};

}  // namespace revisit::core

#endif  // REVISIT_CORE_DRIVE_JOINED_DRIVES_H_
