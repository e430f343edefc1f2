#include "core/drive/frame_relations.h"

#include <algorithm>
#include <functional>
#include <limits>
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
  const StateMatrix<4> p = relation.fixed + relation.drift;
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
                               const std::vector<ConfirmedLoop>& loops)
    : nodes_(nodes), recordings_(recordings.Of(query) + 1) {
  edges_.resize(recordings_ + 1);
  if (recordings_ == 1) return;
  AddStarts(recordings);
  for (const ConfirmedLoop& loop : loops) {
    const std::size_t from = recordings.Of(loop.query);
    const std::size_t to = recordings.Of(loop.matched);
    if (from != to) AddLoop(from, to, loop);
  }
}

void FrameRelations::Add(std::size_t from, std::size_t to,
                         const FrameRelation& relation) {
  edges_[from].push_back({to, relation});
  edges_[to].push_back({from, Reversed(nodes_, relation)});
}

void FrameRelations::AddStarts(const Recordings& recordings) {
  for (std::size_t k = 0; k < recordings_; ++k) {
    const Recording& recording = recordings[k];
    if (recording.start == nullptr ||
        recording.start->relation == RecordingRelation::kUnknown) {
      continue;
    }
    if (recording.start->relation == RecordingRelation::kDatum) {
      AddDatum(*recording.start, k, recording.first_node);
      continue;
    }
    if (k == 0) continue;
    const NodeIndex first = recording.first_node;
    const Pose start = nodes_.graph.pose(first);
    FrameRelation after;
    after.state = FrameState::kAfter;
    after.transform = Compose(start, Inverse(recording.end_before));
    after.place = nodes_.graph.pose(first - 1);
    // From the last pose, which is where the start is, to the last node.
    after.fixed =
        Swung<4>(InSpace(nodes_.state_space, recording.start->covariance),
                 start, Compose(after.transform, after.place));
    if (nodes_.have_references()) {
      after.asking_node = first;
      after.other_node = first - 1;
    }
    Add(k, k - 1, after);
  }
}

void FrameRelations::AddDatum(const RecordingStart& start,
                              std::size_t recording, NodeIndex first_node) {
  // The shared frame, as the recording sees it.
  FrameRelation shared;
  shared.state = FrameState::kDatum;
  shared.transform = Inverse(start.datum);
  shared.place = Compose(start.datum, nodes_.graph.pose(first_node));
  if (nodes_.have_references()) shared.asking_node = first_node;
  const StateMatrix<4> error = InSpace(nodes_.state_space, start.covariance);
  if (start.datum_id.empty()) {
    shared.fixed = Turned<4>(error, shared.transform.heading);
    Add(recording, recordings_, shared);
    return;
  }
  // Whoever has the datum too errs alike: the datum has a frame of its own,
  // which errs in the shared one.
  const auto known =
      std::find(datum_ids_.begin(), datum_ids_.end(), start.datum_id);
  const auto id = static_cast<std::size_t>(known - datum_ids_.begin());
  const std::size_t frame = recordings_ + 1 + id;
  if (known == datum_ids_.end()) {
    datum_ids_.push_back(start.datum_id);
    edges_.emplace_back();
    FrameRelation datum;
    datum.state = FrameState::kDatum;
    datum.place = shared.place;
    datum.fixed = error;
    Add(frame, recordings_, datum);
  }
  Add(recording, frame, shared);
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
  if (tied == edges_[from].end()) {
    // A closure that contradicts what others have tied leaves it as it is.
    const FrameRelation by = TiedBy(nodes_, From(from)[to], loop, 1.0);
    if (by.links > 0) Add(from, to, by);
    return;
  }
  tied->relation = TiedBy(nodes_, tied->relation, loop, 1.0);
  std::find_if(edges_[to].begin(), edges_[to].end(), with_links(from))
      ->relation = Reversed(nodes_, tied->relation);
}

std::vector<FrameRelation> FrameRelations::From(std::size_t asking) const {
  std::vector<FrameRelation> relations(edges_.size());
  std::vector<double> unsure(edges_.size(),
                             std::numeric_limits<double>::infinity());
  std::vector<char> done(edges_.size());
  relations[asking].state = FrameState::kSame;
  unsure[asking] = 0.0;
  using Reached = std::pair<double, std::size_t>;
  std::priority_queue<Reached, std::vector<Reached>, std::greater<>> next;
  next.push({0.0, asking});
  while (!next.empty()) {
    const std::size_t frame = next.top().second;
    next.pop();
    if (done[frame]) continue;
    done[frame] = 1;
    for (const Edge& edge : edges_[frame]) {
      if (done[edge.to]) continue;
      const FrameRelation relation =
          frame == asking ? edge.relation
                          : Compose(nodes_, relations[frame], edge.relation);
      // Written so that NaN leads nowhere.
      const double sure = VarianceOf(relation);
      if (!(sure < unsure[edge.to])) continue;
      unsure[edge.to] = sure;
      relations[edge.to] = relation;
      next.push({sure, edge.to});
    }
  }
  relations.resize(recordings_);
  return relations;
}

}  // namespace revisit::core
