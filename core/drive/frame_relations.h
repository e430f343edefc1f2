// How the frames of a drive's recordings lie to each other: a graph whose edges
// are what recordings' starts and confirmed loop closures tell of two frames.
//
// An edge joins a recording that began after another to that one, a recording
// with a datum to the frame that datums share, and two recordings with loop
// closures between them. The relation of any two frames is composed along the
// way on which it is surest, found by Dijkstra's algorithm ("A note on two
// problems in connexion with graphs", Numerische Mathematik 1 (1959)).
//
// Thread-compatible: const calls may run at the same time.
#ifndef REVISIT_CORE_DRIVE_FRAME_RELATIONS_H_
#define REVISIT_CORE_DRIVE_FRAME_RELATIONS_H_

#include <cstddef>
#include <string>
#include <vector>

#include "core/drive/confirmed_loop.h"
#include "core/drive/frame_relation.h"
#include "core/drive/node_index.h"
#include "core/drive/recordings.h"

namespace revisit::core {

class FrameRelations {
 public:
  // The recordings up to that of the query. `loops` in the order in which they
  // were confirmed; those within one recording tie nothing. The graph of
  // `nodes` must outlive this. REQUIRES: the nodes of all loops lie at or
  // before the query.
  FrameRelations(const FrameNodes& nodes, const Recordings& recordings,
                 NodeIndex query, const std::vector<ConfirmedLoop>& loops);

  // How many recordings there are, up to that of the query.
  std::size_t size() const { return recordings_; }

  // The relations of a recording to each of them, as it asks; to itself, kSame.
  // O(size + edges).
  std::vector<FrameRelation> From(std::size_t asking) const;

  const FrameNodes& nodes() const { return nodes_; }

 private:
  struct Edge {
    std::size_t to;
    FrameRelation relation;
  };

  // Adds it both ways.
  void Add(std::size_t from, std::size_t to, const FrameRelation& relation);
  void AddStarts(const Recordings& recordings);
  void AddDatum(const RecordingStart& start, std::size_t recording,
                NodeIndex first_node);
  void AddLoop(std::size_t from, std::size_t to, const ConfirmedLoop& loop);

  FrameNodes nodes_;
  std::size_t recordings_;
  // By frame: those of the recordings, that which datums share, and one for
  // each datum with a name.
  std::vector<std::vector<Edge>> edges_;
  std::vector<std::string> datum_ids_;
};

}  // namespace revisit::core

#endif  // REVISIT_CORE_DRIVE_FRAME_RELATIONS_H_
