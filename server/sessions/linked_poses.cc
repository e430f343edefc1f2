#include "server/sessions/linked_poses.h"

namespace revisit::server {
namespace {

constexpr int kLinksAtATime = 1000;

}  // namespace

absl::StatusOr<std::vector<std::uint64_t>> ReadLinkedPoses(GroupStorage* groups,
                                                           VehicleKey vehicle) {
  std::vector<std::uint64_t> sequences;
  LinkPlace after;
  while (true) {
    const absl::StatusOr<std::vector<PlacedLink>> links =
        groups->ListLinksOf(vehicle, after, kLinksAtATime);
    if (!links.ok()) return links.status();
    for (const PlacedLink& placed : *links) {
      const GroupLinkRecord& link = placed.link;
      if (!link.damage.ok()) return link.damage;
      if (link.state == LinkState::kRejected) continue;
      for (const VehiclePose& end : {link.query, link.matched}) {
        if (end.vehicle == vehicle) sequences.push_back(end.sequence);
      }
    }
    if (links->size() < kLinksAtATime) return sequences;
    after = {links->back().group, links->back().link.id};
  }
}

}  // namespace revisit::server
