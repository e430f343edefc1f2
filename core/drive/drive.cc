#include "core/drive/drive.h"

#include <algorithm>
#include <cassert>
#include <cmath>
#include <utility>

#include "absl/strings/str_cat.h"
#include "core/drive/node_range.h"
#include "core/search/belief/drive_belief.h"
#include "core/search/candidates/mark_search.h"
#include "core/search/candidates/posterior.h"
#include "core/search/candidates/search_task.h"

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
  options.carry_transitions =
      NoiseOf(settings.search.correlation_model).carries_transitions;
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
constexpr std::uint64_t kStateVersion = 2;

constexpr auto kPartBlocks =
    static_cast<std::size_t>(Drive::kPartNodes) / NodeBlock::kSize;

// A node that lies short of a multiple of the check interval by this fraction
// of it counts as there: multiples of spacing and interval are rounded
// differently.
constexpr double kCheckTolerance = 1e-9;

}  // namespace

Drive::Drive(const DriveSettings& settings)
    : settings_(settings),
      resampler_(MakeResamplerOptions(settings)),
      motion_history_(MakeMotionHistory()),
      block_bounds_(settings.state_space),
      monitor_(MakeConsistencyOptions(settings)),
      model_check_(settings.max_step_meters),
      leap_watch_(MakeLeapWatch()) {
  assert(FindProblems(settings).empty());
  ScheduleNextCheck();
}

MotionHistory Drive::MakeMotionHistory() const {
  const SearchOptions& search = settings_.search;
  return MotionHistory(
      settings_.state_space, CorrelationOf(search),
      StretchNodes(search.shape, settings_.node_spacing_meters,
                   SequenceNodes(search.sequence_length_meters,
                                 settings_.node_spacing_meters)));
}

void Drive::ExtendIndexes() {
  if (!has_indexes()) return;
  motion_history_.Extend(graph_);
  block_bounds_.Extend(graph_);
}

ResamplerOptions Drive::resampler_options() const {
  return MakeResamplerOptions(settings_);
}

// The next check is the first that lies after all present nodes and leaves room
// for the sequence and as much history.
void Drive::ScheduleNextCheck() {
  const double interval = settings_.check_interval_meters;
  const double first =
      std::ceil(2.0 * settings_.search.sequence_length_meters / interval -
                kCheckTolerance);
  const double next =
      graph_.size() == 0
          ? 0.0
          : std::floor(graph_.node(graph_.size() - 1).travelled_meters /
                           interval +
                       kCheckTolerance) +
                1.0;
  next_check_ = static_cast<std::int64_t>(std::max(first, next));
}

AppendResult Drive::Append(const std::vector<PoseSample>& samples,
                           std::uint64_t revision) {
  assert(revision > revision_);
  AppendResult result;
  const CorrelationModel model = settings_.search.correlation_model;
  const std::optional<FindingCode> found_before = model_check_.Judge(model);
  const bool had_leapt = leap_watch_.leap().has_value();
  for (const PoseSample& sample : samples) {
    assert(sample.sequence == last_sequence_ + 1);
    model_check_.Look(sample);
    const NodeIndex before = graph_.size();
    if (std::optional<Jump> jump = resampler_.Add(sample, &graph_)) {
      result.jumps.push_back(*jump);
    }
    for (NodeIndex i = before; i < graph_.size(); ++i) {
      const double due = (static_cast<double>(next_check_) - kCheckTolerance) *
                         settings_.check_interval_meters;
      if (graph_.node(i).travelled_meters >= due) {
        result.checks_due.push_back(i);
        ++next_check_;
      }
    }
    last_sequence_ = sample.sequence;
  }
  ExtendIndexes();
  leap_watch_.Extend(graph_, dropped_);
  const bool has_new_finding = model_check_.Judge(model) != found_before;
  const bool has_leapt = !had_leapt && leap_watch_.leap();
  if (has_new_finding || has_leapt) {
    for (Finding& finding : findings()) {
      if (finding.leap ? has_leapt : has_new_finding) {
        result.findings.push_back(finding);
      }
    }
  }
  revision_ = revision;
  return result;
}

std::vector<Finding> Drive::findings() const {
  std::vector<Finding> findings;
  if (auto found = model_check_.Find(settings_.search.correlation_model)) {
    findings.push_back(*found);
  }
  if (const auto leap = leap_watch_.leap()) {
    Finding& finding = findings.emplace_back();
    finding.code = FindingCode::kStampsLeap;
    finding.leap = leap;
  }
  return findings;
}

void Drive::Skip(const DroppedStretch& stretch, std::uint64_t revision) {
  assert(revision > revision_);
  assert(stretch.first_sequence == last_sequence_ + 1 &&
         stretch.last_sequence >= stretch.first_sequence);
  const double before = resampler_.travelled_meters();
  resampler_.Skip(stretch.last_sequence, stretch.travelled_meters,
                  stretch.transition);
  dropped_.Add(stretch, graph_.size());
  model_check_.Skip();
  last_sequence_ = stretch.last_sequence;
  // Checks that fell due on the way are past.
  const double interval = settings_.check_interval_meters;
  if (resampler_.travelled_meters() > before) {
    next_check_ = std::max(
        next_check_, static_cast<std::int64_t>(
                         std::floor(resampler_.travelled_meters() / interval)) +
                         1);
  }
  revision_ = revision;
}

RetentionNeeds Drive::MakeRetentionNeeds() const {
  const SearchOptions& search = settings_.search;
  const double spacing = settings_.node_spacing_meters;
  const NodeIndex steps = SequenceNodes(search.sequence_length_meters, spacing);
  RetentionNeeds needs;
  needs.state_space = settings_.state_space;
  needs.correlation = CorrelationOf(search);
  needs.tolerance_meters = search.place_tolerance.position_meters;
  needs.spacing_meters = spacing;
  needs.separation_meters = search.candidate_separation_meters;
  needs.aligned_nodes = kOverlapSequences * steps;
  // The marks that show the drift at the last node, and what they align.
  needs.newest_nodes =
      static_cast<NodeIndex>(std::ceil(static_cast<double>(kDriftMarks + 1) *
                                       MarkSpacing(settings_) / spacing)) +
      2 * needs.aligned_nodes;
  needs.agreeing_nodes = std::max(kLeastAgreeing, steps);
  needs.least_nodes = needs.aligned_nodes;
  return needs;
}

LeapWatch Drive::MakeLeapWatch() const {
  return {settings_.retention.max_age_ns, MakeRetentionNeeds().newest_nodes};
}

std::optional<std::int64_t> Drive::OldestStamp(
    std::optional<std::int64_t> latest_ns) const {
  if (!settings_.retention.max_age_ns) return std::nullopt;
  const RetentionNeeds needs = MakeRetentionNeeds();
  return core::OldestStamp(
      graph_, {*settings_.retention.max_age_ns, needs.agreeing_nodes,
               needs.newest_nodes, latest_ns});
}

std::unique_ptr<DroppableSearch> Drive::SearchDroppable(
    std::optional<std::int64_t> latest_ns) const {
  RetentionNeeds needs = MakeRetentionNeeds();
  needs.loop_ends = LoopEnds();
  return std::make_unique<DroppableSearch>(graph_, settings_.retention,
                                           std::move(needs), latest_ns);
}

bool Drive::Fits(const DroppableSearch& search) const {
  return search.options() == settings_.retention &&
         HaveSameRules(search.needs(), MakeRetentionNeeds());
}

std::vector<NodeIndex> Drive::LoopEnds() const {
  std::vector<NodeIndex> ends;
  ends.reserve(2 * confirmed_.size());
  for (const Confirmed& confirmed : confirmed_) {
    ends.push_back(confirmed.loop.query);
    ends.push_back(confirmed.loop.matched);
  }
  return ends;
}

absl::Status Drive::ChangeSettings(const DriveSettings& settings,
                                   std::uint64_t revision) {
  assert(revision > revision_);
  if (const auto problems = FindProblems(settings); !problems.empty()) {
    return absl::InvalidArgumentError(
        absl::StrCat(problems[0].field, ": ", problems[0].description));
  }
  const unsigned remade = RemadeBetween(settings_, settings);
  if ((remade & kRemadeNodes) != 0) {
    return absl::FailedPreconditionError(
        "these settings move nodes: the drive has to be made anew");
  }
  settings_ = settings;
  revision_ = revision;
  if ((remade & kRemadeMarks) != 0) ++mark_settings_version_;
  if ((remade & kRemadeConsistency) != 0) RebuildMonitor();
  if ((remade & kRemadeMotionHistory) != 0) RebuildMotionHistory();
  leap_watch_ = MakeLeapWatch();
  leap_watch_.Extend(graph_, dropped_);
  ScheduleNextCheck();
  return absl::OkStatus();
}

// A setting that differs may come to the same in whole nodes.
void Drive::RebuildMotionHistory() {
  MotionHistory history = MakeMotionHistory();
  if (history.correlation() == motion_history_.correlation() &&
      history.stretch_nodes() == motion_history_.stretch_nodes()) {
    return;
  }
  motion_history_ = std::move(history);
  ExtendIndexes();
}

std::optional<std::pair<NodeIndex, NodeIndex>> Drive::LoopEdge(
    std::uint64_t query_sequence, std::uint64_t matched_sequence) const {
  if (dropped_.Contains(query_sequence) ||
      dropped_.Contains(matched_sequence)) {
    return std::nullopt;
  }
  const std::optional<NodeIndex> query = graph_.NodeAtOrBefore(query_sequence);
  const std::optional<NodeIndex> matched =
      graph_.NodeAtOrBefore(matched_sequence);
  if (!query || !matched || *query == *matched) return std::nullopt;
  return std::make_pair(*query, *matched);
}

void Drive::AddLoopClosure(std::uint64_t query_sequence,
                           std::uint64_t matched_sequence,
                           std::uint64_t revision,
                           std::shared_ptr<const MeasuredLoop> measured) {
  assert(revision > revision_);
  if (const auto edge = LoopEdge(query_sequence, matched_sequence)) {
    graph_.AddLoopEdge(edge->first, edge->second);
    confirmed_.push_back({query_sequence,
                          matched_sequence,
                          {edge->first, edge->second, std::move(measured)}});
    monitor_.Confirm(graph_, confirmed_.back().loop);
  }
  revision_ = revision;
}

void Drive::RemoveLoopClosure(std::uint64_t query_sequence,
                              std::uint64_t matched_sequence,
                              std::uint64_t revision, std::size_t occurrence) {
  assert(revision > revision_);
  for (auto it = confirmed_.begin(); it != confirmed_.end(); ++it) {
    if (it->query_sequence != query_sequence ||
        it->matched_sequence != matched_sequence || occurrence-- > 0) {
      continue;
    }
    graph_.RemoveLoopEdge(it->loop.query, it->loop.matched);
    confirmed_.erase(it);
    RebuildMonitor();
    break;
  }
  revision_ = revision;
}

std::optional<Agreement> Drive::AgreementOf(
    std::uint64_t query_sequence, std::uint64_t matched_sequence,
    const std::shared_ptr<const MeasuredLoop>& measured) const {
  const std::optional<NodeIndex> query = graph_.NodeAtOrBefore(query_sequence);
  const std::optional<NodeIndex> matched =
      graph_.NodeAtOrBefore(matched_sequence);
  if (!query || !matched) return std::nullopt;
  return core::AgreementOf(graph_, SimilarityOf(settings_.search),
                           {*query, *matched, measured});
}

void Drive::AddRejection(std::uint64_t query_sequence,
                         std::uint64_t matched_sequence,
                         std::uint64_t revision) {
  assert(revision > revision_);
  if (const auto pair = LoopEdge(query_sequence, matched_sequence)) {
    rejected_.push_back(*pair);
  }
  revision_ = revision;
}

void Drive::RemoveRejection(std::uint64_t query_sequence,
                            std::uint64_t matched_sequence,
                            std::uint64_t revision) {
  assert(revision > revision_);
  if (const auto pair = LoopEdge(query_sequence, matched_sequence)) {
    const auto found = std::find(rejected_.begin(), rejected_.end(), *pair);
    if (found != rejected_.end()) rejected_.erase(found);
  }
  revision_ = revision;
}

Consistency Drive::consistency() const {
  Consistency consistency = monitor_.consistency();
  consistency.rejected = static_cast<std::int64_t>(rejected_.size());
  return consistency;
}

void Drive::RebuildMonitor() {
  monitor_ = ConsistencyMonitor(MakeConsistencyOptions(settings_));
  for (const Confirmed& confirmed : confirmed_) {
    monitor_.Confirm(graph_, confirmed.loop);
  }
}

std::string Drive::StateKey() const {
  ByteWriter writer;
  writer.Put(kStateVersion);
  writer.Put(static_cast<std::uint32_t>(settings_.state_space));
  writer.Put(settings_.node_spacing_meters);
  writer.Put(settings_.max_step_meters);
  const Correlation& correlation = motion_history_.correlation();
  writer.Put(static_cast<std::uint32_t>(correlation.model));
  writer.Put(correlation.meters);
  writer.Put(motion_history_.stretch_nodes());
  writer.Put(kPartNodes);
  return writer.Take();
}

ByteWriter Drive::BeginState(std::uint64_t parts_before) const {
  ByteWriter writer;
  const std::string key = StateKey();
  writer.PutArray(key.data(), key.size());
  writer.Put(parts_before);
  return writer;
}

bool Drive::ReadBeginning(ByteReader* reader) const {
  const std::string expected = StateKey();
  std::string key(expected.size(), '\0');
  std::uint64_t parts_before = 0;
  return reader->GetArray(key.data(), key.size()) && key == expected &&
         reader->Get(&parts_before) &&
         parts_before == static_cast<std::uint64_t>(graph_.size() / kPartNodes);
}

// A part is whole once the bounds of its blocks are known too.
std::size_t Drive::whole_parts() const {
  const auto after = static_cast<NodeIndex>(NodeBlock::kSize) + 1;
  return static_cast<std::size_t>(
      std::max<NodeIndex>(0, graph_.size() - after) / kPartNodes);
}

std::string Drive::SavePart(std::size_t part) const {
  assert(part < whole_parts());
  const std::size_t first = part * kPartBlocks;
  const std::size_t end = first + kPartBlocks;
  ByteWriter writer = BeginState(part);
  writer.Reserve(bytes() / BlocksOf(graph_.size()) * (kPartBlocks + 4));
  graph_.SaveBlocks(first, end, &writer);
  if (has_indexes()) {
    motion_history_.SaveBlocks(graph_, first, end, &writer);
    block_bounds_.SaveBlocks(first, end, &writer);
  }
  return writer.Take();
}

// The indexes of so few nodes are as soon made as read.
std::string Drive::SaveRest(std::size_t parts) const {
  assert(parts <= whole_parts());
  ByteWriter writer = BeginState(parts);
  graph_.SaveRest(parts * kPartBlocks, &writer);
  writer.Put(last_sequence_);
  dropped_.Save(&writer);
  resampler_.Save(&writer);
  model_check_.Save(&writer);
  writer.Put(next_check_);
  return writer.Take();
}

bool Drive::LoadPart(absl::string_view bytes) {
  ByteReader reader(bytes);
  return ReadBeginning(&reader) &&
         graph_.LoadBlocks(kPartBlocks, !has_indexes(), &reader) &&
         (!has_indexes() || (motion_history_.LoadBlocks(kPartBlocks, &reader) &&
                             block_bounds_.LoadBlocks(kPartBlocks, &reader))) &&
         reader.rest().empty();
}

bool Drive::LoadRest(absl::string_view bytes) {
  ByteReader reader(bytes);
  const auto parts = static_cast<std::size_t>(graph_.size() / kPartNodes);
  if (!ReadBeginning(&reader) || !graph_.LoadRest(!has_indexes(), &reader) ||
      !reader.Get(&last_sequence_) ||
      !dropped_.Load(graph_.size(), last_sequence_, &reader) ||
      !resampler_.Load(graph_, last_sequence_, &reader) ||
      !model_check_.Load(&reader) || !reader.Get(&next_check_) ||
      next_check_ < 0 || !reader.rest().empty() || whole_parts() < parts) {
    return false;
  }
  motion_history_.EndLoading();
  ExtendIndexes();
  leap_watch_.Extend(graph_, dropped_);
  return true;
}

std::optional<ConfirmedLoop> Drive::LastConfirmed(NodeIndex query) const {
  const ConfirmedLoop* last = nullptr;
  for (const Confirmed& confirmed : confirmed_) {
    const ConfirmedLoop& loop = confirmed.loop;
    const NodeIndex later = std::max(loop.query, loop.matched);
    if (later > query) continue;
    if (last == nullptr || later >= std::max(last->query, last->matched)) {
      last = &loop;
    }
  }
  if (last == nullptr) return std::nullopt;
  return *last;
}

SimilarityModel Drive::SimilarityOf(const SearchOptions& options) const {
  SimilarityModel model = ClaimedModel(settings_.state_space, options);
  if (settings_.apply_inflation && !BeginsWithBelief(options, settings_)) {
    model.inflation = monitor_.consistency().inflation;
  }
  return model;
}

std::vector<NodeRange> Drive::NotSought(NodeIndex query,
                                        double separation_meters) const {
  std::vector<NodeRange> nodes = {
      NodesNearer(graph_, query, separation_meters)};
  // Slightly more, so that nodes at exactly this distance are excluded too.
  const double around =
      std::max(separation_meters, kPlaceRadiusMeters) * (1.0 + 1e-9);
  for (const auto& [rejected_query, rejected_match] : rejected_) {
    if (graph_.MetersApart(rejected_query, query) <= around) {
      nodes.push_back(NodesNearer(graph_, rejected_match, around));
    }
  }
  return nodes;
}

}  // namespace revisit::core
