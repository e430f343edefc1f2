// Whether two nodes of the history are passes of one place: a vehicle that has
// been here nine times is no less sure of where it is than one that has been
// here once.
#ifndef REVISIT_CORE_CANDIDATES_SAME_PLACE_H_
#define REVISIT_CORE_CANDIDATES_SAME_PLACE_H_

#include "core/alignment/relative.h"
#include "core/graph/pose_graph.h"

namespace revisit::core {

// Probability that they are, in the same direction. 1 where a confirmed loop
// closure joins what lies within kPlaceRadiusMeters of them; 0 where they lie
// within twice that of each other along the path, and so are no two passes.
// Otherwise from the odds of relative.h, with the two nodes' own difference as
// the anchor and, since both have run along with the same recent path,
// `log_likelihood_ratio`, the lesser of theirs, as that of their shapes.
double SamePlaceProbability(const PoseGraph& graph, const RelativeModel& model,
                            NodeIndex i, NodeIndex j,
                            double log_likelihood_ratio);

}  // namespace revisit::core

#endif  // REVISIT_CORE_CANDIDATES_SAME_PLACE_H_
