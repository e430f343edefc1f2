#include "core/drive/frame_relations.h"

#include <algorithm>
#include <cassert>
#include <functional>
#include <limits>
#include <numeric>
#include <queue>
#include <string>
#include <utility>

#include "core/geometry/frame_transform.h"
#include "core/geometry/recording_start.h"
#include "core/geometry/state_matrix.h"
#include "core/noise/dead_reckoning.h"

namespace revisit::core {
namespace {

// How far from its place a relation has to hold when it is compared with
// another one, m: by so much the error of its heading counts.
constexpr double kComparedAtMeters = 100.0;

double VarianceOf(const FrameRelation& relation) {
  const StateMatrix<4> p =
      relation.fixed + relation.drift + relation.known_drift;
  return p(0, 0) + p(1, 1) + p(2, 2) +
         kComparedAtMeters * kComparedAtMeters * p(3, 3);
}

StateMatrix<4> InSpace(StateSpace space, const Covariance& covariance) {
  StateMatrix<4> matrix = ToMatrix<4>(covariance);
  if (space == StateSpace::kPlanar) {
    matrix.row(2).setZero();
    matrix.col(2).setZero();
  }
  return matrix;
}

}  // namespace

FrameRelations::FrameRelations(const FrameNodes& nodes,
                               const Recordings& recordings, NodeIndex query,
                               const std::vector<ConfirmedLoop>& loops) {
  AddDrive(nodes, recordings, query, loops);
}

FrameRelations::FrameRelations(const FrameRelations* base, std::size_t first,
                               std::size_t last)
    : base_(base),
      cut_first_(first),
      cut_last_(last),
      edges_(base->frames()),
      recordings_(base->recordings_),
      shared_(base->shared_) {
  assert(base->base_ == nullptr && base->frames() > 0);
}

std::size_t FrameRelations::AddDrive(const FrameNodes& nodes,
                                     const Recordings& recordings,
                                     NodeIndex query,
                                     const std::vector<ConfirmedLoop>& loops,
                                     const RecordingStart* datum) {
  const std::size_t drive = nodes_.size();
  nodes_.push_back(nodes);
  const std::size_t count = recordings.Of(query) + 1;
  const std::size_t first = AddFrames(count, drive);
  if (drive == 0 && base_ == nullptr) {
    recordings_ = count;
    shared_ = AddFrames(1, drive);
  }
  for (std::size_t k = 0; k < count; ++k) {
    const bool is_first = k == 0;
    const RecordingStart* const start =
        is_first && datum != nullptr ? datum : recordings[k].start.get();
    if (start != nullptr) AddStart(*start, recordings[k], first + k, is_first);
  }
  for (const ConfirmedLoop& loop : loops) {
    const std::size_t from = recordings.Of(loop.query);
    const std::size_t to = recordings.Of(loop.matched);
    if (from != to) AddLoop(first + from, first + to, loop);
  }
  return first;
}

void FrameRelations::AddLink(std::size_t from, std::size_t to,
                             const ConfirmedLoop& link) {
  links_[{from, to}].push_back({link.query, link.matched, nullptr});
  links_[{to, from}].push_back({link.matched, link.query, nullptr});
  AddLoop(from, to, link);
}

std::size_t FrameRelations::AddFrames(std::size_t count, std::size_t drive) {
  const std::size_t first = edges_.size();
  edges_.resize(first + count);
  drive_of_.resize(edges_.size() - frames_of_base(), drive);
  return first;
}

void FrameRelations::Add(std::size_t from, std::size_t to,
                         const FrameRelation& relation) {
  edges_[from].push_back({to, relation});
  edges_[to].push_back({from, Reversed(NodesOf(from), relation)});
}

void FrameRelations::AddStart(const RecordingStart& start,
                              const Recording& recording, std::size_t frame,
                              bool is_first) {
  if (start.relation == RecordingRelation::kUnknown) return;
  const NodeIndex first = recording.first_node;
  if (start.relation == RecordingRelation::kDatum) {
    AddDatum(start, frame, first);
    return;
  }
  if (is_first) return;
  const FrameNodes& nodes = NodesOf(frame);
  const Pose begin = nodes.graph.pose(first);
  FrameRelation after;
  after.state = FrameState::kAfter;
  after.transform = Compose(begin, Inverse(recording.end_before));
  after.place = nodes.graph.pose(first - 1);
  // From the last pose, which is where the start is, to the last node.
  after.fixed = Swung<4>(InSpace(nodes.state_space, start.covariance), begin,
                         Compose(after.transform, after.place));
  if (nodes.have_references()) {
    after.asking_node = first;
    after.other_node = first - 1;
  }
  Add(frame, frame - 1, after);
}

void FrameRelations::AddDatum(const RecordingStart& start, std::size_t frame,
                              NodeIndex first_node) {
  const FrameNodes& nodes = NodesOf(frame);
  // The shared frame, as the recording sees it.
  FrameRelation shared;
  shared.state = FrameState::kDatum;
  shared.transform = Inverse(start.datum);
  shared.place = Compose(start.datum, nodes.graph.pose(first_node));
  if (nodes.have_references()) shared.asking_node = first_node;
  const StateMatrix<4> error = InSpace(nodes.state_space, start.covariance);
  if (start.datum_id.empty()) {
    shared.fixed = Turned<4>(error, shared.transform.heading);
    Add(frame, shared_, shared);
    return;
  }
  // Whoever has the datum too errs alike: the datum has a frame of its own,
  // which errs in the shared one.
  const auto [datum_frame, is_new] =
      DatumFrame(start.datum_id, drive_of_[frame - frames_of_base()]);
  if (is_new) {
    FrameRelation datum;
    datum.state = FrameState::kDatum;
    datum.place = shared.place;
    datum.fixed = error;
    Add(datum_frame, shared_, datum);
  }
  Add(frame, datum_frame, shared);
}

std::pair<std::size_t, bool> FrameRelations::DatumFrame(const std::string& name,
                                                        std::size_t drive) {
  if (base_ != nullptr) {
    const auto known = base_->datum_frames_.find(name);
    if (known != base_->datum_frames_.end()) return {known->second, false};
  }
  const auto [known, is_new] = datum_frames_.try_emplace(name, frames());
  if (is_new) AddFrames(1, drive);
  return {known->second, is_new};
}

void FrameRelations::AddLoop(std::size_t from, std::size_t to,
                             const ConfirmedLoop& loop) {
  const auto with_links = [](std::size_t frame) {
    return [frame](const Edge& edge) {
      return edge.to == frame && edge.relation.links > 0;
    };
  };
  const auto tied =
      std::find_if(edges_[from].begin(), edges_[from].end(), with_links(to));
  const RelatedFrames frames = Between(from, to);
  if (tied == edges_[from].end()) {
    // A closure that contradicts what others have tied leaves it as it is.
    const FrameRelation by =
        TiedBy(frames, From(from, {to}).front(), loop, 1.0);
    if (by.links > 0) Add(from, to, by);
    return;
  }
  tied->relation = TiedBy(frames, tied->relation, loop, 1.0);
  std::find_if(edges_[to].begin(), edges_[to].end(), with_links(from))
      ->relation = Reversed(frames.asking, tied->relation);
}

std::vector<FrameRelation> FrameRelations::From(std::size_t asking) const {
  std::vector<std::size_t> places(frames());
  std::iota(places.begin(), places.end(), std::size_t{0});
  return Reach(asking, places, places.size());
}

std::vector<FrameRelation> FrameRelations::From(
    std::size_t asking, const std::vector<std::size_t>& others) const {
  std::vector<std::size_t> ends = others;
  ends.push_back(asking);
  const std::vector<std::size_t> places = PlacesAmong(ends);
  const auto count =
      places.size() - static_cast<std::size_t>(std::count(
                          places.begin(), places.end(), kPassedOver));
  const std::vector<FrameRelation> reached = Reach(asking, places, count);
  std::vector<FrameRelation> relations;
  relations.reserve(others.size());
  for (const std::size_t other : others) {
    relations.push_back(reached[places[other]]);
  }
  return relations;
}

// A way that enters a frame with one edge ends there. Without such frames,
// others have one edge.
std::vector<std::size_t> FrameRelations::PlacesAmong(
    const std::vector<std::size_t>& ends) const {
  std::vector<std::size_t> places(frames());
  std::vector<std::size_t> edges(frames());
  std::vector<std::size_t> blind;
  const auto pass_over = [&](std::size_t frame) {
    if (edges[frame] > 1 || places[frame] != 0) return;
    places[frame] = kPassedOver;
    blind.push_back(frame);
  };
  constexpr std::size_t kIsEnd = 1;
  for (const std::size_t end : ends) places[end] = kIsEnd;
  for (std::size_t frame = 0; frame < frames(); ++frame) {
    VisitEdges(frame, [&](const Edge&) { ++edges[frame]; });
    pass_over(frame);
  }
  while (!blind.empty()) {
    const std::size_t frame = blind.back();
    blind.pop_back();
    VisitEdges(frame, [&](const Edge& edge) {
      --edges[edge.to];
      pass_over(edge.to);
    });
  }
  std::size_t next = 0;
  for (std::size_t& place : places) {
    if (place != kPassedOver) place = next++;
  }
  return places;
}

std::vector<FrameRelation> FrameRelations::Reach(
    std::size_t asking, const std::vector<std::size_t>& places,
    std::size_t count) const {
  std::vector<FrameRelation> relations(count);
  std::vector<double> unsure(count, std::numeric_limits<double>::infinity());
  std::vector<char> done(count);
  relations[places[asking]].state = FrameState::kSame;
  unsure[places[asking]] = 0.0;
  using Reached = std::pair<double, std::size_t>;
  std::priority_queue<Reached, std::vector<Reached>, std::greater<>> next;
  next.push({0.0, asking});
  while (!next.empty()) {
    const std::size_t frame = next.top().second;
    next.pop();
    if (done[places[frame]]) continue;
    done[places[frame]] = 1;
    VisitEdges(frame, [&](const Edge& edge) {
      const std::size_t to = places[edge.to];
      if (to == kPassedOver || done[to]) return;
      const FrameRelation relation =
          frame == asking ? edge.relation
                          : Compose(NodesOf(frame), relations[places[frame]],
                                    edge.relation);
      // Written so that NaN leads nowhere.
      const double sure = VarianceOf(relation);
      if (!(sure < unsure[to])) return;
      unsure[to] = sure;
      relations[to] = relation;
      next.push({sure, edge.to});
    });
  }
  return relations;
}

const std::vector<ConfirmedLoop>& FrameRelations::LinksBetween(
    std::size_t from, std::size_t to) const {
  static const auto* const kNone = new std::vector<ConfirmedLoop>();
  if (IsCut(from) || IsCut(to)) return *kNone;
  const auto links = links_.find({from, to});
  if (links != links_.end()) return links->second;
  return base_ == nullptr ? *kNone : base_->LinksBetween(from, to);
}

}  // namespace revisit::core
