// Which histories of other drives are so far away that no search of them would
// consider a single node: told from where their nodes lie alone, before
// anything is made for them.
//
// A history is far only where SearchBounds rules out each of its blocks, and
// EndFinder, or EndSampler, each end of those that SearchBounds does not know:
// the first and the last. That bounds the log-odds of an end at j by
//
//   constant - 1/2 d^T (G + B)^-1 d - 1/2 ln|R - A| + w most ratio,
//
// B = (2 / w) E as at SearchBounds, and the covariance of how far neighbours
// are apart where ends are sampled. With V the variance of G along the line to
// the query, r its length, l the greatest variance of E in the plane and a the
// distance of neighbours, d^T (G + B)^-1 d is at least
// r^2 / (V + 2 l / w + a^2), where G + R is well-conditioned: so the disc is
// that of SearchBounds::RegionOf() but for its variance, which is greater.
#ifndef REVISIT_CORE_SEARCH_ALIGNMENT_FAR_HISTORIES_H_
#define REVISIT_CORE_SEARCH_ALIGNMENT_FAR_HISTORIES_H_

#include <memory>

#include "core/search/alignment/history.h"
#include "core/search/alignment/query.h"
#include "core/search/alignment/relative.h"
#include "core/search/alignment/relative_model.h"

namespace revisit::core {

class FarHistories {
 public:
  // The query and the model must outlive this. The path of the query is found
  // unless it is there.
  FarHistories(const Query& query, const RelativeModel& model,
               AlignmentParts* path);
  ~FarHistories();

  // Whether AlignRelative() of the query and this history finds no ends and
  // considers no nodes.
  bool Has(const History& history);

 private:
  class Test;
  template <int D>
  class TestIn;

  std::unique_ptr<Test> test_;
};

}  // namespace revisit::core

#endif  // REVISIT_CORE_SEARCH_ALIGNMENT_FAR_HISTORIES_H_
