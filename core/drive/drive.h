// What a vehicle has driven, as one graph with all that belongs to it: poses go
// in, and a Search (search/search.h) asks it. It has no input or output, no
// clock and no threads: everything is passed as an argument.
//
// Whoever only passes a drive on includes no more than this: types that are
// declared here have headers of their own in this folder, for those who use
// what they hold.
//
// Thread-compatible: const calls may run at the same time, other calls need
// exclusive access.
#ifndef REVISIT_CORE_DRIVE_DRIVE_H_
#define REVISIT_CORE_DRIVE_DRIVE_H_

#include <cstddef>
#include <cstdint>
#include <memory>
#include <optional>
#include <string>
#include <vector>

#include "absl/status/status.h"
#include "absl/strings/string_view.h"
#include "core/drive/consistency.h"
#include "core/drive/findings.h"
#include "core/drive/node_index.h"
#include "core/settings.h"

namespace revisit::core {

class BlockBounds;
class DroppableSearch;
class DroppedStretches;
class FrameRelations;
class MotionHistory;
class PoseGraph;
class Recordings;
struct Agreement;
struct ConfirmedLoop;
struct ConfirmedPair;
struct DriveView;
struct DroppedStretch;
struct FrameNodes;
struct MeasuredLoop;
struct NodeRange;
struct PoseSample;
struct ResamplerOptions;
struct SimilarityModel;

struct AppendResult {
  std::vector<Jump> jumps;
  // Nodes at which a check is due: the first node at or after each multiple of
  // the check interval, from two sequence lengths on.
  std::vector<NodeIndex> checks_due;
  // What the poses have come to contradict the settings by, if they did not
  // before.
  std::vector<Finding> findings;
};

// A check that is due at a pose: it is made at the last node at or before it.
struct DueCheck {
  std::uint64_t sequence = 0;
  NodeIndex node = 0;
};

inline bool operator==(const DueCheck& a, const DueCheck& b) {
  return a.sequence == b.sequence && a.node == b.node;
}

class Drive {
 public:
  // REQUIRES: FindProblems(settings) is empty.
  explicit Drive(const DriveSettings& settings);
  Drive(Drive&&) noexcept;
  ~Drive();

  const DriveSettings& settings() const;
  const PoseGraph& graph() const;
  // Memory of the graph and its indexes, without the allocator's overhead.
  std::size_t bytes() const;
  // Sequence number of the last pose appended; 0 before the first.
  std::uint64_t last_sequence() const;
  double travelled_meters() const;
  // The revision that the last change was given; 0 before the first.
  std::uint64_t revision() const;

  // What the poses so far contradict the vehicle's settings by: a function of
  // these and of the settings. At most one of each code.
  std::vector<Finding> findings() const;

  // REQUIRES: samples without defect, whose sequence numbers follow
  // last_sequence(), and which begin no more than kMostRecordings recordings in
  // all; revision greater than revision().
  AppendResult Append(const std::vector<PoseSample>& samples,
                      std::uint64_t revision);

  // The first check behind the pose `after`: that of the pose with which the
  // first node came that lies at or after a multiple of the check interval,
  // from two sequence lengths on, which no node up to that pose had reached. A
  // function of graph and settings, so that it is found at any time which
  // checks have been due: those of AppendResult, where each pose brings one
  // node at most; of several that came with one pose, one at its last node.
  std::optional<DueCheck> NextCheck(std::uint64_t after) const;
  // How many multiples of the check interval lie behind the pose `after`, from
  // two sequence lengths on: as many checks are due, or less where poses lie
  // farther apart.
  std::int64_t ChecksBehind(std::uint64_t after) const;

  // Goes on behind poses that were dropped: the next pose starts a segment, and
  // that is no jump. REQUIRES: the stretch begins at last_sequence() + 1 and
  // has a transition where nodes carry them; revision greater than revision().
  void Skip(const DroppedStretch& stretch, std::uint64_t revision);

  // The stretches that were skipped.
  const DroppedStretches& dropped() const;

  // The recordings, each of which has a frame of its own.
  const Recordings& recordings() const;

  // A search for the nodes that the vehicle's settings do not keep
  // (retention.h). Poses may be appended, and loop closures added, while it
  // goes on. `latest_ns`: see DroppableSearch.
  std::unique_ptr<DroppableSearch> SearchDroppable(
      std::optional<std::int64_t> latest_ns) const;
  // The stamp before which nodes are too old, if any is (stamps.h).
  std::optional<std::int64_t> OldestStamp(
      std::optional<std::int64_t> latest_ns) const;
  // Whether the settings are still those with which the search, of this drive,
  // began.
  bool Fits(const DroppableSearch& search) const;
  // The nodes at both ends of each confirmed loop.
  std::vector<NodeIndex> LoopEnds() const;
  // The options by which the graph's nodes are made.
  ResamplerOptions resampler_options() const;

  // Replaces the settings. INVALID_ARGUMENT if they have problems, and
  // FAILED_PRECONDITION if they move nodes (MovesNodes()), which takes the
  // poses again: then nothing changes. REQUIRES: revision greater than
  // revision().
  absl::Status ChangeSettings(const DriveSettings& settings,
                              std::uint64_t revision);

  // Adds or removes an edge between the last nodes at or before two poses. Two
  // poses at one node have no edge, nor have two of which one was dropped; that
  // is not an error. `measured`: what was measured between the two, or null.
  // REQUIRES: sequences in [1, last_sequence()]; revision greater than
  // revision(); for a measurement, matched_sequence <= query_sequence, valid
  // covariances, and poses as they were appended.
  void AddLoopClosure(std::uint64_t query_sequence,
                      std::uint64_t matched_sequence, std::uint64_t revision,
                      std::shared_ptr<const MeasuredLoop> measured = nullptr);
  // `occurrence` is the index of the loop closure among those of the same two
  // poses, in the order in which they were added.
  void RemoveLoopClosure(std::uint64_t query_sequence,
                         std::uint64_t matched_sequence, std::uint64_t revision,
                         std::size_t occurrence = 0);

  // How well a measurement agrees with the graph, with the inflation that
  // searches apply; nothing where that is ill-conditioned, or nothing ties the
  // frames of the two poses. REQUIRES: as for AddLoopClosure().
  std::optional<Agreement> AgreementOf(
      std::uint64_t query_sequence, std::uint64_t matched_sequence,
      const std::shared_ptr<const MeasuredLoop>& measured) const;

  // Adds or removes a pair of poses that was verified not to be one place: ends
  // within kPlaceRadiusMeters of the second pose, or within the candidate
  // separation if that is more, are no candidates at nodes as near to the
  // first. The same pair may be rejected more than once. One of which a pose
  // was dropped rejects nothing. REQUIRES: as for loop closures.
  void AddRejection(std::uint64_t query_sequence,
                    std::uint64_t matched_sequence, std::uint64_t revision);
  void RemoveRejection(std::uint64_t query_sequence,
                       std::uint64_t matched_sequence, std::uint64_t revision);

  // The consistency after the last change. The same loop closures, added in
  // another order, may result in another inflation.
  Consistency consistency() const;

  // ---- The state as bytes: all that the poses have made, but no loop closures
  // and no rejections. A drive that was loaded answers as the one that was
  // saved, to the last bit.
  //
  // The bytes are parts, of kPartNodes nodes each, and a rest. Nodes, once
  // made, stay, so whoever saves again needs only the parts that are new since
  // then. All are for drives of the same StateKey(): that of the settings
  // which the nodes and their indexes come from, and of the version of this
  // form.

  std::string StateKey() const;
  // Parts [0, whole_parts()) never change again under this key.
  std::size_t whole_parts() const;
  // REQUIRES: part < whole_parts().
  std::string SavePart(std::size_t part) const;
  // Saves what follows the first `parts` parts. REQUIRES: parts <=
  // whole_parts().
  std::string SaveRest(std::size_t parts) const;
  // Loads the next part, and, after all parts, the rest. False if the bytes are
  // damaged so that a later call could fail, are of another key, or are not
  // those that come next: then throw the drive away. Damage that leaves
  // numbers in their ranges is not found: guard the bytes with a checksum.
  // REQUIRES: a drive that was not used but for calls of LoadPart().
  bool LoadPart(absl::string_view bytes);
  bool LoadRest(absl::string_view bytes);
  // Whole blocks of nodes.
  static constexpr NodeIndex kPartNodes = 8192;

  // ---- What searches ask (search/search.h).

  // Indexes of the graph, for searches with the vehicle's own options.
  const MotionHistory& motion_history() const;
  const BlockBounds& block_bounds() const;
  // Counts the changes of settings under which marks show something else; above
  // 0.
  std::uint64_t mark_settings_version() const;
  // The confirmed loops in the order in which they came, without those of one
  // node and those of which a pose was dropped. Any other change of the drive
  // but an append ends the reference.
  const std::vector<ConfirmedPair>& confirmed() const;
  // The last confirmed loop whose nodes both lie at or before the query, and of
  // which one lies in the query's recording, the other in this one.
  std::optional<ConfirmedLoop> LastConfirmed(NodeIndex query,
                                             std::size_t recording) const;
  // The confirmed loops whose nodes both lie at or before the query, in the
  // order in which they came.
  std::vector<ConfirmedLoop> LoopsAt(NodeIndex query) const;
  // The drive's frames, from which relations are made.
  FrameNodes frame_nodes() const;
  // How the frames of the recordings up to the query's lie to each other, by
  // LoopsAt() it.
  FrameRelations RelationsAt(NodeIndex query) const;
  // The same without any loop.
  FrameRelations RelationsWithoutLoops(NodeIndex query) const;
  // The model that the options ask for, inflated as the settings say.
  SimilarityModel SimilarityOf(const SearchOptions& options) const;
  // Nodes that may not be candidates at the query: those near it, and those
  // rejected there. Only nodes of one recording are near each other.
  std::vector<NodeRange> NotSought(NodeIndex query,
                                   double separation_meters) const;

  // ---- What searches of other drives ask.

  // The drive as it is now. `shown_scale`: the scale that its own searches have
  // shown (CandidateSet::scale), 1 where they show none. O(nodes), some bytes
  // of each.
  std::shared_ptr<const DriveView> View(double shown_scale) const;

 private:
  struct Impl;

  std::unique_ptr<Impl> impl_;
};

}  // namespace revisit::core

#endif  // REVISIT_CORE_DRIVE_DRIVE_H_
