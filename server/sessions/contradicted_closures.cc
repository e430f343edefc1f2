#include "server/sessions/contradicted_closures.h"

#include <algorithm>
#include <cstdint>
#include <map>
#include <tuple>

namespace revisit::server {

std::vector<ContradictedClosure> NameSuspects(
    const PosePairs& closures, const std::vector<core::Suspect>& suspects) {
  std::vector<ContradictedClosure> named;
  if (suspects.empty()) return named;
  // The same two poses may be named more than once; the drive knows which one
  // is meant by the order in which they were added.
  std::map<std::pair<std::uint64_t, std::uint64_t>,
           std::vector<const PosePairRecord*>>
      by_poses;
  for (const auto& [id, pair] : closures) {
    if (!pair.damage.ok()) continue;
    by_poses[{pair.query_sequence, pair.matched_sequence}].push_back(&pair);
  }
  for (const core::Suspect& suspect : suspects) {
    const auto found =
        by_poses.find({suspect.query_sequence, suspect.matched_sequence});
    if (found == by_poses.end() || suspect.occurrence >= found->second.size()) {
      continue;
    }
    std::sort(found->second.begin(), found->second.end(),
              [](const PosePairRecord* a, const PosePairRecord* b) {
                return std::tie(a->create_time_ns, a->id) <
                       std::tie(b->create_time_ns, b->id);
              });
    named.emplace_back(found->second[suspect.occurrence]->id, suspect.p_value);
  }
  std::sort(named.begin(), named.end(),
            [](const ContradictedClosure& a, const ContradictedClosure& b) {
              return std::tie(a.second, a.first) < std::tie(b.second, b.first);
            });
  return named;
}

}  // namespace revisit::server
