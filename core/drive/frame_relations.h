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

  // The relations of `base` but for all that ties frames [first, last), to add
  // to. Nothing of it is copied: it must outlive this, and nothing is added to
  // it any more. O(frames). REQUIRES: it has a drive, and no base itself.
  FrameRelations(const FrameRelations* base, std::size_t first,
                 std::size_t last);

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
  // frame `to`. REQUIRES: where there is a base, one of the two is not of it.
  void AddLink(std::size_t from, std::size_t to, const ConfirmedLoop& link);

  // How many recordings of the first drive there are.
  std::size_t size() const { return recordings_; }

  // The relations of a frame to each of them, as it asks; to itself, kSame.
  // The first drive's recordings come first. O(frames + edges).
  std::vector<FrameRelation> From(std::size_t asking) const;
  // The same to some of them, in this order: frames that lead to none of these
  // are passed over.
  std::vector<FrameRelation> From(std::size_t asking,
                                  const std::vector<std::size_t>& others) const;

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

  // Places of frames among those that are looked at; kPassedOver for others.
  static constexpr std::size_t kPassedOver = static_cast<std::size_t>(-1);

  std::size_t frames() const { return edges_.size(); }
  std::size_t frames_of_base() const {
    return base_ == nullptr ? 0 : base_->frames();
  }
  bool IsCut(std::size_t frame) const {
    return cut_first_ <= frame && frame < cut_last_;
  }
  // A frame that is none of a recording has those of any drive.
  const FrameNodes& NodesOf(std::size_t frame) const {
    const std::size_t of_base = frames_of_base();
    return frame < of_base ? base_->NodesOf(frame)
                           : nodes_[drive_of_[frame - of_base]];
  }
  // Calls visit(edge) for all edges of a frame.
  template <typename Visit>
  void VisitEdges(std::size_t frame, const Visit& visit) const {
    if (frame < frames_of_base() && !IsCut(frame)) {
      for (const Edge& edge : base_->edges_[frame]) {
        if (!IsCut(edge.to)) visit(edge);
      }
    }
    for (const Edge& edge : edges_[frame]) visit(edge);
  }

  std::size_t AddFrames(std::size_t count, std::size_t drive);
  // Adds it both ways.
  void Add(std::size_t from, std::size_t to, const FrameRelation& relation);
  void AddStart(const RecordingStart& start, const Recording& recording,
                std::size_t frame, bool is_first);
  void AddDatum(const RecordingStart& start, std::size_t frame,
                NodeIndex first_node);
  // The frame of a datum with a name, and whether it has come with this call.
  std::pair<std::size_t, bool> DatumFrame(const std::string& name,
                                          std::size_t drive);
  void AddLoop(std::size_t from, std::size_t to, const ConfirmedLoop& loop);

  // The places of frames without most of those that no way from one of these
  // frames to another leads over.
  std::vector<std::size_t> PlacesAmong(
      const std::vector<std::size_t>& ends) const;
  // The relations to the frames with a place, by place.
  std::vector<FrameRelation> Reach(std::size_t asking,
                                   const std::vector<std::size_t>& places,
                                   std::size_t count) const;

  // The base that this adds to, or null; all that ties cut frames is left out.
  const FrameRelations* base_ = nullptr;
  std::size_t cut_first_ = 0;
  std::size_t cut_last_ = 0;
  // By drive; without those of the base.
  std::vector<FrameNodes> nodes_;
  // By frame: those of the first drive's recordings, that which datums share,
  // and then those of other recordings and one for each datum with a name.
  // Edges without those of the base; drives of frames that it does not have.
  std::vector<std::vector<Edge>> edges_;
  std::vector<std::size_t> drive_of_;
  std::size_t recordings_ = 0;
  std::size_t shared_ = 0;
  // Without those of the base.
  std::map<std::string, std::size_t> datum_frames_;
  // By the two frames, either way; without those of the base.
  std::map<std::pair<std::size_t, std::size_t>, std::vector<ConfirmedLoop>>
      links_;
};

}  // namespace revisit::core

#endif  // REVISIT_CORE_DRIVE_FRAME_RELATIONS_H_
