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
#include "client/map/group_map.h"
#include "client/map/map_nodes.h"
#include "client/map/recording_places.h"
#include "client/revisit/backoff.h"
#include "client/revisit/status.h"
#include "client/trajectory/stored_poses.h"

namespace revisit::client {
namespace {

using Clock = std::chrono::steady_clock;

template <typename Pairs>
std::vector<MapPair> PairsOf(const Pairs& pairs, const MapContents& contents) {
  const auto node_at = [&](std::uint64_t sequence) {
    return MapNodeAt(contents.nodes, contents.own_begin, contents.nodes.size(),
                     sequence);
  };
  std::vector<MapPair> shown;
  for (const auto& pair : pairs) {
    shown.push_back({node_at(pair.query_sequence()),
                     node_at(pair.matched_sequence()), pair.name(),
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

// `node`: that of the match on the map.
MapCandidate CandidateOf(const v1::Candidate& candidate, std::size_t node) {
  const DecidingGate gate = DecidingGateOf(candidate);
  MapCandidate shown;
  shown.node = node;
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

// Where a node of a vehicle of the map is on it; an empty name is that of the
// one whose map it is. Nothing if it is not there.
std::optional<std::size_t> PlaceOf(const ServerMap& map,
                                   const std::string& vehicle,
                                   const v1::Node& node) {
  std::size_t begin = map.contents.own_begin;
  std::size_t end = map.contents.nodes.size();
  if (!vehicle.empty()) {
    const auto other = std::find_if(
        map.others.begin(), map.others.end(),
        [&](const OtherVehicle& one) { return one.name == vehicle; });
    if (other == map.others.end()) return std::nullopt;
    begin = other->begin;
    end = other->end;
  }
  const auto index = static_cast<std::size_t>(node.index());
  if (node.index() < 0 || index >= end - begin) return std::nullopt;
  return begin + index;
}

// A check as it was answered, at the node where it was asked for unless the
// answer names another; nothing if it names one that is not on the map.
std::optional<MapCheck> MakeCheck(const v1::CandidateSet& set, std::size_t node,
                                  const ServerMap& map) {
  MapCheck check;
  const auto query =
      set.has_query() ? PlaceOf(map, "", set.query()) : std::optional(node);
  if (!query) return std::nullopt;
  check.node = *query;
  check.style = StyleOf(set);
  if (set.candidates().empty()) {
    check.empty_reason = Explain(set.empty_reason());
  }
  for (const v1::Candidate& candidate : set.candidates()) {
    const auto at =
        PlaceOf(map, candidate.matched_vehicle(), candidate.matched());
    if (!at) return std::nullopt;
    check.candidates.push_back(CandidateOf(candidate, *at));
  }
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
  if (map->others.empty() && !contents.recordings.empty()) {
    absl::StrAppend(&contents.subtitle, ", ", contents.recordings.size(),
                    " recordings");
  }
}

// The pairs of a vehicle's own history that a verifier has looked at.
struct OwnPairs {
  std::vector<v1::LoopClosure> closures;
  std::vector<v1::RejectedCandidate> rejections;
};

// Adds the vehicle and its nodes.
absl::StatusOr<OwnPairs> ReadOwn(const Client& client,
                                 const std::string& vehicle,
                                 const Terminal& terminal, ServerMap* map) {
  // Before the nodes, so that their poses are among those.
  auto closures = ReadLoopClosures(client, vehicle);
  if (!closures.ok()) return closures.status();
  auto rejections = ReadRejectedCandidates(client, vehicle);
  if (!rejections.ok()) return rejections.status();
  MapContents& contents = map->contents;
  auto read = ReadMapNodes(client, vehicle, terminal, &contents.nodes);
  if (!read.ok()) return read.status();
  if (contents.nodes.size() == contents.own_begin) {
    return LocalError(absl::FailedPreconditionError(absl::StrCat(
        vehicle, ": there is nothing to draw, the pose graph is empty")));
  }
  map->vehicle = *std::move(read);
  return OwnPairs{*std::move(closures), *std::move(rejections)};
}

void AddOwn(const OwnPairs& own, const std::string& vehicle, ServerMap* map) {
  map->contents.closures = PairsOf(own.closures, map->contents);
  map->contents.rejections = PairsOf(own.rejections, map->contents);
  Name(vehicle, map);
}

// The nodes at which a stream's checks fall due.
std::vector<std::size_t> CheckNodes(const MapContents& contents,
                                    double first_meters,
                                    double interval_meters) {
  const std::vector<MapNode>& nodes = contents.nodes;
  std::vector<std::size_t> checks;
  double due = first_meters;
  for (std::size_t i = contents.own_begin; i < nodes.size(); ++i) {
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
  auto own = ReadOwn(client, vehicle, terminal, &map);
  if (!own.ok()) return own.status();
  const auto recordings = ReadRecordings(client, vehicle);
  if (!recordings.ok() && !absl::IsUnimplemented(recordings.status())) {
    return recordings.status();
  }
  if (recordings.ok()) PlaceRecordings(*recordings, &map.contents);
  AddOwn(*own, vehicle, &map);
  return map;
}

absl::StatusOr<ServerMap> ReadGroupMap(const Client& client,
                                       const std::string& vehicle,
                                       const std::string& group,
                                       const Terminal& terminal) {
  ServerMap map;
  const auto on_map = ReadGroup(client, group, vehicle);
  if (!on_map.ok()) return on_map.status();
  if (absl::Status added =
          AddOtherVehicles(client, *on_map, vehicle, terminal, &map);
      !added.ok()) {
    return added;
  }
  auto own = ReadOwn(client, vehicle, terminal, &map);
  if (!own.ok()) return own.status();
  PlaceVehicles(*on_map, vehicle, &map);
  AddOwn(*own, vehicle, &map);
  AddPairs(*on_map, vehicle, &map);
  absl::StrAppend(
      &map.contents.subtitle, ", among ", map.others.size(),
      map.others.size() == 1 ? " other vehicle of " : " other vehicles of ",
      group);
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
  const std::vector<std::size_t> at =
      CheckNodes(contents, 2.0 * settings.sequence_length_meters(), interval);
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
    auto check = MakeCheck(*set, at[i], *map);
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
