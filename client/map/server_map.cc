#include "client/map/server_map.h"

#include <algorithm>
#include <chrono>
#include <cstdint>
#include <optional>
#include <thread>
#include <utility>
#include <vector>

#include "absl/strings/str_cat.h"
#include "client/answers/candidate_text.h"
#include "client/answers/names.h"
#include "client/map/recording_places.h"
#include "client/revisit/backoff.h"
#include "client/revisit/status.h"
#include "client/trajectory/stored_poses.h"

namespace revisit::client {
namespace {

using Clock = std::chrono::steady_clock;

MapNode NodeOf(const v1::Node& node) {
  MapNode shown;
  shown.sequence = node.sequence();
  if (node.has_stamp()) shown.stamp = node.stamp();
  shown.travelled_meters = node.travelled_meters();
  shown.at = {node.pose().x_meters(), node.pose().y_meters()};
  shown.z_meters = node.pose().z_meters();
  const auto& v = node.covariance().values();
  const bool planar =
      node.covariance().form() == v1::COVARIANCE_FORM_PLANAR_6 && v.size() == 6;
  if (planar || v.size() == 10) {
    shown.xx = v[0];
    shown.xy = v[1];
    shown.yy = v[planar ? 3 : 4];
  }
  return shown;
}

// The node of a pair: the last one whose pose is at or before this. Within a
// node spacing of the one that the service links.
std::size_t NodeAt(const std::vector<MapNode>& nodes, std::uint64_t sequence) {
  const auto after = std::upper_bound(
      nodes.begin(), nodes.end(), sequence,
      [](std::uint64_t s, const MapNode& node) { return s < node.sequence; });
  return after == nodes.begin()
             ? 0
             : static_cast<std::size_t>(after - nodes.begin() - 1);
}

template <typename Pairs>
std::vector<MapPair> PairsOf(const Pairs& pairs,
                             const std::vector<MapNode>& nodes) {
  std::vector<MapPair> shown;
  for (const auto& pair : pairs) {
    shown.push_back({NodeAt(nodes, pair.query_sequence()),
                     NodeAt(nodes, pair.matched_sequence()), pair.name(),
                     pair.note()});
  }
  return shown;
}

// The styles, in the order of the legend, and the verdicts for which they
// stand; the last one stands for a check without candidates.
struct VerdictStyle {
  v1::Verdict verdict;
  const char* label;
  MapStyle style;
};

static_assert(v1::Verdict_MAX == v1::VERDICT_ILL_CONDITIONED,
              "every verdict has a style below");

const std::vector<VerdictStyle>& VerdictStyles() {
  static const auto* const styles = new std::vector<VerdictStyle>{
      {v1::VERDICT_ACCEPTED, "accepted", {"", "#0a8f6a", true, false, 1.0}},
      {v1::VERDICT_AMBIGUOUS, "ambiguous", {"", "#c77700", true, true, 0.5}},
      {v1::VERDICT_REJECTED_BY_GATE,
       "rejected by gate",
       {"", "#d1461f", false, false, 0.0}},
      {v1::VERDICT_REJECTED_BY_SHAPE,
       "rejected by shape",
       {"", "#9db4c8", false, false, 0.0}},
      {v1::VERDICT_UNINFORMATIVE,
       "uninformative",
       {"", "#c9bfe8", false, false, 0.0}},
      {v1::VERDICT_ILL_CONDITIONED,
       "ill-conditioned",
       {"", "#222222", false, false, 0.0}},
      {v1::VERDICT_UNSPECIFIED,
       "no candidate",
       {"", "#ffffff", false, false, 0.0}}};
  return *styles;
}

std::size_t StyleOf(const v1::CandidateSet& set) {
  const auto& styles = VerdictStyles();
  if (!set.candidates().empty()) {
    const v1::Verdict verdict = set.candidates(0).verdict();
    for (std::size_t i = 0; i + 1 < styles.size(); ++i) {
      if (styles[i].verdict == verdict) return i;
    }
  }
  return styles.size() - 1;
}

MapCandidate CandidateOf(const v1::Candidate& candidate) {
  const DecidingGate gate = DecidingGateOf(candidate);
  MapCandidate shown;
  shown.node = static_cast<std::size_t>(candidate.matched().index());
  shown.verdict = NameOf(candidate.verdict());
  shown.opposite = candidate.direction() == v1::DIRECTION_OPPOSITE;
  if (candidate.has_probability()) shown.probability = candidate.probability();
  shown.meters_before = candidate.place_interval().meters_before();
  shown.meters_after = candidate.place_interval().meters_after();
  if (candidate.frame_state() != v1::FRAME_STATE_UNSPECIFIED) {
    shown.frame_state = NameOf(candidate.frame_state());
  }
  shown.gate = gate.name();
  shown.squared_distance = gate.squared_distance;
  shown.threshold = gate.threshold;
  shown.p_value = gate.p_value;
  return shown;
}

// A check as it was answered, at the node where it was asked for unless the
// answer names another; nothing if it names one that is not among `nodes`.
std::optional<MapCheck> MakeCheck(const v1::CandidateSet& set, std::size_t node,
                                  std::size_t nodes) {
  MapCheck check;
  check.node =
      set.has_query() ? static_cast<std::size_t>(set.query().index()) : node;
  check.style = StyleOf(set);
  if (set.candidates().empty()) {
    check.empty_reason = Explain(set.empty_reason());
  }
  for (const v1::Candidate& candidate : set.candidates()) {
    check.candidates.push_back(CandidateOf(candidate));
  }
  const bool known =
      check.node < nodes &&
      std::all_of(check.candidates.begin(), check.candidates.end(),
                  [&](const MapCandidate& c) { return c.node < nodes; });
  if (!known) return std::nullopt;
  return check;
}

void Name(const std::string& vehicle, ServerMap* map) {
  MapContents& contents = map->contents;
  contents.title = absl::StrCat(
      map->vehicle.display_name().empty()
          ? vehicle
          : absl::StrCat(map->vehicle.display_name(), " (", vehicle, ")"));
  contents.subtitle =
      absl::StrCat(Fixed(contents.nodes.back().travelled_meters / 1000.0, 1),
                   " km, ", map->vehicle.durable_sequence(),
                   " poses, revision ", map->vehicle.revision());
  if (!contents.recordings.empty()) {
    absl::StrAppend(&contents.subtitle, ", ", contents.recordings.size(),
                    " recordings");
  }
}

// The nodes at which a stream's checks fall due.
std::vector<std::size_t> CheckNodes(const std::vector<MapNode>& nodes,
                                    double first_meters,
                                    double interval_meters) {
  std::vector<std::size_t> checks;
  double due = first_meters;
  for (std::size_t i = 0; i < nodes.size(); ++i) {
    if (nodes[i].travelled_meters < due) continue;
    checks.push_back(i);
    due = std::max(due + interval_meters, nodes[i].travelled_meters);
  }
  return checks;
}

// How long one search may be put off by the server.
constexpr std::chrono::minutes kLongestDelay{5};

// One search, again as often as the server asks to wait within that time.
absl::StatusOr<v1::CandidateSet> Search(
    const Client& client, const v1::FindCandidatesRequest& request) {
  const auto give_up = Clock::now() + kLongestDelay;
  Backoff backoff(BackoffOptions(), BackoffSeed());
  for (;;) {
    const auto response = client.FindCandidates(request);
    if (response.ok()) return response->candidates();
    if (absl::IsOutOfRange(response.status())) {
      // A stream answers a check that is too large in the same way.
      v1::CandidateSet set;
      set.set_empty_reason(v1::EMPTY_REASON_LIMIT_EXCEEDED);
      return set;
    }
    const auto asked = DetailsOf(response.status()).retry_delay;
    if (!absl::IsResourceExhausted(response.status()) || !asked.has_value()) {
      return response.status();
    }
    const auto wait = backoff.Next(asked);
    if (Clock::now() + wait >= give_up) return response.status();
    std::this_thread::sleep_for(wait);
  }
}

// Says in the legend how many checks have each style, and leaves out styles of
// none.
void CountStyles(MapContents* contents) {
  std::vector<std::size_t> counts(contents->styles.size());
  for (const MapCheck& check : contents->checks) ++counts[check.style];
  std::vector<MapStyle> used;
  std::vector<std::size_t> places(counts.size());
  for (std::size_t i = 0; i < counts.size(); ++i) {
    places[i] = used.size();
    if (counts[i] == 0) continue;
    used.push_back(contents->styles[i]);
    absl::StrAppend(&used.back().label, ": ", counts[i]);
  }
  contents->styles = std::move(used);
  for (MapCheck& check : contents->checks) check.style = places[check.style];
}

}  // namespace

absl::StatusOr<ServerMap> ReadServerMap(const Client& client,
                                        const std::string& vehicle,
                                        const Terminal& terminal) {
  ServerMap map;
  const auto before = ReadVehicle(client, vehicle);
  if (!before.ok()) return before.status();
  // Before the nodes, so that their poses are among those.
  const auto closures = ReadLoopClosures(client, vehicle);
  if (!closures.ok()) return closures.status();
  const auto rejections = ReadRejectedCandidates(client, vehicle);
  if (!rejections.ok()) return rejections.status();
  v1::ExportPoseGraphRequest request;
  request.set_vehicle(vehicle);
  MapContents& contents = map.contents;
  Progress progress(terminal, vehicle,
                    static_cast<std::uint64_t>(before->node_count()), "nodes");
  const absl::Status exported = client.ExportPoseGraph(
      request, [&](const v1::ExportPoseGraphResponse& part) {
        if (part.has_vehicle()) map.vehicle = part.vehicle();
        for (const v1::Node& node : part.nodes()) {
          contents.nodes.push_back(NodeOf(node));
        }
        progress.Update(contents.nodes.size());
        return absl::OkStatus();
      });
  if (!exported.ok()) return exported;
  if (contents.nodes.empty()) {
    return LocalError(absl::FailedPreconditionError(absl::StrCat(
        vehicle, ": there is nothing to draw, the pose graph is empty")));
  }
  const auto recordings = ReadRecordings(client, vehicle);
  if (!recordings.ok() && !absl::IsUnimplemented(recordings.status())) {
    return recordings.status();
  }
  if (recordings.ok()) PlaceRecordings(*recordings, &contents);
  contents.closures = PairsOf(*closures, contents.nodes);
  contents.rejections = PairsOf(*rejections, contents.nodes);
  Name(vehicle, &map);
  return map;
}

absl::Status AddChecks(const Client& client, const CheckSearches& searches,
                       const Terminal& terminal, ServerMap* map) {
  MapContents& contents = map->contents;
  const v1::VehicleSettings& settings = map->vehicle.settings();
  const double interval =
      searches.interval_meters.value_or(settings.check_interval_meters());
  for (const VerdictStyle& known : VerdictStyles()) {
    contents.styles.push_back(known.style);
    contents.styles.back().label = known.label;
  }
  const std::vector<std::size_t> at = CheckNodes(
      contents.nodes, 2.0 * settings.sequence_length_meters(), interval);
  Progress progress(terminal, map->vehicle.name(), at.size(), "searches");
  v1::FindCandidatesRequest request;
  request.set_vehicle(map->vehicle.name());
  *request.mutable_options() = searches.options;
  const auto pause = std::chrono::duration_cast<Clock::duration>(
      std::chrono::duration<double>(1.0 / searches.per_second));
  Clock::time_point next = Clock::now();
  for (std::size_t i = 0; i < at.size(); ++i) {
    std::this_thread::sleep_until(next);
    next = std::max(next + pause, Clock::now());
    request.set_sequence(contents.nodes[at[i]].sequence);
    const auto set = Search(client, request);
    if (!set.ok()) return set.status();
    auto check = MakeCheck(*set, at[i], contents.nodes.size());
    if (!check.has_value()) {
      return LocalError(absl::AbortedError(
          absl::StrCat(map->vehicle.name(),
                       ": the graph was rebuilt meanwhile; try again")));
    }
    contents.checks.push_back(*std::move(check));
    progress.Update(i + 1);
  }
  CountStyles(&contents);
  absl::StrAppend(&contents.subtitle, "; ", at.size(), " searches, one every ",
                  Fixed(interval, 0), " m");
  return absl::OkStatus();
}

}  // namespace revisit::client
