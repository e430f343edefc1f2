#include "client/map/group_map.h"

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <optional>
#include <utility>

#include "absl/strings/numbers.h"
#include "absl/strings/str_cat.h"
#include "client/answers/names.h"
#include "client/map/map_contents.h"
#include "client/map/map_nodes.h"
#include "client/map/recording_places.h"
#include "client/map/svg.h"
#include "client/trajectory/stored_groups.h"

namespace revisit::client {
namespace {

// The nodes of a vehicle on the map; nothing if it is not there.
std::optional<OtherVehicle> NodesOf(const ServerMap& map,
                                    const std::string& own,
                                    const std::string& vehicle) {
  if (vehicle == own) {
    return OtherVehicle{own, map.contents.own_begin, map.contents.nodes.size()};
  }
  for (const OtherVehicle& other : map.others) {
    if (other.name == vehicle) return other;
  }
  return std::nullopt;
}

// The sequence of a recording's first pose, with which its name ends.
std::uint64_t FirstSequenceOf(const v1::FrameTransform& frame) {
  std::uint64_t sequence = 0;
  const std::string& name = frame.recording();
  return absl::SimpleAtoi(name.substr(name.rfind('/') + 1), &sequence)
             ? sequence
             : 0;
}

std::string LabelOf(const v1::FrameTransform& frame, bool is_only) {
  return absl::StrCat(
      IdOf(frame.vehicle()),
      is_only ? "" : absl::StrCat(" from ", FirstSequenceOf(frame)), ": ",
      CertaintyText(frame.frame_state(), frame.frame_covariance(),
                    "the frame of the map"));
}

// The stretches of one vehicle's nodes, one for each recording that has any.
// `frames`: its recordings, in their order.
void AddStretches(const std::vector<const v1::FrameTransform*>& frames,
                  const std::vector<MapNode>& nodes, const OtherVehicle& of,
                  bool is_own, const std::string& color,
                  std::vector<FramedStretch>* stretches) {
  for (std::size_t k = 0; k < frames.size(); ++k) {
    const auto begins = [&](std::size_t frame) {
      const auto first = std::lower_bound(
          nodes.begin() + static_cast<std::ptrdiff_t>(of.begin),
          nodes.begin() + static_cast<std::ptrdiff_t>(of.end),
          FirstSequenceOf(*frames[frame]),
          [](const MapNode& node, std::uint64_t sequence) {
            return node.sequence < sequence;
          });
      return static_cast<std::size_t>(first - nodes.begin());
    };
    const std::size_t begin = k == 0 ? of.begin : begins(k);
    const std::size_t end = k + 1 < frames.size() ? begins(k + 1) : of.end;
    if (begin >= end) continue;
    FramedStretch stretch{begin, std::nullopt,
                          LabelOf(*frames[k], frames.size() == 1), color,
                          is_own ? "" : IdOf(of.name)};
    if (frames[k]->has_frame_pose()) {
      stretch.frame_pose = frames[k]->frame_pose();
    }
    stretches->push_back(std::move(stretch));
  }
}

}  // namespace

absl::StatusOr<GroupOnMap> ReadGroup(const Client& client,
                                     const std::string& group,
                                     const std::string& vehicle) {
  v1::ListFrameTransformsRequest request;
  request.set_parent(group);
  request.set_vehicle(vehicle);
  auto frames = ReadFrameTransforms(client, std::move(request));
  if (!frames.ok()) return frames.status();
  v1::ListInterVehicleLoopClosuresResponse links;
  if (absl::Status read = ReadPairs(client, group, &links); !read.ok()) {
    return read;
  }
  v1::ListInterVehicleRejectedCandidatesResponse rejections;
  if (absl::Status read = ReadPairs(client, group, &rejections); !read.ok()) {
    return read;
  }
  GroupOnMap on_map;
  on_map.frames.assign(frames->frame_transforms().begin(),
                       frames->frame_transforms().end());
  on_map.links.assign(links.loop_closures().begin(),
                      links.loop_closures().end());
  on_map.rejections.assign(rejections.rejected_candidates().begin(),
                           rejections.rejected_candidates().end());
  return on_map;
}

absl::Status AddOtherVehicles(const Client& client, const GroupOnMap& group,
                              const std::string& vehicle,
                              const Terminal& terminal, ServerMap* map) {
  std::vector<MapNode>& nodes = map->contents.nodes;
  std::string last = vehicle;
  for (const v1::FrameTransform& frame : group.frames) {
    const std::string& name = frame.vehicle();
    if (name == vehicle || name == last) continue;
    last = name;
    const std::size_t begin = nodes.size();
    const auto read = ReadMapNodes(client, name, terminal, &nodes);
    if (!read.ok()) return read.status();
    if (nodes.size() > begin)
      map->others.push_back({name, begin, nodes.size()});
  }
  map->contents.own_begin = nodes.size();
  return absl::OkStatus();
}

void PlaceVehicles(const GroupOnMap& group, const std::string& vehicle,
                   ServerMap* map) {
  std::vector<OtherVehicle> drawn = map->others;
  drawn.push_back(*NodesOf(*map, vehicle, vehicle));
  std::vector<FramedStretch> stretches;
  for (std::size_t k = 0; k < drawn.size(); ++k) {
    std::vector<const v1::FrameTransform*> frames;
    for (const v1::FrameTransform& frame : group.frames) {
      if (frame.vehicle() == drawn[k].name) frames.push_back(&frame);
    }
    const bool is_own = drawn[k].name == vehicle;
    AddStretches(frames, map->contents.nodes, drawn[k], is_own,
                 is_own ? kMapEstimate : StretchColor(k), &stretches);
  }
  PlaceStretches(stretches, &map->contents);
}

void AddPairs(const GroupOnMap& group, const std::string& vehicle,
              ServerMap* map) {
  const auto node_of = [&](const v1::MemberPose& pose) {
    const auto nodes = NodesOf(*map, vehicle, pose.vehicle());
    return nodes ? std::optional(MapNodeAt(map->contents.nodes, nodes->begin,
                                           nodes->end, pose.sequence()))
                 : std::nullopt;
  };
  const auto add = [&](const auto& pairs, std::vector<MapPair>* shown) {
    for (const auto& pair : pairs) {
      const auto query = node_of(pair.query());
      const auto matched = node_of(pair.matched());
      if (!query || !matched) continue;
      shown->push_back({*query, *matched, pair.name(), pair.note()});
    }
  };
  add(group.links, &map->contents.closures);
  add(group.rejections, &map->contents.rejections);
}

}  // namespace revisit::client
