// How the frames of recordings lie to each other: a graph whose edges are what
// recordings' starts, confirmed loop closures and links tell of two frames. The
// recordings are those of one drive or of several.
//
// An edge joins a recording that began after another to that one, a recording
// with a datum to the frame that datums share, and two recordings with loop
// closures or links between them. The relation of any two frames is composed
// along the way on which it is surest, found by Dijkstra's algorithm ("A note
// on two problems in connexion with graphs", Numerische Mathematik 1 (1959)).
//
// Thread-compatible: const calls may run at the same time.
#ifndef REVISIT_CORE_DRIVE_FRAME_RELATIONS_H_
#define REVISIT_CORE_DRIVE_FRAME_RELATIONS_H_

#include <cstddef>
#include <map>
#include <string>
#include <utility>
#include <vector>

#include "core/drive/confirmed_loop.h"
#include "core/drive/frame_relation.h"
#include "core/drive/node_index.h"
#include "core/drive/recordings.h"

namespace revisit::core {

class FrameRelations {
 public:
  // There are no frames yet.
  FrameRelations() = default;
  // Adds one drive, whose recording k has frame k.
  FrameRelations(const FrameNodes& nodes, const Recordings& recordings,
                 NodeIndex query, const std::vector<ConfirmedLoop>& loops);

  // Adds the recordings of a drive up to that of the query. `loops` in the
  // order in which they were confirmed; those within one recording tie nothing.
  // `datum`, if not null, is that of the first recording, whatever its start
  // says. Returns the frame of the first recording; those of the others follow.
  // The graph of `nodes` must outlive this. REQUIRES: the nodes of all loops
  // lie at or before the query; all drives have one state space and one noise
  // model.
  std::size_t AddDrive(const FrameNodes& nodes, const Recordings& recordings,
                       NodeIndex query, const std::vector<ConfirmedLoop>& loops,
                       const RecordingStart* datum = nullptr);

  // Ties the frames of two drives as a loop closure ties those of two
  // recordings. The query's node is one of frame `from`, the matched one of
  // frame `to`.
  void AddLink(std::size_t from, std::size_t to, const ConfirmedLoop& link);

  // Takes away all that ties frames [first, last).
  void Cut(std::size_t first, std::size_t last);

  // How many recordings of the first drive there are.
  std::size_t size() const { return recordings_; }

  // The relations of a frame to each of them, as it asks; to itself, kSame.
  // The first drive's recordings come first. O(frames + edges).
  std::vector<FrameRelation> From(std::size_t asking) const;

  // The nodes of two recordings' frames.
  RelatedFrames Between(std::size_t asking, std::size_t other) const {
    return {NodesOf(asking), NodesOf(other)};
  }
  // The links that were added between two frames, as `from` asks, without what
  // was measured.
  const std::vector<ConfirmedLoop>& LinksBetween(std::size_t from,
                                                 std::size_t to) const;

 private:
  struct Edge {
    std::size_t to;
    FrameRelation relation;
  };

  // A frame that is none of a recording has those of any drive.
  const FrameNodes& NodesOf(std::size_t frame) const {
    return nodes_[drive_of_[frame]];
  }
  std::size_t AddFrames(std::size_t count, std::size_t drive);
  // Adds it both ways.
  void Add(std::size_t from, std::size_t to, const FrameRelation& relation);
  void AddStart(const RecordingStart& start, const Recording& recording,
                std::size_t frame, bool is_first);
  void AddDatum(const RecordingStart& start, std::size_t frame,
                NodeIndex first_node);
  void AddLoop(std::size_t from, std::size_t to, const ConfirmedLoop& loop);

  // By drive.
  std::vector<FrameNodes> nodes_;
  // By frame: those of the first drive's recordings, that which datums share,
  // and then those of other recordings and one for each datum with a name.
  std::vector<std::vector<Edge>> edges_;
  std::vector<std::size_t> drive_of_;
  std::size_t recordings_ = 0;
  std::size_t shared_ = 0;
  std::map<std::string, std::size_t> datum_frames_;
  // By the two frames, either way.
  std::map<std::pair<std::size_t, std::size_t>, std::vector<ConfirmedLoop>>
      links_;
};

}  // namespace revisit::core

#endif  // REVISIT_CORE_DRIVE_FRAME_RELATIONS_H_
