#include "core/drive/drive.h"

#include <algorithm>
#include <cassert>
#include <cmath>
#include <utility>

#include "absl/strings/str_cat.h"
#include "core/base/byte_stream.h"
#include "core/drive/agreement.h"
#include "core/drive/block_bounds.h"
#include "core/drive/carried_claim.h"
#include "core/drive/claimed_model.h"
#include "core/drive/confirmed_loop.h"
#include "core/drive/consistency_monitor.h"
#include "core/drive/distance_resampler.h"
#include "core/drive/drive_view.h"
#include "core/drive/dropped_stretch.h"
#include "core/drive/frame_relations.h"
#include "core/drive/frame_watch.h"
#include "core/drive/model_check.h"
#include "core/drive/motion_history.h"
#include "core/drive/node_range.h"
#include "core/drive/pose_graph.h"
#include "core/drive/recordings.h"
#include "core/drive/rejected_places.h"
#include "core/drive/retention.h"
#include "core/drive/stamps.h"
#include "core/geometry/pose.h"
#include "core/geometry/state_matrix.h"
#include "core/noise/similarity_model.h"

namespace revisit::core {
namespace {

// Fewer votes than this on a stamp could be those of one mistake, however short
// the sequence.
constexpr NodeIndex kLeastAgreeing = 10;

ResamplerOptions MakeResamplerOptions(const DriveSettings& settings) {
  ResamplerOptions options;
  options.state_space = settings.state_space;
  options.spacing_meters = settings.node_spacing_meters;
  options.max_step_meters = settings.max_step_meters;
  const NoiseModel& noise = NoiseOf(settings.search.correlation_model);
  options.carry_transitions = noise.carries_transitions;
  options.carry_claims = noise.carries_claims();
  return options;
}

ConsistencyOptions MakeConsistencyOptions(const DriveSettings& settings) {
  ConsistencyOptions options;
  options.similarity = ClaimedModel(settings.state_space, settings.search);
  options.gate_probability = settings.search.gate_probability;
  options.applied =
      settings.apply_inflation && !BeginsWithBelief(settings.search, settings);
  options.max_inflation = settings.max_inflation;
  return options;
}

// Changes whenever anything does that the bytes of a drive hold, or that they
// come from: drive_state_test.cc has bytes as they were.
constexpr std::uint64_t kStateVersion = 3;

static_assert(Drive::kPartNodes == 64 * NodeBlock::kSize);
constexpr auto kPartBlocks =
    static_cast<std::size_t>(Drive::kPartNodes) / NodeBlock::kSize;

// A node that lies short of a multiple of the check interval by this fraction
// of it counts as there: multiples of spacing and interval are rounded
// differently.
constexpr double kCheckTolerance = 1e-9;

}  // namespace

struct Drive::Impl {
  // The findings of a moment, without their numbers, to tell when they change.
  struct Found {
    std::optional<FindingCode> model;
    bool has_leapt = false;
    // The first pose in a new frame; 0 if there is none.
    std::uint64_t frame_sequence = 0;
    // The first pose behind claims that were given up; 0 if none were.
    std::uint64_t reset_sequence = 0;

    bool operator!=(const Found& other) const {
      return model != other.model || has_leapt != other.has_leapt ||
             frame_sequence != other.frame_sequence ||
             reset_sequence != other.reset_sequence;
    }
    // Whether a finding of this moment is new since that one.
    bool IsNew(const Finding& finding, const Found& before) const {
      if (finding.leap) return !before.has_leapt;
      if (finding.frame) return frame_sequence != before.frame_sequence;
      if (finding.reset) return reset_sequence != before.reset_sequence;
      return model != before.model;
    }
  };

  explicit Impl(const DriveSettings& with_settings);

  std::optional<std::pair<NodeIndex, NodeIndex>> LoopEdge(
      std::uint64_t query_sequence, std::uint64_t matched_sequence) const;
  void ScheduleNextCheck();
  // The number of the first check of a vehicle, counted in check intervals.
  std::int64_t FirstCheck() const;
  // The number of the first check that is due after node LAST; the first of
  // all if it is null.
  std::int64_t FirstCheckAfter(std::optional<NodeIndex> last) const;
  // How many check intervals the node has reached.
  std::int64_t ChecksReached(NodeIndex node) const;
  // Where Gamma has no closed form, searches go through all nodes in any case,
  // and nodes take the most memory: they do without indexes.
  bool has_indexes() const {
    return NoiseOf(settings.search.correlation_model).has_closed_form();
  }
  std::string StateKey() const;
  // Begins a part or the rest, and reads its beginning.
  ByteWriter BeginState(std::uint64_t parts_before) const;
  bool ReadBeginning(ByteReader* reader) const;
  MotionHistory MakeMotionHistory() const;
  void RebuildMotionHistory();
  // Without loop ends.
  RetentionNeeds MakeRetentionNeeds() const;
  LeapWatch MakeLeapWatch() const;
  // The new frame that the vehicle's settings let be one; null if there is
  // none.
  const NewFrame* FindNewFrame() const;
  // The last claims that were given up, likewise.
  const ClaimsReset* FindReset() const;
  bool claims_do_not_grow() const {
    return model_check.Judge(settings.search.correlation_model) ==
           FindingCode::kCovariancesDoNotGrow;
  }
  Found FoundSoFar() const;
  // Adds the graph's new nodes to its indexes.
  void ExtendIndexes();
  // Shows the graph's new nodes to those who watch them.
  void ExtendWatches();
  void ExtendFrameWatch();
  // A measurement between two poses, with the covariances that the drive goes
  // by: where the claim of a pose does not count at its node, what is carried
  // on from there.
  std::shared_ptr<const MeasuredLoop> InForce(
      std::shared_ptr<const MeasuredLoop> measured, NodeIndex query,
      NodeIndex matched) const;
  // Estimates the consistency anew from all confirmed loops.
  void RebuildMonitor();
  // What a closure of two recordings shows is how their frames lie, and nothing
  // of the claims.
  bool IsWithinRecording(const ConfirmedLoop& loop) const {
    return recordings.Of(loop.query) == recordings.Of(loop.matched);
  }
  FrameNodes Frames() const {
    return {graph, settings.state_space, CorrelationOf(settings.search)};
  }

  DriveSettings settings;
  PoseGraph graph;
  DistanceResampler resampler;
  MotionHistory motion_history;
  BlockBounds block_bounds;
  DroppedStretches dropped;
  Recordings recordings;
  std::uint64_t last_sequence = 0;
  std::uint64_t revision = 0;
  std::uint64_t mark_settings_version = 1;
  // Pairs that were verified to be one place, in the order in which they came.
  std::vector<ConfirmedPair> confirmed;
  // Pairs that were verified not to be one place, likewise.
  std::vector<std::pair<NodeIndex, NodeIndex>> rejected;
  ConsistencyMonitor monitor;
  ModelCheck model_check;
  LeapWatch leap_watch;
  FrameWatch frame_watch;
  // The next check is due at this many check intervals.
  std::int64_t next_check = 0;
};

Drive::Impl::Impl(const DriveSettings& with_settings)
    : settings(with_settings),
      resampler(MakeResamplerOptions(settings)),
      motion_history(MakeMotionHistory()),
      block_bounds(settings.state_space),
      monitor(MakeConsistencyOptions(settings)),
      leap_watch(MakeLeapWatch()) {
  assert(FindProblems(settings).empty());
  ScheduleNextCheck();
}

MotionHistory Drive::Impl::MakeMotionHistory() const {
  const SearchOptions& search = settings.search;
  return MotionHistory(
      settings.state_space, CorrelationOf(search),
      StretchNodes(search.shape, settings.node_spacing_meters,
                   SequenceNodes(search.sequence_length_meters,
                                 settings.node_spacing_meters)));
}

void Drive::Impl::ExtendIndexes() {
  if (!has_indexes()) return;
  motion_history.Extend(graph);
  block_bounds.Extend(graph);
}

// The next check is the first that lies after all present nodes and leaves room
// for the sequence and as much history.
void Drive::Impl::ScheduleNextCheck() {
  std::optional<NodeIndex> last;
  if (graph.size() > 0) last = graph.size() - 1;
  next_check = FirstCheckAfter(last);
}

std::int64_t Drive::Impl::FirstCheck() const {
  return static_cast<std::int64_t>(
      std::ceil(2.0 * settings.search.sequence_length_meters /
                    settings.check_interval_meters -
                kCheckTolerance));
}

std::int64_t Drive::Impl::FirstCheckAfter(std::optional<NodeIndex> last) const {
  return std::max(FirstCheck(),
                  last ? ChecksReached(*last) + 1 : std::int64_t{0});
}

std::int64_t Drive::Impl::ChecksReached(NodeIndex node) const {
  return static_cast<std::int64_t>(std::floor(
      graph.node(node).travelled_meters / settings.check_interval_meters +
      kCheckTolerance));
}

std::optional<DueCheck> Drive::NextCheck(std::uint64_t after) const {
  const PoseGraph& graph = impl_->graph;
  const std::optional<NodeIndex> before = graph.NodeAtOrBefore(after);
  NodeIndex low = before ? *before + 1 : 0;
  const std::int64_t number = impl_->FirstCheckAfter(before);
  // The first node that has reached this check.
  NodeIndex high = graph.size();
  while (low < high) {
    const NodeIndex middle = low + (high - low) / 2;
    if (impl_->ChecksReached(middle) >= number) {
      high = middle;
    } else {
      low = middle + 1;
    }
  }
  if (low == graph.size()) return std::nullopt;
  const Node node = graph.node(low);
  DueCheck due;
  // The pose with which the node came.
  due.sequence = node.sequence + (node.fraction > 0.0 ? 1 : 0);
  due.node = graph.NodeAtOrBefore(due.sequence).value_or(low);
  return due;
}

std::int64_t Drive::ChecksBehind(std::uint64_t after) const {
  const PoseGraph& graph = impl_->graph;
  if (graph.size() == 0) return 0;
  const std::int64_t first =
      impl_->FirstCheckAfter(graph.NodeAtOrBefore(after));
  return std::max(std::int64_t{0},
                  impl_->ChecksReached(graph.size() - 1) - first + 1);
}

RetentionNeeds Drive::Impl::MakeRetentionNeeds() const {
  const SearchOptions& search = settings.search;
  const double spacing = settings.node_spacing_meters;
  const NodeIndex steps = SequenceNodes(search.sequence_length_meters, spacing);
  RetentionNeeds needs;
  needs.state_space = settings.state_space;
  needs.correlation = CorrelationOf(search);
  needs.tolerance_meters = search.place_tolerance.position_meters;
  needs.spacing_meters = spacing;
  needs.separation_meters = search.candidate_separation_meters;
  needs.aligned_nodes = kOverlapSequences * steps;
  // The marks that show the drift at the last node, and what they align.
  needs.newest_nodes =
      static_cast<NodeIndex>(std::ceil(static_cast<double>(kDriftMarks + 1) *
                                       MarkSpacing(settings) / spacing)) +
      2 * needs.aligned_nodes;
  needs.agreeing_nodes = std::max(kLeastAgreeing, steps);
  needs.least_nodes = needs.aligned_nodes;
  return needs;
}

LeapWatch Drive::Impl::MakeLeapWatch() const {
  return {settings.retention.max_age_ns, MakeRetentionNeeds().newest_nodes};
}

// Where claims do not grow at all, that they fall is nothing new: they are then
// those of fixes, and that is told (FindingCode::kCovariancesDoNotGrow).
const NewFrame* Drive::Impl::FindNewFrame() const {
  const NewFrame* const frame = frame_watch.last();
  if (frame == nullptr ||
      NoiseOf(settings.search.correlation_model).claimed_growth !=
          ClaimedGrowth::kGrows) {
    return nullptr;
  }
  return frame->claims_fall && claims_do_not_grow() ? nullptr : frame;
}

const ClaimsReset* Drive::Impl::FindReset() const {
  return claims_do_not_grow() ? nullptr : resampler.last_reset();
}

Drive::Impl::Found Drive::Impl::FoundSoFar() const {
  Found found;
  found.model = model_check.Judge(settings.search.correlation_model);
  found.has_leapt = leap_watch.leap().has_value();
  if (const NewFrame* frame = FindNewFrame()) {
    found.frame_sequence = frame->sequence;
  }
  if (const ClaimsReset* reset = FindReset()) {
    found.reset_sequence = reset->sequence;
  }
  return found;
}

void Drive::Impl::ExtendWatches() {
  leap_watch.Extend(graph, dropped);
  ExtendFrameWatch();
}

void Drive::Impl::ExtendFrameWatch() {
  frame_watch.Extend(graph, dropped, recordings, settings.node_spacing_meters);
}

// A setting that differs may come to the same in whole nodes.
void Drive::Impl::RebuildMotionHistory() {
  MotionHistory history = MakeMotionHistory();
  if (history.correlation() == motion_history.correlation() &&
      history.stretch_nodes() == motion_history.stretch_nodes()) {
    return;
  }
  motion_history = std::move(history);
  ExtendIndexes();
}

std::optional<std::pair<NodeIndex, NodeIndex>> Drive::Impl::LoopEdge(
    std::uint64_t query_sequence, std::uint64_t matched_sequence) const {
  const auto query = NodeOf(graph, dropped, query_sequence);
  const auto matched = NodeOf(graph, dropped, matched_sequence);
  if (!query || !matched || *query == *matched) return std::nullopt;
  return std::make_pair(*query, *matched);
}

std::shared_ptr<const MeasuredLoop> Drive::Impl::InForce(
    std::shared_ptr<const MeasuredLoop> measured, NodeIndex query,
    NodeIndex matched) const {
  if (measured == nullptr ||
      !NoiseOf(settings.search.correlation_model).carries_claims()) {
    return measured;
  }
  const auto carried = [this](const PoseEstimate& estimate, NodeIndex index) {
    const Node node = graph.node(index);
    return CarriedClaim(settings.state_space, {node.pose, node.covariance},
                        nullptr, {estimate.pose, estimate.covariance});
  };
  const std::optional<CarriedCovariance> of_query =
      carried(measured->query, query);
  const std::optional<CarriedCovariance> of_matched =
      carried(measured->matched, matched);
  if (!of_query && !of_matched) return measured;
  auto in_force = std::make_shared<MeasuredLoop>(*measured);
  if (of_query) in_force->query.covariance = of_query->covariance;
  if (of_matched) in_force->matched.covariance = of_matched->covariance;
  return in_force;
}

void Drive::Impl::RebuildMonitor() {
  monitor = ConsistencyMonitor(MakeConsistencyOptions(settings));
  for (const ConfirmedPair& each : confirmed) {
    if (IsWithinRecording(each.loop)) monitor.Confirm(graph, each.loop);
  }
}

std::string Drive::Impl::StateKey() const {
  ByteWriter writer;
  writer.Put(kStateVersion);
  writer.Put(static_cast<std::uint32_t>(settings.state_space));
  writer.Put(settings.node_spacing_meters);
  writer.Put(settings.max_step_meters);
  const Correlation correlation = CorrelationOf(settings.search);
  writer.Put(static_cast<std::uint32_t>(correlation.model));
  writer.Put(correlation.meters);
  writer.Put(motion_history.stretch_nodes());
  writer.Put(kPartNodes);
  return writer.Take();
}

ByteWriter Drive::Impl::BeginState(std::uint64_t parts_before) const {
  ByteWriter writer;
  const std::string key = StateKey();
  writer.PutArray(key.data(), key.size());
  writer.Put(parts_before);
  return writer;
}

bool Drive::Impl::ReadBeginning(ByteReader* reader) const {
  const std::string expected = StateKey();
  std::string key(expected.size(), '\0');
  std::uint64_t parts_before = 0;
  return reader->GetArray(key.data(), key.size()) && key == expected &&
         reader->Get(&parts_before) &&
         parts_before == static_cast<std::uint64_t>(graph.size() / kPartNodes);
}

Drive::Drive(const DriveSettings& settings)
    : impl_(std::make_unique<Impl>(settings)) {}

Drive::Drive(Drive&&) noexcept = default;

Drive::~Drive() = default;

const DriveSettings& Drive::settings() const { return impl_->settings; }

const PoseGraph& Drive::graph() const { return impl_->graph; }

std::size_t Drive::bytes() const {
  return impl_->graph.bytes() + impl_->motion_history.bytes() +
         impl_->block_bounds.bytes() + impl_->dropped.bytes() +
         impl_->recordings.bytes();
}

std::uint64_t Drive::last_sequence() const { return impl_->last_sequence; }

double Drive::travelled_meters() const {
  return impl_->resampler.travelled_meters();
}

std::uint64_t Drive::revision() const { return impl_->revision; }

const DroppedStretches& Drive::dropped() const { return impl_->dropped; }

const Recordings& Drive::recordings() const { return impl_->recordings; }

const MotionHistory& Drive::motion_history() const {
  return impl_->motion_history;
}

const BlockBounds& Drive::block_bounds() const { return impl_->block_bounds; }

std::uint64_t Drive::mark_settings_version() const {
  return impl_->mark_settings_version;
}

std::string Drive::StateKey() const { return impl_->StateKey(); }

ResamplerOptions Drive::resampler_options() const {
  return MakeResamplerOptions(impl_->settings);
}

AppendResult Drive::Append(const std::vector<PoseSample>& samples,
                           std::uint64_t revision) {
  assert(revision > impl_->revision);
  AppendResult result;
  const Impl::Found before = impl_->FoundSoFar();
  for (const PoseSample& sample : samples) {
    assert(sample.sequence == impl_->last_sequence + 1);
    const NodeIndex first_new = impl_->graph.size();
    if (sample.recording_start) {
      impl_->recordings.Begin(sample.sequence, first_new,
                              sample.recording_start,
                              impl_->resampler.last_pose().value_or(Pose()));
      impl_->model_check.Skip();
    }
    impl_->model_check.Look(sample, impl_->settings.max_step_meters);
    if (std::optional<Jump> jump =
            impl_->resampler.Add(sample, &impl_->graph)) {
      result.jumps.push_back(*jump);
    }
    for (NodeIndex i = first_new; i < impl_->graph.size(); ++i) {
      const double due =
          (static_cast<double>(impl_->next_check) - kCheckTolerance) *
          impl_->settings.check_interval_meters;
      if (impl_->graph.node(i).travelled_meters >= due) {
        result.checks_due.push_back(i);
        ++impl_->next_check;
      }
    }
    impl_->last_sequence = sample.sequence;
  }
  impl_->ExtendIndexes();
  impl_->ExtendWatches();
  const Impl::Found now = impl_->FoundSoFar();
  if (now != before) {
    for (Finding& finding : findings()) {
      if (now.IsNew(finding, before)) result.findings.push_back(finding);
    }
  }
  impl_->revision = revision;
  return result;
}

std::vector<Finding> Drive::findings() const {
  std::vector<Finding> findings;
  if (auto found =
          impl_->model_check.Find(impl_->settings.search.correlation_model)) {
    findings.push_back(*found);
  }
  if (const auto leap = impl_->leap_watch.leap()) {
    Finding& finding = findings.emplace_back();
    finding.code = FindingCode::kStampsLeap;
    finding.leap = leap;
  }
  if (const NewFrame* frame = impl_->FindNewFrame()) {
    Finding& finding = findings.emplace_back();
    finding.code = FindingCode::kNewFrame;
    finding.frame = *frame;
  }
  if (const ClaimsReset* reset = impl_->FindReset()) {
    Finding& finding = findings.emplace_back();
    finding.code = FindingCode::kCovariancesReset;
    finding.reset = *reset;
  }
  return findings;
}

void Drive::Skip(const DroppedStretch& stretch, std::uint64_t revision) {
  assert(revision > impl_->revision);
  assert(stretch.first_sequence == impl_->last_sequence + 1 &&
         stretch.last_sequence >= stretch.first_sequence);
  const double before = impl_->resampler.travelled_meters();
  impl_->resampler.Skip(stretch.last_sequence, stretch.travelled_meters,
                        stretch.transition);
  impl_->dropped.Add(stretch, impl_->graph.size());
  impl_->model_check.Skip();
  impl_->last_sequence = stretch.last_sequence;
  // Checks that fell due on the way are past.
  const double interval = impl_->settings.check_interval_meters;
  if (impl_->resampler.travelled_meters() > before) {
    impl_->next_check = std::max(
        impl_->next_check,
        static_cast<std::int64_t>(
            std::floor(impl_->resampler.travelled_meters() / interval)) +
            1);
  }
  impl_->revision = revision;
}

std::optional<std::int64_t> Drive::OldestStamp(
    std::optional<std::int64_t> latest_ns) const {
  if (!impl_->settings.retention.max_age_ns) return std::nullopt;
  const RetentionNeeds needs = impl_->MakeRetentionNeeds();
  return core::OldestStamp(
      impl_->graph, {*impl_->settings.retention.max_age_ns,
                     needs.agreeing_nodes, needs.newest_nodes, latest_ns});
}

std::unique_ptr<DroppableSearch> Drive::SearchDroppable(
    std::optional<std::int64_t> latest_ns) const {
  RetentionNeeds needs = impl_->MakeRetentionNeeds();
  needs.loop_ends = LoopEnds();
  const Recordings& recordings = impl_->recordings;
  for (std::size_t k = 0; k < recordings.size(); ++k) {
    if (recordings.size() > 1 || recordings[k].start != nullptr) {
      needs.recording_starts.push_back(recordings[k].first_node);
    }
  }
  return std::make_unique<DroppableSearch>(
      impl_->graph, impl_->settings.retention, std::move(needs), latest_ns);
}

bool Drive::Fits(const DroppableSearch& search) const {
  return search.options() == impl_->settings.retention &&
         HaveSameRules(search.needs(), impl_->MakeRetentionNeeds());
}

std::vector<NodeIndex> Drive::LoopEnds() const {
  std::vector<NodeIndex> ends;
  ends.reserve(2 * impl_->confirmed.size());
  for (const ConfirmedPair& confirmed : impl_->confirmed) {
    ends.push_back(confirmed.loop.query);
    ends.push_back(confirmed.loop.matched);
  }
  return ends;
}

absl::Status Drive::ChangeSettings(const DriveSettings& settings,
                                   std::uint64_t revision) {
  assert(revision > impl_->revision);
  if (const auto problems = FindProblems(settings); !problems.empty()) {
    return absl::InvalidArgumentError(
        absl::StrCat(problems[0].field, ": ", problems[0].description));
  }
  const unsigned remade = RemadeBetween(impl_->settings, settings);
  if ((remade & kRemadeNodes) != 0) {
    return absl::FailedPreconditionError(
        "these settings move nodes: the drive has to be made anew");
  }
  impl_->settings = settings;
  impl_->revision = revision;
  if ((remade & kRemadeMarks) != 0) ++impl_->mark_settings_version;
  if ((remade & kRemadeConsistency) != 0) impl_->RebuildMonitor();
  if ((remade & kRemadeMotionHistory) != 0) impl_->RebuildMotionHistory();
  impl_->leap_watch = impl_->MakeLeapWatch();
  impl_->ExtendWatches();
  impl_->ScheduleNextCheck();
  return absl::OkStatus();
}

void Drive::AddLoopClosure(std::uint64_t query_sequence,
                           std::uint64_t matched_sequence,
                           std::uint64_t revision,
                           std::shared_ptr<const MeasuredLoop> measured) {
  assert(revision > impl_->revision);
  if (const auto edge = impl_->LoopEdge(query_sequence, matched_sequence)) {
    impl_->graph.AddLoopEdge(edge->first, edge->second);
    impl_->confirmed.push_back(
        {query_sequence,
         matched_sequence,
         {edge->first, edge->second,
          impl_->InForce(std::move(measured), edge->first, edge->second)}});
    const ConfirmedLoop& loop = impl_->confirmed.back().loop;
    if (impl_->IsWithinRecording(loop)) {
      impl_->monitor.Confirm(impl_->graph, loop);
    }
  }
  impl_->revision = revision;
}

void Drive::RemoveLoopClosure(std::uint64_t query_sequence,
                              std::uint64_t matched_sequence,
                              std::uint64_t revision, std::size_t occurrence) {
  assert(revision > impl_->revision);
  for (auto it = impl_->confirmed.begin(); it != impl_->confirmed.end(); ++it) {
    if (it->query_sequence != query_sequence ||
        it->matched_sequence != matched_sequence || occurrence-- > 0) {
      continue;
    }
    impl_->graph.RemoveLoopEdge(it->loop.query, it->loop.matched);
    impl_->confirmed.erase(it);
    impl_->RebuildMonitor();
    break;
  }
  impl_->revision = revision;
}

std::optional<Agreement> Drive::AgreementOf(
    std::uint64_t query_sequence, std::uint64_t matched_sequence,
    const std::shared_ptr<const MeasuredLoop>& measured) const {
  const std::optional<NodeIndex> query =
      impl_->graph.NodeAtOrBefore(query_sequence);
  const std::optional<NodeIndex> matched =
      impl_->graph.NodeAtOrBefore(matched_sequence);
  if (!query || !matched) return std::nullopt;
  const SimilarityModel model = SimilarityOf(impl_->settings.search);
  const ConfirmedLoop loop{*query, *matched,
                           impl_->InForce(measured, *query, *matched)};
  if (impl_->IsWithinRecording(loop)) {
    return core::AgreementOf(impl_->graph, model, loop);
  }
  const FrameRelations relations = RelationsAt(impl_->graph.size() - 1);
  const std::size_t from = impl_->recordings.Of(*query);
  return AgreementAcross(impl_->Frames(),
                         relations.From(from)[impl_->recordings.Of(*matched)],
                         model, loop);
}

std::vector<ConfirmedLoop> Drive::LoopsAt(NodeIndex query) const {
  std::vector<ConfirmedLoop> loops;
  for (const ConfirmedPair& confirmed : impl_->confirmed) {
    const ConfirmedLoop& loop = confirmed.loop;
    if (std::max(loop.query, loop.matched) <= query) loops.push_back(loop);
  }
  return loops;
}

FrameNodes Drive::frame_nodes() const { return impl_->Frames(); }

FrameRelations Drive::RelationsAt(NodeIndex query) const {
  return {impl_->Frames(), impl_->recordings, query, LoopsAt(query)};
}

std::shared_ptr<const DriveView> Drive::View(double shown_scale) const {
  const DriveSettings& settings = impl_->settings;
  const PoseGraph& graph = impl_->graph;
  std::vector<std::vector<NodeExtent>> extents;
  for (std::size_t k = 0; k < impl_->recordings.size(); ++k) {
    extents.push_back(ExtentsOf(graph, impl_->block_bounds,
                                impl_->recordings.NodesOf(k, graph.size())));
  }
  MotionHistory motion = impl_->motion_history;
  motion.Close(graph);
  return std::make_shared<const DriveView>(
      DriveView{settings.state_space, settings.node_spacing_meters,
                CorrelationOf(settings.search),
                shown_scale * SimilarityOf(settings.search).inflation, graph,
                std::move(motion), impl_->block_bounds, impl_->recordings,
                LoopsAt(graph.size() - 1), impl_->dropped, std::move(extents)});
}

FrameRelations Drive::RelationsWithoutLoops(NodeIndex query) const {
  return {impl_->Frames(), impl_->recordings, query, {}};
}

void Drive::AddRejection(std::uint64_t query_sequence,
                         std::uint64_t matched_sequence,
                         std::uint64_t revision) {
  assert(revision > impl_->revision);
  if (const auto pair = impl_->LoopEdge(query_sequence, matched_sequence)) {
    impl_->rejected.push_back(*pair);
  }
  impl_->revision = revision;
}

void Drive::RemoveRejection(std::uint64_t query_sequence,
                            std::uint64_t matched_sequence,
                            std::uint64_t revision) {
  assert(revision > impl_->revision);
  if (const auto pair = impl_->LoopEdge(query_sequence, matched_sequence)) {
    const auto found =
        std::find(impl_->rejected.begin(), impl_->rejected.end(), *pair);
    if (found != impl_->rejected.end()) impl_->rejected.erase(found);
  }
  impl_->revision = revision;
}

Consistency Drive::consistency() const {
  Consistency consistency = impl_->monitor.consistency();
  consistency.rejected = static_cast<std::int64_t>(impl_->rejected.size());
  return consistency;
}

// A part is whole once the bounds of its blocks are known too.
std::size_t Drive::whole_parts() const {
  const auto after = static_cast<NodeIndex>(NodeBlock::kSize) + 1;
  return static_cast<std::size_t>(
      std::max<NodeIndex>(0, impl_->graph.size() - after) / kPartNodes);
}

std::string Drive::SavePart(std::size_t part) const {
  assert(part < whole_parts());
  const std::size_t first = part * kPartBlocks;
  const std::size_t end = first + kPartBlocks;
  ByteWriter writer = impl_->BeginState(part);
  writer.Reserve(bytes() / BlocksOf(impl_->graph.size()) * (kPartBlocks + 4));
  impl_->graph.SaveBlocks(first, end, &writer);
  if (impl_->has_indexes()) {
    impl_->motion_history.SaveBlocks(impl_->graph, first, end, &writer);
    impl_->block_bounds.SaveBlocks(first, end, &writer);
  }
  return writer.Take();
}

// The indexes of so few nodes are as soon made as read.
std::string Drive::SaveRest(std::size_t parts) const {
  assert(parts <= whole_parts());
  ByteWriter writer = impl_->BeginState(parts);
  impl_->graph.SaveRest(parts * kPartBlocks, &writer);
  writer.Put(impl_->last_sequence);
  impl_->dropped.Save(&writer);
  impl_->resampler.Save(&writer);
  impl_->model_check.Save(&writer);
  writer.Put(impl_->next_check);
  impl_->recordings.Save(&writer);
  return writer.Take();
}

// Nodes are looked at while they are in the cache, as those of one recording of
// which nothing was dropped: whether they are is told by the rest.
bool Drive::LoadPart(absl::string_view bytes) {
  ByteReader reader(bytes);
  if (!impl_->ReadBeginning(&reader) ||
      !impl_->graph.LoadBlocks(kPartBlocks, !impl_->has_indexes(), &reader) ||
      (impl_->has_indexes() &&
       (!impl_->motion_history.LoadBlocks(kPartBlocks, &reader) ||
        !impl_->block_bounds.LoadBlocks(kPartBlocks, &reader))) ||
      !reader.rest().empty()) {
    return false;
  }
  impl_->ExtendIndexes();
  impl_->ExtendFrameWatch();
  return true;
}

bool Drive::LoadRest(absl::string_view bytes) {
  ByteReader reader(bytes);
  const auto parts = static_cast<std::size_t>(impl_->graph.size() / kPartNodes);
  if (!impl_->ReadBeginning(&reader) ||
      !impl_->graph.LoadRest(!impl_->has_indexes(), &reader) ||
      !reader.Get(&impl_->last_sequence) ||
      !impl_->dropped.Load(impl_->graph.size(), impl_->last_sequence,
                           &reader) ||
      !impl_->resampler.Load(impl_->graph, impl_->last_sequence, &reader) ||
      !impl_->model_check.Load(&reader) || !reader.Get(&impl_->next_check) ||
      impl_->next_check < 0 ||
      !impl_->recordings.Load(impl_->settings.state_space, impl_->graph.size(),
                              impl_->last_sequence, &reader) ||
      !reader.rest().empty() || whole_parts() < parts) {
    return false;
  }
  if (impl_->dropped.count() > 0 || impl_->recordings.size() > 1) {
    impl_->frame_watch = FrameWatch();
  }
  impl_->motion_history.EndLoading();
  impl_->ExtendIndexes();
  impl_->ExtendWatches();
  return true;
}

const std::vector<ConfirmedPair>& Drive::confirmed() const {
  return impl_->confirmed;
}

std::optional<ConfirmedLoop> Drive::LastConfirmed(NodeIndex query,
                                                  std::size_t recording) const {
  const Recordings& recordings = impl_->recordings;
  const std::size_t of_query = recordings.Of(query);
  const std::pair wanted(std::min(of_query, recording),
                         std::max(of_query, recording));
  const ConfirmedLoop* last = nullptr;
  for (const ConfirmedPair& confirmed : impl_->confirmed) {
    const ConfirmedLoop& loop = confirmed.loop;
    const NodeIndex later = std::max(loop.query, loop.matched);
    if (later > query ||
        (last != nullptr && later < std::max(last->query, last->matched))) {
      continue;
    }
    const std::size_t a = recordings.Of(loop.query);
    const std::size_t b = recordings.Of(loop.matched);
    if (std::pair(std::min(a, b), std::max(a, b)) == wanted) last = &loop;
  }
  if (last == nullptr) return std::nullopt;
  return *last;
}

SimilarityModel Drive::SimilarityOf(const SearchOptions& options) const {
  SimilarityModel model = ClaimedModel(impl_->settings.state_space, options);
  if (impl_->settings.apply_inflation &&
      !BeginsWithBelief(options, impl_->settings)) {
    model.inflation = impl_->monitor.consistency().inflation;
  }
  return model;
}

std::vector<NodeRange> Drive::NotSought(NodeIndex query,
                                        double separation_meters) const {
  const Recordings& recordings = impl_->recordings;
  const auto nearer = [&](NodeIndex centre, double meters) {
    return NodesAround(impl_->graph, recordings, centre, meters);
  };
  std::vector<NodeRange> nodes = {nearer(query, separation_meters)};
  const double around = RejectedRadiusMeters(separation_meters);
  for (const auto& [rejected_query, rejected_match] : impl_->rejected) {
    if (IsNearRejected(impl_->graph, recordings, rejected_query, around,
                       query)) {
      nodes.push_back(nearer(rejected_match, around));
    }
  }
  return nodes;
}

}  // namespace revisit::core
