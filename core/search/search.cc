#include "core/search/search.h"

#include <algorithm>
#include <array>
#include <cassert>
#include <cmath>
#include <map>
#include <memory>
#include <optional>
#include <utility>
#include <vector>

#include "core/drive/block_growth.h"
#include "core/drive/claimed_model.h"
#include "core/drive/confirmed_loop.h"
#include "core/drive/drive.h"
#include "core/drive/dropped_stretch.h"
#include "core/drive/frame_relations.h"
#include "core/drive/node_range.h"
#include "core/drive/pose_graph.h"
#include "core/drive/recordings.h"
#include "core/noise/noise_model.h"
#include "core/search/alignment/history.h"
#include "core/search/alignment/query.h"
#include "core/search/alignment/relation.h"
#include "core/search/alignment/relative.h"
#include "core/search/alignment/walked_ends.h"
#include "core/search/belief/drive_belief.h"
#include "core/search/belief/mark.h"
#include "core/search/belief/mark_bytes.h"
#include "core/search/candidates/composite_search.h"
#include "core/search/candidates/mark_search.h"
#include "core/search/candidates/relative_search.h"
#include "core/search/candidates/search_task.h"
#include "core/search/other_drives.h"
#include "core/search/search_scope.h"

namespace revisit::core {
namespace {

// Marks whose evidence is kept for later searches before those that the search
// at hand does not need are forgotten. A search needs at most a sixth of it.
constexpr std::size_t kMostMarksKept =
    6 * static_cast<std::size_t>(kMostScaleMarks + kDriftMarks);

// How far the recent path and another recording are compared, at least.
constexpr double kOverlapAcrossMeters = 1000.0;

// Recordings and references of which is kept where errors grow, beyond those of
// one search.
constexpr std::size_t kMostGrowingKept = 4096;

// How far a place that a mark found and one that was confirmed may lie from
// each other along a road on which both passes ran on together, m: a verifier
// confirms a candidate that is some metres off, and marks slip as far.
constexpr double kAgreeingMeters = 30.0;

// Whether a closure leaves the mark what it has shown: they are of one pass
// beside the same other one, as far apart there as here, and nothing was
// measured. Such a closure does not say where along the road the vehicle is,
// and the next candidate, found with it, is as far off as it is; marks do not
// depend on each other.
bool Agree(const PoseGraph& graph, const MarkEvidence& mark,
           const ConfirmedLoop& closure) {
  return closure.measured == nullptr &&
         std::abs(graph.MetersApart(mark.node, closure.query) -
                  graph.MetersApart(*mark.matched, closure.matched)) <=
             kAgreeingMeters;
}

// Fills in what a search finds that has something to compare.
absl::Status FindCandidates(const SearchTask& task, CandidateSet* set) {
  const CandidateSet before = *set;
  set->nodes_considered = task.history_size();
  if (task.prior.belief) set->scale = task.prior.belief->Scale();
  const absl::Status status =
      task.options.alignment == AlignmentKind::kComposite
          ? SearchComposite(task, set)
          : SearchRelative(task, set);
  if (!status.ok()) return status;
  if (set->empty_reason == EmptyReason::kTooMuchWork) {
    const std::int64_t comparisons = set->comparisons;
    *set = before;
    set->comparisons = comparisons;
    set->empty_reason = EmptyReason::kTooMuchWork;
    return absl::OkStatus();
  }
  for (std::size_t i = 0; i < set->candidates.size(); ++i) {
    set->candidates[i].rank = static_cast<int>(i) + 1;
  }
  if (set->candidates.empty()) {
    set->empty_reason = set->nodes_pruned > 0 ? EmptyReason::kNoProbablePlace
                                              : EmptyReason::kNoAlignment;
  }
  return absl::OkStatus();
}

}  // namespace

class Search::Impl {
 public:
  explicit Impl(const Drive* drive) : drive_(*drive) {}

  // `others`: the other drives that are searched, or null.
  absl::StatusOr<CandidateSet> At(NodeIndex query, const SearchOptions& options,
                                  const OtherDrives* others,
                                  const ShouldStop& should_stop);
  absl::StatusOr<CandidateSet> AtEnd(const SearchOptions& options,
                                     const ShouldStop& should_stop);
  std::int64_t ComparisonsAt(NodeIndex query,
                             const SearchOptions& options) const;
  std::int64_t last_comparisons() const { return last_comparisons_; }
  std::optional<MissingMark> FindMissingMark(NodeIndex query,
                                             const SearchOptions& options);
  absl::Status LearnMark(const MissingMark& missing,
                         const ShouldStop& should_stop);
  const MarkMemory& marks() const { return marks_; }
  std::string SaveMarks() {
    marks_.Enter(drive_.mark_settings_version());
    return core::SaveMarks(marks_, Marks(), drive_.settings());
  }
  bool LoadMarks(absl::string_view bytes) {
    marks_.Enter(drive_.mark_settings_version());
    return core::LoadMarks(bytes, Marks(), drive_.settings(), &marks_);
  }
  const DriveSettings& settings() const { return drive_.settings(); }

 private:
  // The nodes that are compared at a query.
  struct Extent {
    // Why there is nothing to compare.
    std::optional<EmptyReason> empty;
    // Nodes of the path that is aligned with the history, and with other
    // recordings, if any are compared.
    std::int64_t aligned = 0;
    std::int64_t aligned_across = 0;
    // The query's recording, and its nodes that are compared.
    std::size_t recording = 0;
    NodeRange own;
    // Whether the recordings before it are compared too.
    bool across = false;
    // Nodes of other drives that are.
    NodeIndex others = 0;
    // Counts the drive's own nodes only.
    std::int64_t comparisons = 0;
  };
  // The marks that show something at a query.
  struct MarksBefore {
    ScaleMarks of_scale;
    std::int64_t first_of_drift;
    std::int64_t last;
  };

  Extent ExtentOf(NodeIndex query, const SearchOptions& options,
                  const OtherDrives* others = nullptr) const;
  // The same of a search, which may also be refused.
  Extent ExtentOfSearch(NodeIndex query, const SearchOptions& options,
                        const OtherDrives* others = nullptr) const;
  // REQUIRES: the query's segment has as many nodes as the sequence up to the
  // query.
  std::int64_t AlignedNodes(NodeIndex query, std::int64_t sequence_nodes,
                            const SearchOptions& options) const;
  std::int64_t AlignedAcross(NodeIndex query, std::int64_t aligned_nodes) const;
  Query QueryAt(NodeIndex node, std::int64_t aligned) const;
  void SeeOthers(const OtherDrives& others, SearchTask* task) const;
  // The past of the query's own recording, as far as it is compared with a
  // query of this extent. `frame`: that of the recording.
  History PastOf(const Extent& extent, std::vector<NodeRange> not_sought,
                 std::size_t frame) const;
  // Fills in the histories of a task of this extent, with its frames. `belief`:
  // what marks have shown, or null.
  void AddHistories(const Extent& extent, const OtherDrives* others,
                    const std::vector<NodeRange>& not_sought,
                    const DriveBelief* belief, SearchTask* task);
  // In which blocks of a recording errors grow to or from this node.
  const std::vector<char>* GrowingBlocks(std::size_t recording,
                                         std::optional<NodeIndex> reference);
  // Searches the marks that are not known. Returns CANCELLED if told to stop.
  absl::StatusOr<SearchPrior> PriorAt(NodeIndex query,
                                      const SearchOptions& options,
                                      const ShouldStop& should_stop);
  MarksBefore FindMarksBefore(NodeIndex query) const;
  // Says what the drive has shown before the query. Searches marks that are not
  // known. Returns CANCELLED if told to stop.
  absl::StatusOr<DriveBelief> BeliefAt(NodeIndex query,
                                       const ShouldStop& should_stop);
  // Whether a mark shows the drift at the query.
  bool ShowsDrift(const MarkEvidence& mark, NodeIndex query) const;
  // The evidence of a mark at this node. `parts`: see SearchTask.
  absl::StatusOr<MarkEvidence> EvidenceAt(
      NodeIndex node, const ShouldStop& should_stop,
      std::vector<AlignmentParts>* parts = nullptr);
  MarkLine Marks() const;
  SearchTask MakeTask(NodeIndex query, const Extent& extent,
                      const SearchOptions& options, SearchPrior prior,
                      const ShouldStop& should_stop) const;
  // Whether a search with these options aligns the path that a mark there does.
  bool AlignsAsMarks(const SearchOptions& options) const;
  // The mark at the query, if there is one that is not known.
  std::optional<std::int64_t> MarkToLearn(NodeIndex query) const;
  // Searches a mark. The histories and the parts are those of a search there.
  void Remember(std::int64_t mark, const std::vector<History>& histories,
                const ShouldStop& should_stop,
                std::vector<AlignmentParts>* parts);

  const Drive& drive_;
  MarkMemory marks_;
  // BlocksGrowing() of recordings that are over, whose nodes stay as they are,
  // by recording and reference.
  std::map<std::pair<std::size_t, NodeIndex>, std::vector<char>> growing_;
  GrowthOfOthers growth_of_others_;
  std::int64_t last_comparisons_ = 0;
};

Search::Search(const Drive* drive) : impl_(std::make_unique<Impl>(drive)) {}

Search::~Search() = default;

absl::StatusOr<CandidateSet> Search::At(NodeIndex query,
                                        const SearchOptions& options,
                                        const ShouldStop& should_stop) {
  return impl_->At(query, options, nullptr, should_stop);
}

absl::StatusOr<CandidateSet> Search::At(NodeIndex query,
                                        const SearchOptions& options,
                                        const SearchScope& scope,
                                        const ShouldStop& should_stop) {
  const OtherDrives others(impl_->settings(), options, scope);
  return impl_->At(query, options, &others, should_stop);
}

absl::StatusOr<CandidateSet> Search::AtEnd(const SearchOptions& options,
                                           const ShouldStop& should_stop) {
  return impl_->AtEnd(options, should_stop);
}

std::int64_t Search::ComparisonsAt(NodeIndex query,
                                   const SearchOptions& options) const {
  return impl_->ComparisonsAt(query, options);
}

std::int64_t Search::last_comparisons() const {
  return impl_->last_comparisons();
}

std::optional<Search::MissingMark> Search::FindMissingMark(
    NodeIndex query, const SearchOptions& options) {
  return impl_->FindMissingMark(query, options);
}

absl::Status Search::LearnMark(const MissingMark& missing,
                               const ShouldStop& should_stop) {
  return impl_->LearnMark(missing, should_stop);
}

std::size_t Search::mark_count() const { return impl_->marks().size(); }

std::uint64_t Search::marks_version() const { return impl_->marks().version(); }

std::string Search::SaveMarks() { return impl_->SaveMarks(); }

bool Search::LoadMarks(absl::string_view bytes) {
  return impl_->LoadMarks(bytes);
}

absl::StatusOr<CandidateSet> Search::Impl::AtEnd(
    const SearchOptions& options, const ShouldStop& should_stop) {
  const NodeIndex size = drive_.graph().size();
  if (size == 0) {
    CandidateSet empty;
    empty.empty_reason = EmptyReason::kPathTooShort;
    return empty;
  }
  return At(size - 1, options, nullptr, should_stop);
}

absl::StatusOr<CandidateSet> Search::Impl::At(NodeIndex query,
                                              const SearchOptions& options,
                                              const OtherDrives* others,
                                              const ShouldStop& should_stop) {
  assert(query >= 0 && query < drive_.graph().size());
  assert(FindProblems(options, drive_.settings()).empty());
  CandidateSet set;
  set.query = query;
  if (others != nullptr) set.unsearched = others->unsearched();
  const Extent extent = ExtentOfSearch(query, options, others);
  set.comparisons = extent.comparisons;
  last_comparisons_ = extent.empty ? 0 : extent.comparisons;
  if (extent.empty) {
    set.empty_reason = *extent.empty;
    return set;
  }
  absl::StatusOr<SearchPrior> prior = PriorAt(query, options, should_stop);
  if (!prior.ok()) return prior.status();
  if (growing_.size() > kMostGrowingKept) growing_.clear();
  SearchTask task =
      MakeTask(query, extent, options, *std::move(prior), should_stop);
  if (extent.others > 0) {
    SeeOthers(*others, &task);
  } else if (extent.across) {
    task.frames =
        std::make_shared<const FrameRelations>(drive_.RelationsAt(query));
  }
  AddHistories(extent, others,
               drive_.NotSought(query, options.candidate_separation_meters),
               task.prior.belief ? &*task.prior.belief : nullptr, &task);
  // The path of a search of other drives is weighed by their roads too.
  const std::optional<std::int64_t> mark =
      extent.others == 0 && task.prior.belief && AlignsAsMarks(options)
          ? MarkToLearn(query)
          : std::nullopt;
  std::vector<AlignmentParts> parts(task.histories.size());
  if (mark) {
    for (AlignmentParts& of_history : parts) {
      of_history.walked = std::make_shared<std::array<WalkedEnds, 2>>();
    }
  }
  task.parts = &parts;
  task.own_comparisons = extent.comparisons;
  task.comparisons = &last_comparisons_;
  const absl::Status status = FindCandidates(task, &set);
  if (!status.ok()) return status;
  if (set.empty_reason == EmptyReason::kTooMuchWork) last_comparisons_ = 0;
  if (mark) Remember(*mark, task.histories, should_stop, &parts);
  return set;
}

Search::Impl::Extent Search::Impl::ExtentOf(NodeIndex query,
                                            const SearchOptions& options,
                                            const OtherDrives* others) const {
  Extent extent;
  const std::int64_t steps = SequenceNodes(
      options.sequence_length_meters, drive_.settings().node_spacing_meters);
  if (query - drive_.graph().SegmentStart(query) + 1 < steps) {
    extent.empty = EmptyReason::kPathTooShort;
    return extent;
  }
  const Recordings& recordings = drive_.recordings();
  extent.recording = recordings.Of(query);
  // Eq. 5: the graph without the nodes of the sequence.
  extent.own = {recordings[extent.recording].first_node, query - steps + 1};
  extent.across =
      extent.own.first > 0 && options.alignment == AlignmentKind::kRelative;
  if (others != nullptr) {
    extent.others = others->size();
    if (others->scope().exclude_own) {
      extent.own.first = extent.own.last;
      extent.across = false;
    }
  }
  const NodeIndex own_size = extent.own.last - extent.own.first;
  if (own_size == 0 && !extent.across && extent.others == 0) {
    extent.empty = EmptyReason::kNoHistory;
    return extent;
  }
  extent.aligned = AlignedNodes(query, steps, options);
  extent.comparisons = extent.aligned * own_size;
  if (extent.across || extent.others > 0) {
    extent.aligned_across = AlignedAcross(query, extent.aligned);
    if (extent.across) {
      extent.comparisons += extent.aligned_across * extent.own.first;
    }
  }
  extent.comparisons *=
      static_cast<std::int64_t>(Directions(options.direction).size());
  return extent;
}

Search::Impl::Extent Search::Impl::ExtentOfSearch(
    NodeIndex query, const SearchOptions& options,
    const OtherDrives* others) const {
  Extent extent = ExtentOf(query, options, others);
  if (extent.empty) return extent;
  if (!extent.across && extent.others == 0 &&
      drive_.graph().node(query).travelled_meters -
              drive_.graph().node(extent.own.first).travelled_meters <
          options.candidate_separation_meters) {
    extent = Extent();
    extent.empty = EmptyReason::kAllSuppressed;
  } else if (extent.comparisons > options.max_comparisons) {
    extent.empty = EmptyReason::kTooMuchWork;
  }
  return extent;
}

Search::Impl::MarksBefore Search::Impl::FindMarksBefore(NodeIndex query) const {
  const std::int64_t last = Marks().LastBefore(query);
  return {ScaleMarks(last), std::max<std::int64_t>(1, last - kDriftMarks + 1),
          last};
}

std::int64_t Search::Impl::ComparisonsAt(NodeIndex query,
                                         const SearchOptions& options) const {
  const Extent extent = ExtentOfSearch(query, options);
  return extent.empty ? 0 : extent.comparisons;
}

std::optional<Search::MissingMark> Search::Impl::FindMissingMark(
    NodeIndex query, const SearchOptions& options) {
  if (!BeginsWithBelief(options, drive_.settings())) return std::nullopt;
  const Extent search = ExtentOfSearch(query, options);
  if (search.empty) return std::nullopt;
  marks_.Enter(drive_.mark_settings_version());
  const auto missing = [&](std::int64_t mark) {
    const Extent extent =
        ExtentOf(Marks().NodeOf(mark), MarkOptions(drive_.settings().search));
    return MissingMark{mark, extent.comparisons, search.comparisons};
  };
  const MarksBefore marks = FindMarksBefore(query);
  for (const std::int64_t mark : marks.of_scale.marks) {
    if (!marks_.Find(mark)) return missing(mark);
  }
  for (std::int64_t mark = marks.first_of_drift; mark <= marks.last; ++mark) {
    if (!marks_.Find(mark)) return missing(mark);
  }
  return std::nullopt;
}

absl::Status Search::Impl::LearnMark(const MissingMark& missing,
                                     const ShouldStop& should_stop) {
  const absl::StatusOr<MarkEvidence> found =
      EvidenceAt(Marks().NodeOf(missing.mark), should_stop);
  if (found.ok()) marks_.Keep(missing.mark, *found);
  return found.status();
}

absl::StatusOr<DriveBelief> Search::Impl::BeliefAt(
    NodeIndex query, const ShouldStop& should_stop) {
  marks_.Enter(drive_.mark_settings_version());
  const MarkLine line = Marks();
  const auto evidence =
      [&](std::int64_t mark) -> absl::StatusOr<const MarkEvidence*> {
    if (const MarkEvidence* known = marks_.Find(mark)) return known;
    absl::StatusOr<MarkEvidence> found =
        EvidenceAt(line.NodeOf(mark), should_stop);
    if (!found.ok()) return found.status();
    return &marks_.Keep(mark, *found);
  };
  DriveBelief belief;
  const MarksBefore marks = FindMarksBefore(query);
  for (const std::int64_t mark : marks.of_scale.marks) {
    const auto found = evidence(mark);
    if (!found.ok()) return found.status();
    belief.LearnScale(**found, marks.of_scale.stride);
  }
  for (std::int64_t mark = marks.first_of_drift; mark <= marks.last; ++mark) {
    const auto found = evidence(mark);
    if (!found.ok()) return found.status();
    if (!ShowsDrift(**found, query)) continue;
    belief.LearnDrift(drive_.graph(), drive_.recordings(), **found,
                      kDriftReach * line.spacing_meters);
  }
  marks_.Tidy(kMostMarksKept, [&](std::int64_t mark) {
    return mark >= marks.first_of_drift || mark % marks.of_scale.stride == 0;
  });
  return belief;
}

MarkLine Search::Impl::Marks() const {
  return {drive_.graph(), MarkSpacing(drive_.settings()), drive_.dropped()};
}

// Whether a search with these options aligns the path that a mark there does.
bool Search::Impl::AlignsAsMarks(const SearchOptions& options) const {
  const SearchOptions& own = drive_.settings().search;
  return own.alignment == options.alignment &&
         own.sequence_length_meters == options.sequence_length_meters &&
         own.place_tolerance == options.place_tolerance &&
         own.shape == options.shape;
}

std::optional<std::int64_t> Search::Impl::MarkToLearn(NodeIndex query) const {
  const MarkLine line = Marks();
  const std::int64_t mark = line.LastBefore(query) + 1;
  if (mark < 1 || line.NodeOf(mark) != query || marks_.Find(mark)) {
    return std::nullopt;
  }
  return mark;
}

// The next search will need the mark, which now takes less. It takes frames as
// no closure has tied them, so that other recordings may lie elsewhere.
void Search::Impl::Remember(std::int64_t mark,
                            const std::vector<History>& histories,
                            const ShouldStop& should_stop,
                            std::vector<AlignmentParts>* parts) {
  for (std::size_t h = 0; h < histories.size(); ++h) {
    if (!histories[h].relation.is_own()) (*parts)[h].axes.reset();
  }
  const absl::StatusOr<MarkEvidence> found =
      EvidenceAt(Marks().NodeOf(mark), should_stop, parts);
  if (found.ok()) marks_.Keep(mark, *found);
}

// A verifier's word counts for more than marks: of those before a closure
// only those count that agree with it, and a place that was rejected shows
// none. How frames lie a closure shows better than any mark before it. Drift
// before the query's recording is another.
bool Search::Impl::ShowsDrift(const MarkEvidence& mark, NodeIndex query) const {
  if (!mark.matched) return false;
  const Recordings& recordings = drive_.recordings();
  if (recordings.Of(mark.node) != recordings.Of(query)) return false;
  if (const auto closure =
          drive_.LastConfirmed(query, recordings.Of(*mark.matched))) {
    const bool is_later =
        mark.node > std::max(closure->query, closure->matched);
    const bool is_own = recordings.Of(*mark.matched) == recordings.Of(query);
    if (!is_later && !(is_own && Agree(drive_.graph(), mark, *closure))) {
      return false;
    }
  }
  const std::vector<NodeRange> not_sought = drive_.NotSought(
      mark.node, drive_.settings().search.candidate_separation_meters);
  return std::none_of(
      not_sought.begin(), not_sought.end(), [&mark](const NodeRange& nodes) {
        return nodes.first <= *mark.matched && *mark.matched < nodes.last;
      });
}

absl::StatusOr<MarkEvidence> Search::Impl::EvidenceAt(
    NodeIndex node, const ShouldStop& should_stop,
    std::vector<AlignmentParts>* parts) {
  const SearchOptions options = MarkOptions(drive_.settings().search);
  const Extent extent = ExtentOf(node, options);
  if (extent.empty) {
    MarkEvidence nothing;
    nothing.node = node;
    return nothing;
  }
  const NodeRange near =
      NodesNearer(drive_.graph(), node, options.candidate_separation_meters);
  SearchTask task =
      MakeTask(node, extent, options,
               {ClaimedModel(drive_.settings().state_space, options), {}, {}},
               should_stop);
  if (extent.across) {
    task.frames = std::make_shared<const FrameRelations>(
        drive_.RelationsWithoutLoops(node));
  }
  AddHistories(extent, nullptr,
               {Common(near, {extent.own.first, drive_.graph().size()})},
               nullptr, &task);
  task.parts = parts;
  return SearchMark(task);
}

SearchTask Search::Impl::MakeTask(NodeIndex query, const Extent& extent,
                                  const SearchOptions& options,
                                  SearchPrior prior,
                                  const ShouldStop& should_stop) const {
  return {QueryAt(query, extent.aligned),
          QueryAt(query, extent.aligned_across > 0 ? extent.aligned_across
                                                   : extent.aligned),
          {},
          extent.recording,
          nullptr,
          options,
          drive_.settings().node_spacing_meters,
          std::move(prior),
          should_stop};
}

Query Search::Impl::QueryAt(NodeIndex node, std::int64_t aligned) const {
  return {drive_.graph(), node, aligned, &drive_.motion_history()};
}

// Lets a task see the frames of other drives, and its query their motion.
void Search::Impl::SeeOthers(const OtherDrives& others,
                             SearchTask* task) const {
  const SearchScope& scope = others.scope();
  const NodeIndex query = task->query.node;
  SeenFrames seen =
      scope.drives->SeenFrom(drive_.frame_nodes(), drive_.recordings(), query,
                             drive_.LoopsAt(query), scope.asking);
  task->frames =
      std::make_shared<const FrameRelations>(std::move(seen.relations));
  task->first_frame = seen.own;
  task->query.others = &others.motion();
  task->across.others = &others.motion();
}

History Search::Impl::PastOf(const Extent& extent,
                             std::vector<NodeRange> not_sought,
                             std::size_t frame) const {
  return {drive_.graph(),         extent.own.last,
          std::move(not_sought),  &drive_.motion_history().heading_bins(),
          &drive_.block_bounds(), Relation(),
          extent.own.first,       frame};
}

void Search::Impl::AddHistories(const Extent& extent, const OtherDrives* others,
                                const std::vector<NodeRange>& not_sought,
                                const DriveBelief* belief, SearchTask* task) {
  const std::size_t asking = task->first_frame + extent.recording;
  if (extent.own.last > extent.own.first) {
    task->histories.push_back(PastOf(extent, not_sought, asking));
  }
  if (task->frames == nullptr) return;
  const std::vector<FrameRelation> ties = task->frames->From(asking);
  for (std::size_t k = 0; extent.across && k < extent.recording; ++k) {
    const std::size_t frame = task->first_frame + k;
    const NodeRange nodes =
        drive_.recordings().NodesOf(k, drive_.graph().size());
    Relation relation(
        task->frames->Between(asking, frame), ties[frame],
        belief == nullptr ? std::vector<WeighedDrift>() : belief->drifts(k));
    task->histories.push_back({drive_.graph(), nodes.last, not_sought,
                               &drive_.motion_history().heading_bins(),
                               &drive_.block_bounds(), std::move(relation),
                               nodes.first, frame,
                               GrowingBlocks(k, ties[frame].other_node)});
  }
  if (extent.others > 0) {
    const FrameNodes own = drive_.frame_nodes();
    others->AddHistories(*task->frames, ties,
                         {asking, own, drive_.recordings(), task->query.node},
                         &growth_of_others_, &task->histories);
  }
}

const std::vector<char>* Search::Impl::GrowingBlocks(
    std::size_t recording, std::optional<NodeIndex> reference) {
  if (!reference) return nullptr;
  const auto [growing, is_new] = growing_.try_emplace({recording, *reference});
  if (is_new) {
    growing->second = BlocksGrowing(
        drive_.settings().state_space, drive_.graph(),
        drive_.recordings().NodesOf(recording, drive_.graph().size()),
        *reference);
  }
  return &growing->second;
}

absl::StatusOr<SearchPrior> Search::Impl::PriorAt(
    NodeIndex query, const SearchOptions& options,
    const ShouldStop& should_stop) {
  SearchPrior prior;
  prior.similarity = drive_.SimilarityOf(options);
  prior.last_confirmed =
      drive_.LastConfirmed(query, drive_.recordings().Of(query));
  if (!BeginsWithBelief(options, drive_.settings())) return prior;
  absl::StatusOr<DriveBelief> belief = BeliefAt(query, should_stop);
  if (!belief.ok()) return belief.status();
  prior.belief = *std::move(belief);
  return prior;
}

std::int64_t Search::Impl::AlignedNodes(NodeIndex query,
                                        std::int64_t sequence_nodes,
                                        const SearchOptions& options) const {
  if (options.alignment == AlignmentKind::kComposite ||
      !NoiseOf(options.correlation_model).long_overlaps_tell) {
    return sequence_nodes;
  }
  return std::min(kOverlapSequences * sequence_nodes,
                  query - drive_.graph().SegmentStart(query) + 1);
}

// Where frames are not those of one recording, the shape has to show more.
std::int64_t Search::Impl::AlignedAcross(NodeIndex query,
                                         std::int64_t aligned_nodes) const {
  if (!NoiseOf(drive_.settings().search.correlation_model).long_overlaps_tell) {
    return aligned_nodes;
  }
  const double nodes =
      std::min(kOverlapAcrossMeters / drive_.settings().node_spacing_meters,
               static_cast<double>(kOverlapSequences * kMaxSequenceNodes));
  return std::min(
      std::max(aligned_nodes, static_cast<std::int64_t>(std::ceil(nodes))),
      query - drive_.graph().SegmentStart(query) + 1);
}

}  // namespace revisit::core
