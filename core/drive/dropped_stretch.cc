#include "core/drive/dropped_stretch.h"

#include <algorithm>
#include <cassert>
#include <iterator>
#include <limits>

#include "core/drive/pose_graph.h"
#include "core/geometry/state_matrix.h"

namespace revisit::core {

void DroppedStretchMaker::Add(const PoseSample& sample) {
  StepTo(sample.pose);
  Extend(sample.sequence, sample.sequence, sample.transition);
}

void DroppedStretchMaker::Add(const DroppedStretch& stretch) {
  // Its distance begins at the last pose that was added and ends at the next.
  stretch_.travelled_meters += stretch.travelled_meters;
  anchor_.reset();
  Extend(stretch.first_sequence, stretch.last_sequence, stretch.transition);
}

void DroppedStretchMaker::StepTo(const Pose& pose) {
  if (!anchor_) {
    anchor_ = pose;
    return;
  }
  const double step = Distance(*anchor_, pose, options_.state_space);
  if (options_.IsStandstill(step)) return;
  if (!options_.IsJump(step)) stretch_.travelled_meters += step;
  anchor_ = pose;
}

void DroppedStretchMaker::Extend(
    std::uint64_t first_sequence, std::uint64_t last_sequence,
    const std::optional<ErrorTransition>& transition) {
  assert(stretch_.first_sequence == 0 ||
         first_sequence == stretch_.last_sequence + 1);
  if (stretch_.first_sequence == 0) stretch_.first_sequence = first_sequence;
  stretch_.last_sequence = last_sequence;
  if (transition) {
    transition_ = ToErrorTransition<4>(ToMatrix<4>(*transition) *
                                       ToMatrix<4>(transition_));
  }
}

DroppedStretch DroppedStretchMaker::Take() const {
  assert(stretch_.first_sequence > 0);
  DroppedStretch stretch = stretch_;
  if (options_.carry_transitions) {
    // Errors that a filter lets grow beyond all numbers have nothing to do with
    // those before.
    const StateMatrix<4> transition = ToMatrix<4>(transition_);
    const bool is_sound =
        transition.lpNorm<Eigen::Infinity>() <= kMaxTransitionEntry;
    stretch.transition =
        ToErrorTransition<4>(is_sound ? transition : StateMatrix<4>::Zero());
  }
  return stretch;
}

void DroppedStretches::Add(const DroppedStretch& stretch, NodeIndex next_node) {
  assert(gaps_.empty() || stretch.first_sequence > gaps_.back().last_sequence);
  count_ += stretch.last_sequence - stretch.first_sequence + 1;
  const double so_far = stretch.travelled_meters +
                        (gaps_.empty() ? 0.0 : gaps_.back().meters_so_far);
  if (!gaps_.empty() &&
      gaps_.back().last_sequence + 1 == stretch.first_sequence) {
    gaps_.back().last_sequence = stretch.last_sequence;
    gaps_.back().meters_so_far = so_far;
    return;
  }
  gaps_.push_back(
      {stretch.first_sequence, stretch.last_sequence, next_node, so_far});
}

std::uint64_t DroppedStretches::KeptFrom(std::uint64_t sequence) const {
  const auto gap = std::lower_bound(gaps_.begin(), gaps_.end(), sequence,
                                    [](const Gap& a, std::uint64_t wanted) {
                                      return a.last_sequence < wanted;
                                    });
  const bool is_dropped = gap != gaps_.end() && gap->first_sequence <= sequence;
  return is_dropped ? gap->last_sequence + 1 : sequence;
}

double DroppedStretches::MetersBefore(NodeIndex node) const {
  const auto after = std::upper_bound(
      gaps_.begin(), gaps_.end(), node,
      [](NodeIndex wanted, const Gap& gap) { return wanted < gap.node; });
  return after == gaps_.begin() ? 0.0 : std::prev(after)->meters_so_far;
}

void DroppedStretches::Save(ByteWriter* writer) const {
  writer->PutCounted(gaps_.data(), gaps_.size());
}

bool DroppedStretches::Load(NodeIndex nodes, std::uint64_t last_sequence,
                            ByteReader* reader) {
  if (!reader->GetCounted(reader->rest().size(), &gaps_)) return false;
  Gap before;
  for (const Gap& gap : gaps_) {
    // Written so that NaN is refused.
    if (!(gap.first_sequence > before.last_sequence &&
          gap.last_sequence >= gap.first_sequence &&
          gap.last_sequence <= last_sequence && gap.node >= before.node &&
          gap.node <= nodes && gap.meters_so_far >= before.meters_so_far &&
          gap.meters_so_far <= std::numeric_limits<double>::max())) {
      return false;
    }
    count_ += gap.last_sequence - gap.first_sequence + 1;
    before = gap;
  }
  return true;
}

std::optional<NodeIndex> NodeOf(const PoseGraph& graph,
                                const DroppedStretches& dropped,
                                std::uint64_t sequence) {
  if (dropped.Contains(sequence)) return std::nullopt;
  return graph.NodeAtOrBefore(sequence);
}

}  // namespace revisit::core
