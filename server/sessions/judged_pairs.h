// The pairs of poses of one vehicle that verifiers judged.
#ifndef REVISIT_SERVER_SESSIONS_JUDGED_PAIRS_H_
#define REVISIT_SERVER_SESSIONS_JUDGED_PAIRS_H_

#include <cstdint>
#include <optional>
#include <string>
#include <utility>
#include <vector>

#include "server/sessions/vehicle_view.h"
#include "server/storage/storage.h"

namespace revisit::server {

// Belongs to the session's strand.
class JudgedPairs {
 public:
  const PosePairs& Of(PairKind kind) const {
    return kind == PairKind::kLoopClosure ? loop_closures_ : rejections_;
  }
  const PosePairs& loop_closures() const { return loop_closures_; }
  const PosePairs& rejections() const { return rejections_; }

  // Creation time of the latest pair of either kind, if there is any.
  const std::optional<std::int64_t>& latest_ns() const { return latest_ns_; }

  // All pairs in the order in which they were added, so that the graph and its
  // consistency come out the same whenever they are made anew.
  std::vector<std::pair<PairKind, const PosePairRecord*>> AsAdded() const;

  // Counts the changes of pairs.
  std::uint64_t version() const { return version_; }

  // REQUIRES: no pair of this kind has its id.
  void Add(PairKind kind, const PosePairRecord& pair);
  void Remove(PairKind kind, const std::vector<std::string>& ids);

 private:
  PosePairs& MutableOf(PairKind kind) {
    return kind == PairKind::kLoopClosure ? loop_closures_ : rejections_;
  }

  PosePairs loop_closures_;
  PosePairs rejections_;
  std::optional<std::int64_t> latest_ns_;
  std::uint64_t version_ = 0;
};

}  // namespace revisit::server

#endif  // REVISIT_SERVER_SESSIONS_JUDGED_PAIRS_H_
