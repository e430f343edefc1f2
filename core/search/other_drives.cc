#include "core/search/other_drives.h"

#include <algorithm>
#include <iterator>
#include <utility>

#include "core/drive/node_range.h"
#include "core/search/alignment/relation.h"

namespace revisit::core {
namespace {

DrivenMotion MotionOf(const DriveView& view) {
  return {view.graph, &view.motion_history, view.graph.size() - 1};
}

}  // namespace

void GrowthOfOthers::Enter(const std::shared_ptr<const JoinedDrives>& drives) {
  if (drives == drives_) return;
  const auto is_joined = [&](const DriveView* view) {
    for (std::size_t d = 0; d < drives->size(); ++d) {
      if (&drives->view(d) == view) return true;
    }
    return false;
  };
  for (auto kept = growing_.begin(); kept != growing_.end();) {
    kept = is_joined(std::get<0>(kept->first)) ? std::next(kept)
                                               : growing_.erase(kept);
  }
  drives_ = drives;
}

const Growth& GrowthOfOthers::Of(std::size_t drive, std::size_t recording,
                                 NodeIndex reference) {
  const DriveView& view = drives_->view(drive);
  const NodeRange nodes = view.recordings.NodesOf(recording, view.graph.size());
  if (reference == nodes.first) {
    const Growth* const growth = drives_->GrowthFromFirst(drive, recording);
    if (growth != nullptr) return *growth;
  }
  const auto [growing, is_new] =
      growing_.try_emplace({&view, recording, reference});
  if (is_new) {
    growing->second =
        GrowthFrom(view.state_space, view.graph, nodes, reference);
  }
  return growing->second;
}

OtherDrives::OtherDrives(const DriveSettings& settings,
                         const SearchOptions& options, const SearchScope& scope)
    : scope_(scope), separation_meters_(options.candidate_separation_meters) {
  for (std::size_t d = 0; d < scope.drives->size(); ++d) {
    const DriveView& view = scope.drives->view(d);
    if (scope.asking == d || !scope.Searches(d)) continue;
    if (const auto reason = WhyNot(d, settings, options)) {
      unsearched_.push_back({d, *reason});
    } else if (view.graph.size() > 0) {
      searched_.push_back(d);
      motion_.drives.push_back(MotionOf(view));
    }
  }
  PoolMotion();
}

// Takes the drives of a pool that are not searched back out of it, unless most
// are not.
void OtherDrives::PoolMotion() {
  const JoinedDrives& drives = *scope_.drives;
  auto next = searched_.begin();
  for (std::size_t first = 0; first < drives.size(); first += kDrivesOfPool) {
    const std::size_t last = std::min(first + kDrivesOfPool, drives.size());
    std::vector<DrivenMotion> searched;
    std::vector<DrivenMotion> others;
    for (std::size_t d = first; d < last; ++d) {
      const DriveView& view = drives.view(d);
      const bool is_searched = next != searched_.end() && *next == d;
      if (is_searched) ++next;
      if (view.graph.size() == 0) continue;
      (is_searched ? searched : others).push_back(MotionOf(view));
    }
    const MotionPool* const pool = drives.PoolFrom(first);
    if (pool != nullptr && others.size() < searched.size()) {
      motion_.pooled.push_back({*pool, std::move(others)});
    } else {
      for (const DrivenMotion& motion : searched) {
        motion_.alone.push_back(motion);
      }
    }
  }
}

std::optional<UnsearchedReason> OtherDrives::WhyNot(
    std::size_t drive, const DriveSettings& settings,
    const SearchOptions& options) const {
  const DriveView& view = scope_.drives->view(drive);
  if (options.alignment != AlignmentKind::kRelative) {
    return UnsearchedReason::kAlignment;
  }
  if (view.state_space != settings.state_space) {
    return UnsearchedReason::kStateSpace;
  }
  const CorrelationModel own = settings.search.correlation_model;
  if (view.correlation.model != own || options.correlation_model != own) {
    return UnsearchedReason::kNoiseModel;
  }
  if (view.node_spacing_meters != settings.node_spacing_meters) {
    return UnsearchedReason::kNodeSpacing;
  }
  return std::nullopt;
}

NodeIndex OtherDrives::size() const {
  NodeIndex size = 0;
  for (const DrivenMotion& motion : motion_.drives) size += motion.last + 1;
  return size;
}

void OtherDrives::AddHistories(const FrameRelations& frames,
                               const std::vector<FrameRelation>& ties,
                               const Asking& asking, GrowthOfOthers* growth,
                               std::vector<History>* histories) const {
  growth->Enter(scope_.drives);
  histories->reserve(histories->size() + searched_.size());
  for (const std::size_t d : searched_) {
    const DriveView& view = scope_.drives->view(d);
    const std::size_t first = *scope_.drives->FrameOf(d, asking.nodes);
    std::vector<NodeRange> not_sought;
    if (scope_.asking) {
      not_sought = scope_.drives->NotSought(
          d, *scope_.asking, asking.nodes.graph, asking.recordings,
          asking.query, separation_meters_);
    }
    for (std::size_t k = 0; k < view.recordings.size(); ++k) {
      const std::size_t frame = first + k;
      const NodeRange range = view.recordings.NodesOf(k, view.graph.size());
      History history{
          view.graph,
          range.last,
          not_sought,
          &view.motion_history.heading_bins(),
          &view.block_bounds,
          Relation(frames.Between(asking.frame, frame), ties[frame], {}),
          range.first,
          frame};
      if (const auto& reference = ties[frame].other_node) {
        // FarHistories reads it.
        view.graph.Prefetch(*reference);
        const Growth& of_history = growth->Of(d, k, *reference);
        history.growing = &of_history.blocks;
        history.all_grow = of_history.all_grow;
      }
      history.drive = d;
      history.extents = &view.extents[k];
      history.known_scale = view.scale;
      histories->push_back(std::move(history));
    }
  }
}

}  // namespace revisit::core
