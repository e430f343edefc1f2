#include "core/drive/joined_drives.h"

#include <algorithm>
#include <cassert>
#include <unordered_map>
#include <unordered_set>
#include <utility>

#include "core/drive/rejected_places.h"

namespace revisit::core {
namespace {

bool AreOfKind(const FrameNodes& nodes, StateSpace state_space,
               CorrelationModel model) {
  return nodes.state_space == state_space && nodes.correlation.model == model;
}

// How many recordings have nodes. REQUIRES: there are nodes.
std::size_t CountRecordings(const DriveView& view) {
  return view.recordings.Of(view.graph.size() - 1) + 1;
}

// From the first node of each recording; null where errors do not count from a
// node.
std::shared_ptr<const std::vector<Growth>> GrowthOf(const DriveView& view) {
  if (view.graph.size() == 0 || !view.nodes().have_references()) return nullptr;
  auto growth = std::make_shared<std::vector<Growth>>();
  for (std::size_t k = 0; k < view.recordings.size(); ++k) {
    const NodeRange nodes = view.recordings.NodesOf(k, view.graph.size());
    growth->push_back(
        GrowthFrom(view.state_space, view.graph, nodes, nodes.first));
  }
  return growth;
}

bool HaveOneStretch(const std::vector<const DriveView*>& views) {
  return !views.empty() &&
         std::all_of(views.begin(), views.end(), [&](const DriveView* view) {
           return view->motion_history.stretch_nodes() ==
                  views.front()->motion_history.stretch_nodes();
         });
}

}  // namespace

JoinedDrives::JoinedDrives(std::vector<JoinedDrive> drives,
                           std::vector<FrameLink> links,
                           std::vector<FrameLink> rejected,
                           const JoinedDrives* before)
    : drives_(std::move(drives)),
      links_(std::move(links)),
      rejected_(std::move(rejected)) {
  PoolMotion(before);
  FindGrowth(before);
  for (const JoinedDrive& drive : drives_) {
    const DriveView& view = *drive.view;
    std::optional<std::size_t>& frame = frames_.emplace_back();
    if (view.graph.size() == 0) continue;
    frame = KindOf(view.nodes())
                .relations.AddDrive(view.nodes(), view.recordings,
                                    view.graph.size() - 1, view.loops,
                                    drive.datum.get());
  }
  for (const FrameLink& link : links_) {
    assert(link.query_drive != link.matched_drive);
    const FrameNodes seen_from = view(link.query_drive).nodes();
    const auto from = FrameAt(link.query_drive, link.loop.query, seen_from);
    const auto to = FrameAt(link.matched_drive, link.loop.matched, seen_from);
    if (from && to) KindOf(seen_from).relations.AddLink(*from, *to, link.loop);
  }
}

// Views that were joined before are pooled, or all if none were.
void JoinedDrives::PoolMotion(const JoinedDrives* before) {
  std::unordered_set<const DriveView*> known;
  for (std::size_t d = 0; before != nullptr && d < before->size(); ++d) {
    known.insert(&before->view(d));
  }
  for (std::size_t first = 0; first < size(); first += kDrivesOfPool) {
    const std::size_t last = std::min(first + kDrivesOfPool, size());
    const auto is_joined = [&](std::size_t d) {
      return d < before->size() && &before->view(d) == &view(d);
    };
    std::vector<const DriveView*> views;
    bool are_known = true;
    bool are_the_same = before != nullptr;
    for (std::size_t d = first; d < last; ++d) {
      are_the_same = are_the_same && is_joined(d);
      are_known = are_known &&
                  (before == nullptr || known.find(&view(d)) != known.end());
      if (view(d).graph.size() > 0) views.push_back(&view(d));
    }
    std::shared_ptr<const MotionPool>& pool = pools_.emplace_back();
    if (are_the_same && before->pools_[pools_.size() - 1] != nullptr &&
        std::min(first + kDrivesOfPool, before->size()) == last) {
      pool = before->pools_[pools_.size() - 1];
    } else if (are_known && HaveOneStretch(views)) {
      pool = std::make_shared<const MotionPool>(views);
    }
  }
}

// The growth of views that were joined before is known.
void JoinedDrives::FindGrowth(const JoinedDrives* before) {
  std::unordered_map<const DriveView*, std::size_t> known;
  for (std::size_t d = 0; before != nullptr && d < before->size(); ++d) {
    known.emplace(&before->view(d), d);
  }
  for (std::size_t d = 0; d < size(); ++d) {
    const auto joined = known.find(&view(d));
    growth_.push_back(joined == known.end() ? GrowthOf(view(d))
                                            : before->growth_[joined->second]);
  }
}

const JoinedDrives::Kind* JoinedDrives::FindKind(
    const FrameNodes& nodes) const {
  for (const Kind& kind : kinds_) {
    if (AreOfKind(nodes, kind.state_space, kind.model)) return &kind;
  }
  return nullptr;
}

JoinedDrives::Kind& JoinedDrives::KindOf(const FrameNodes& nodes) {
  if (const Kind* const kind = FindKind(nodes)) {
    return kinds_[static_cast<std::size_t>(kind - kinds_.data())];
  }
  return kinds_.emplace_back(
      Kind{nodes.state_space, nodes.correlation.model, FrameRelations()});
}

std::optional<std::size_t> JoinedDrives::FrameOf(
    std::size_t drive, const FrameNodes& seen_from) const {
  if (!AreOfKind(view(drive).nodes(), seen_from.state_space,
                 seen_from.correlation.model)) {
    return std::nullopt;
  }
  return frames_[drive];
}

std::optional<std::size_t> JoinedDrives::FrameAt(
    std::size_t drive, NodeIndex node, const FrameNodes& seen_from) const {
  const auto first = FrameOf(drive, seen_from);
  if (!first || node >= view(drive).graph.size()) return std::nullopt;
  return *first + view(drive).recordings.Of(node);
}

FrameRelations JoinedDrives::FramesWithout(std::optional<std::size_t> asking,
                                           const FrameNodes& nodes) const {
  const Kind* const kind = FindKind(nodes);
  if (kind == nullptr) return {};
  const auto frame = asking ? FrameOf(*asking, nodes) : std::nullopt;
  if (!frame) return {&kind->relations, 0, 0};
  return {&kind->relations, *frame, *frame + CountRecordings(view(*asking))};
}

SeenFrames JoinedDrives::SeenFrom(const FrameNodes& nodes,
                                  const Recordings& recordings, NodeIndex query,
                                  const std::vector<ConfirmedLoop>& loops,
                                  std::optional<std::size_t> asking) const {
  SeenFrames seen{FramesWithout(asking, nodes), 0};
  if (!asking) {
    seen.own = seen.relations.AddDrive(nodes, recordings, query, loops);
    return seen;
  }
  seen.own = seen.relations.AddDrive(nodes, recordings, query, loops,
                                     drives_[*asking].datum.get());
  const auto is_own = [&](std::size_t drive) { return drive == *asking; };
  // The frame that holds an end of a link, if it is one that is seen.
  const auto frame_at = [&](std::size_t drive,
                            NodeIndex node) -> std::optional<std::size_t> {
    if (!is_own(drive)) return FrameAt(drive, node, nodes);
    if (node > query) return std::nullopt;
    return seen.own + recordings.Of(node);
  };
  for (const FrameLink& link : links_) {
    if (!is_own(link.query_drive) && !is_own(link.matched_drive)) continue;
    const auto from = frame_at(link.query_drive, link.loop.query);
    const auto to = frame_at(link.matched_drive, link.loop.matched);
    if (from && to) seen.relations.AddLink(*from, *to, link.loop);
  }
  return seen;
}

std::vector<NodeRange> JoinedDrives::NotSought(std::size_t drive,
                                               std::size_t asking,
                                               const PoseGraph& graph,
                                               const Recordings& recordings,
                                               NodeIndex query,
                                               double separation_meters) const {
  std::vector<NodeRange> nodes;
  const DriveView& other = view(drive);
  const double around = RejectedRadiusMeters(separation_meters);
  for (const FrameLink& pair : rejected_) {
    const bool asks = pair.query_drive == asking;
    const std::size_t far_drive = asks ? pair.matched_drive : pair.query_drive;
    const std::size_t near_drive = asks ? pair.query_drive : pair.matched_drive;
    if (near_drive != asking || far_drive != drive) continue;
    const NodeIndex near = asks ? pair.loop.query : pair.loop.matched;
    const NodeIndex far = asks ? pair.loop.matched : pair.loop.query;
    if (near < graph.size() && far < other.graph.size() &&
        IsNearRejected(graph, recordings, near, around, query)) {
      nodes.push_back(NodesAround(other.graph, other.recordings, far, around));
    }
  }
  return nodes;
}

std::vector<std::vector<FrameRelation>> JoinedDrives::SeenFromLast(
    std::size_t asking) const {
  std::vector<std::vector<FrameRelation>> by_drive(drives_.size());
  const DriveView& own = view(asking);
  if (own.graph.size() == 0) return by_drive;
  const FrameNodes nodes{own.graph, own.state_space, own.correlation};
  const SeenFrames seen =
      SeenFrom(nodes, own.recordings, own.graph.size() - 1, own.loops, asking);
  const std::vector<FrameRelation> relations =
      seen.relations.From(seen.own + CountRecordings(own) - 1);
  for (std::size_t drive = 0; drive < drives_.size(); ++drive) {
    const std::optional<std::size_t> first =
        drive == asking ? seen.own : FrameOf(drive, nodes);
    if (!first) continue;
    const auto begin = relations.begin() + static_cast<std::ptrdiff_t>(*first);
    by_drive[drive].assign(begin, begin + static_cast<std::ptrdiff_t>(
                                              CountRecordings(view(drive))));
  }
  return by_drive;
}

}  // namespace revisit::core
