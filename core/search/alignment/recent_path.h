// The recent path as a relative alignment compares it with the history: its
// shape filter, in the forms that the kernels take. Computed once per query and
// shared by all paths of all histories, in both directions; what depends on the
// axes of a history is in path_axes.h.
#ifndef REVISIT_CORE_SEARCH_ALIGNMENT_RECENT_PATH_H_
#define REVISIT_CORE_SEARCH_ALIGNMENT_RECENT_PATH_H_

#include <array>
#include <cstddef>
#include <cstdint>
#include <memory>
#include <vector>

#include "core/geometry/pose.h"
#include "core/geometry/state_matrix.h"
#include "core/search/alignment/query.h"
#include "core/search/alignment/relative_model.h"
#include "core/search/alignment/shape_filter.h"
#include "core/search/alignment/similarity_kernel.h"
#include "core/search/alignment/walk_kernel.h"
#include "core/search/alignment/walked_ends.h"

namespace revisit::core {

template <int D>
class RecentPath {
 public:
  RecentPath(const Query& query, const RelativeModel& model);

  // Nodes of the path.
  std::int64_t size() const { return filter_.size(); }
  const ShapeFilter<D>& filter() const { return filter_; }
  // w, which discounts the log-likelihood ratio.
  double weight() const { return weight_; }
  // Step t of the walk.
  const WalkStep& step(std::int64_t t) const {
    return steps_[static_cast<std::size_t>(t)];
  }
  // Log-likelihood ratio of a path without any innovation: none has more.
  double most_log_likelihood_ratio() const { return steps_[0].to_come; }

 private:
  ShapeFilter<D> filter_;
  double weight_;
  std::vector<WalkStep> steps_;
};

// Keeps the parts that all alignments of one query with one history share, so
// that the second alignment need not find them anew. Starts empty; the path may
// come from an alignment of the same query with another history.
struct AlignmentParts {
  // A RecentPath, and its PathAxes where the history lies as it did.
  std::shared_ptr<const void> path;
  std::shared_ptr<const void> axes;
  // All else that they share.
  std::shared_ptr<const void> parts;
  // The ends that were walked from, by IndexOf(direction), or null where these
  // need not be kept.
  std::shared_ptr<std::array<WalkedEnds, 2>> walked;
};

// The path that is kept, which is made if there is none.
template <int D>
std::shared_ptr<const RecentPath<D>> PathOf(const Query& query,
                                            const RelativeModel& model,
                                            AlignmentParts* kept) {
  if (kept->path == nullptr) {
    kept->path = std::make_shared<const RecentPath<D>>(query, model);
  }
  return std::static_pointer_cast<const RecentPath<D>>(kept->path);
}

}  // namespace revisit::core

#endif  // REVISIT_CORE_SEARCH_ALIGNMENT_RECENT_PATH_H_
