// Finds the ends among nodes of the history by themselves: rules out those that
// cannot come to the odds that are asked for, walks back from the others, and
// collects those that do.
#ifndef REVISIT_CORE_SEARCH_ALIGNMENT_END_FINDER_H_
#define REVISIT_CORE_SEARCH_ALIGNMENT_END_FINDER_H_

#include <cstddef>
#include <cstdint>
#include <vector>

#include "core/search/alignment/found_ends.h"
#include "core/search/alignment/node_batch.h"
#include "core/search/alignment/path_walk.h"
#include "core/search/alignment/search_inputs.h"
#include "core/search/alignment/search_progress.h"
#include "core/search/alignment/similarity_kernel.h"

namespace revisit::core {

// Tells what is known of the nodes of a batch before they are looked at.
struct NodesSought {
  // The nodes that may be ends.
  BlockNodes sought;
  // The most that the log-likelihood ratio of a path from each can come to.
  BlockColumn gains;
  // For how many nodes each stands (ScoredEnd::nodes).
  BlockColumn stands_for;
};

template <int D>
class EndFinder {
 public:
  // The nodes to be looked at come in the batch, which must outlive this.
  EndFinder(const SearchInputs<D>& inputs, Direction direction,
            NodeBatch<D>* batch);

  // Looks at the nodes of the batch.
  void Find(const NodesSought& nodes, SearchProgress* progress);

  // All that was found, except for what has lower log-odds.
  MatchedEnds HandOver(double least) { return found_.HandOver(least); }

 private:
  BlockNodes FindUseful(const NodesSought& nodes, double least,
                        SearchProgress* progress);
  const BestPaths& WalkBack(const BlockNodes& useful, const BlockColumn& gains,
                            double least);
  bool IsUseless(const PathSoFar<D>& path, double least);
  void Collect(const BlockNodes& useful, const BlockColumn& stands_for,
               double least, const BestPaths& paths, SearchProgress* progress);

  const SearchInputs<D>& inputs_;
  const double weight_;
  const double constant_;
  NodeBatch<D>& batch_;
  PathWalk<D> walk_;
  FoundEnds found_;
  // The most that the log-odds of each end can come to.
  BlockColumn most_;
  std::vector<WalkStart> starts_;
};

}  // namespace revisit::core

#endif  // REVISIT_CORE_SEARCH_ALIGNMENT_END_FINDER_H_
