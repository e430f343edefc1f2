#include "server/sessions/judged_pairs.h"

#include <algorithm>
#include <tuple>

namespace revisit::server {

std::vector<std::pair<PairKind, const PosePairRecord*>> JudgedPairs::AsAdded()
    const {
  std::vector<std::pair<PairKind, const PosePairRecord*>> added;
  for (const PairKind kind : kPairKinds) {
    for (const auto& entry : Of(kind)) {
      added.emplace_back(kind, &entry.second);
    }
  }
  std::sort(added.begin(), added.end(), [](const auto& a, const auto& b) {
    return std::tie(a.second->create_time_ns, a.second->id, a.first) <
           std::tie(b.second->create_time_ns, b.second->id, b.first);
  });
  return added;
}

void JudgedPairs::Add(PairKind kind, const PosePairRecord& pair) {
  ++version_;
  MutableOf(kind).emplace(pair.id, pair);
  latest_ns_ =
      std::max(latest_ns_.value_or(pair.create_time_ns), pair.create_time_ns);
}

void JudgedPairs::Remove(PairKind kind, const std::vector<std::string>& ids) {
  ++version_;
  for (const std::string& id : ids) MutableOf(kind).erase(id);
  latest_ns_.reset();
  for (const PosePairs* of_kind : {&loop_closures_, &rejections_}) {
    for (const auto& [id, pair] : *of_kind) {
      latest_ns_ = std::max(latest_ns_.value_or(pair.create_time_ns),
                            pair.create_time_ns);
    }
  }
}

}  // namespace revisit::server
