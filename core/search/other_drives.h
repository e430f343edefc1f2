// The other drives of a scope as one search sees them.
//
// Thread-compatible: const calls may run at the same time.
#ifndef REVISIT_CORE_SEARCH_OTHER_DRIVES_H_
#define REVISIT_CORE_SEARCH_OTHER_DRIVES_H_

#include <cstddef>
#include <map>
#include <memory>
#include <optional>
#include <tuple>
#include <vector>

#include "core/drive/block_growth.h"
#include "core/drive/drive_view.h"
#include "core/drive/frame_relation.h"
#include "core/drive/frame_relations.h"
#include "core/drive/node_index.h"
#include "core/search/alignment/history.h"
#include "core/search/alignment/query.h"
#include "core/search/candidates/candidate.h"
#include "core/search/search_scope.h"
#include "core/settings.h"

namespace revisit::core {

// Where the errors of other drives' recordings grow to or from a node
// (block_growth.h). What the joined drives do not have is kept from search to
// search, by view, recording and node. Not thread-safe.
class GrowthOfOthers {
 public:
  // Forgets views that the joined drives do not have.
  void Enter(const std::shared_ptr<const JoinedDrives>& drives);
  // REQUIRES: the drive is one of those joined; the node lies in the recording.
  const Growth& Of(std::size_t drive, std::size_t recording,
                   NodeIndex reference);
  // How many are kept.
  std::size_t size() const { return growing_.size(); }

 private:
  // Keeps the views, and so their addresses.
  std::shared_ptr<const JoinedDrives> drives_;
  std::map<std::tuple<const DriveView*, std::size_t, NodeIndex>, Growth>
      growing_;
};

class OtherDrives {
 public:
  // For a search of the drive with these settings and options. The scope must
  // outlive this.
  OtherDrives(const DriveSettings& settings, const SearchOptions& options,
              const SearchScope& scope);

  const SearchScope& scope() const { return scope_; }
  // The drives that are not searched, and why.
  const std::vector<UnsearchedDrive>& unsearched() const { return unsearched_; }
  // Nodes that are searched.
  NodeIndex size() const;
  // The motion of the drives that are searched.
  const MotionOfOthers& motion() const { return motion_; }

  // Who asks: the frame of the query's recording among those seen, the nodes
  // and recordings of its drive, and the query.
  struct Asking {
    std::size_t frame = 0;
    const FrameNodes& nodes;
    const Recordings& recordings;
    NodeIndex query = 0;
  };
  // Adds the histories of the drives that are searched.
  void AddHistories(const FrameRelations& frames,
                    const std::vector<FrameRelation>& ties,
                    const Asking& asking, GrowthOfOthers* growth,
                    std::vector<History>* histories) const;

 private:
  std::optional<UnsearchedReason> WhyNot(std::size_t drive,
                                         const DriveSettings& settings,
                                         const SearchOptions& options) const;

  void PoolMotion();

  const SearchScope& scope_;
  const double separation_meters_;
  // Indexes of the drives that are searched.
  std::vector<std::size_t> searched_;
  std::vector<UnsearchedDrive> unsearched_;
  MotionOfOthers motion_;
};

}  // namespace revisit::core

#endif  // REVISIT_CORE_SEARCH_OTHER_DRIVES_H_
