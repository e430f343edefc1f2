#include "core/search/other_drives.h"

#include <iterator>
#include <utility>

#include "core/drive/block_growth.h"
#include "core/drive/node_range.h"
#include "core/search/alignment/relation.h"

namespace revisit::core {

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

const std::vector<char>& GrowthOfOthers::Of(const DriveView& view,
                                            std::size_t recording,
                                            NodeIndex reference) {
  const auto [growing, is_new] =
      growing_.try_emplace({&view, recording, reference});
  if (is_new) {
    growing->second = BlocksGrowing(
        view.state_space, view.graph,
        view.recordings.NodesOf(recording, view.graph.size()), reference);
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
      motion_.push_back(
          {view.graph, &view.motion_history, view.graph.size() - 1});
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
  for (const DrivenMotion& motion : motion_) size += motion.last + 1;
  return size;
}

void OtherDrives::AddHistories(const FrameRelations& frames,
                               const std::vector<FrameRelation>& ties,
                               const Asking& asking, GrowthOfOthers* growth,
                               std::vector<History>* histories) const {
  growth->Enter(scope_.drives);
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
        history.growing = &growth->Of(view, k, *reference);
      }
      history.drive = d;
      history.known_scale = view.scale;
      histories->push_back(std::move(history));
    }
  }
}

}  // namespace revisit::core
